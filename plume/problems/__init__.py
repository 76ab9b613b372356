"""Problems by name, from files and from text, the fleet that searches one, and their flags.

Imports: plume, plume.polygons, plume.mistakes, plume.sensors, plume.worlds.
"""
