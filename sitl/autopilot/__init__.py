"""The simulated vehicle: motion, flight modes and telemetry.

Imports: plume, link.bus, aircraft.
"""
