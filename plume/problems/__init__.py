"""Problems by name, from files and from text.

Imports: plume, plume.sensors, plume.worlds.
"""
