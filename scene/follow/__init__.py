"""Follows what is said on a bus, live or from a record, and says what there is to see at any moment.

Imports: plume, plume.sensors, plume.walls, link, link.bus, link.record, scene.
"""
