"""Tools for operators: the recorder, the status of running parts, the summary and the drawing of a log.

Imports: plume, link, link.bus, link.record, scene, scene.follow, ground.tlog.
"""
