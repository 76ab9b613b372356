"""The UAV service: one vehicle in one world, on the bus and over UDP.

Imports: plume, link, link.access, link.bus, link.signing, aircraft.bridge, sitl.autopilot, sitl.protocol,
sitl.script, aircraft.payload, aircraft.remote.
"""
