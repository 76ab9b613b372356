"""Reads the telemetry log of any ArduPilot or PX4 vehicle as the readings of a search.

Imports: plume, link.bus, link.record.
"""
