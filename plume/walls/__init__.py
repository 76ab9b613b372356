"""Gas among buildings: their footprints and heights, the wind around them, and puffs that walls stop.

Imports: plume, plume.polygons, plume.mistakes, plume.worlds.
"""
