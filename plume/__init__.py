"""The physics that all parts share: dispersion, sensor, scenarios, the world that one mission flies in."""

__version__ = "0.1.0"
