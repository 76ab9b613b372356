"""Missions as processes: started, watched, disturbed and ended.

Imports: plume, link, link.access, link.bus, scene.follow, sitl.autopilot, sitl.script, aircraft.payload.
"""
