"""Reads the log of any ArduPilot or PX4 vehicle (.tlog, .bin, .ulg) as the readings of a search.

Imports: plume, plume.worlds, link, link.bus, link.record.
"""
