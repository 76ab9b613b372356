"""ROS 2 without ROS: a mission on the same router as topics, by rmw_zenoh's rules.

Imports: plume, link, link.access, link.bus, link.record, aircraft, scene, scene.follow.
"""
