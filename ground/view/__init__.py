"""A page that shows missions, live or recorded, and commands the vehicle.

Imports: plume, link, link.access, link.bus, link.record, scene, scene.follow, sitl.autopilot, sitl.script.
"""
