"""Missions as processes: started, watched, disturbed and ended.

Imports: plume, link, link.access, link.bus, aircraft, aircraft.payload, sitl.script, scene.follow.
"""
