"""Telemetry logs of any ArduPilot or PX4 vehicle, read as the readings of a search.

Imports: plume, link.bus, link.record, sitl.autopilot.
"""
