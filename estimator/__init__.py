"""The particle filter: takes readings, publishes beliefs and the stop.

Imports: plume, link, link.bus, estimator.kernels.
"""
