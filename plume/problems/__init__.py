"""Problems by name, from files and from text.

Imports: plume, plume.polygons, plume.sensors, plume.worlds.
"""
