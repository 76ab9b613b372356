"""The particle filter: takes readings, publishes beliefs and the stop.

Imports: plume, plume.polygons, plume.sensors, plume.problems, link, link.bus, estimator.kernels.
"""
