"""The autopilot's MAVLink protocol: what hands each message to its service, one file each.

Imports: plume, link.bus, aircraft, sitl.autopilot.
"""
