"""Planners: each a pure function from a belief to the next waypoint, one small file each.

Imports: plume, link.bus, agent.planning.
"""
