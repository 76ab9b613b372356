"""A real autopilot as the vehicle: a MAVLink client with the interface of the simulated one.

Imports: plume, link.bus, sitl.bridge, sitl.autopilot, sitl.protocol.
"""
