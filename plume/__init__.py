"""The physics that all parts share: dispersion, sensors, scenarios, the world that one mission flies in. Imports: nothing of ours."""

__version__ = "0.1.0"
