"""The UAV service: one vehicle in one world. Imports: plume, link.bus, sitl.autopilot, sitl.protocol, sitl.script."""
