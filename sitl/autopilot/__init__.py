"""The simulated vehicle and its MAVLink: motion, modes, missions, fence, telemetry, commands and services.

Imports: plume, link, link.bus, aircraft.
"""
