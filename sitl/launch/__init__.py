"""Missions as processes: started, watched, disturbed and ended.

Imports: plume, plume.problems, link, link.access, link.bus, aircraft, aircraft.payload, aircraft.search,
sitl.script, sitl.uav, scene.follow.
"""
