"""The particle filter: readings in, beliefs and the stop out. Imports: plume, link, link.bus, estimator.kernels."""
