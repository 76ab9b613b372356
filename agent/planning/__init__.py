"""Building blocks of planners: moves, and predictions of future readings.

Imports: plume, plume.sensors, link.bus.
"""
