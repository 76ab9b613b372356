"""Replay: a log takes the vehicle's place, and the services' answers are compared with the recorded ones.

Imports: plume, plume.sensors, link, link.bus, link.record, aircraft, sitl.script, sitl.launch,
ground.tlog, ground.logs, ground.findings.
"""
