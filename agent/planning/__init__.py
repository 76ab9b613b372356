"""Building blocks of planners: moves, and predictions of future readings.

Imports: plume, plume.polygons, plume.sensors, link.bus.
"""
