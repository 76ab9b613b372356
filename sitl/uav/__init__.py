"""The UAV service: one vehicle in one world, on the bus and over UDP.

Imports: plume, plume.sensors, plume.worlds, plume.problems, link, link.access, link.bus, link.signing,
aircraft, aircraft.bridge, aircraft.payload, aircraft.search, sitl.autopilot, sitl.script.
"""
