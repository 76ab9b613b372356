"""Findings: what a flight leaves behind for people and programs that know nothing of the search.

Imports: plume, plume.sensors, link, link.bus, link.record, scene, scene.follow.
"""
