"""Planners that turn a belief into the next waypoint, their service, and missions flown in-process."""
