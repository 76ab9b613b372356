"""The particle filter: takes readings, publishes beliefs and the stop.

Imports: plume, plume.sensors, link, link.bus, estimator.kernels.
"""
