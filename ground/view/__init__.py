"""A page that shows missions, live or recorded, and commands the vehicle.

Imports: plume, plume.worlds, link, link.access, link.bus, link.record, aircraft, sitl.script, scene,
scene.follow.
"""
