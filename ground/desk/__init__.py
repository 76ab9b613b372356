"""Tools for operators: the recorder, the status of running parts, logs and recorded plumes shown and drawn.

Imports: plume, plume.recorded, link, link.access, link.bus, link.record, aircraft, scene, scene.follow,
ground.tlog.
"""
