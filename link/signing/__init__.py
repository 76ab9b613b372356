"""MAVLink 2 signing: the key, the signatures of frames, and timestamps that only go forward.

Imports: link.access, link.bus.
"""
