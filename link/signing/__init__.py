"""MAVLink 2 signing: the key, the signatures of frames, and timestamps that only go forward.

Our own, since pymavlink's signs only what it packs itself, takes a frame's timestamp before it checks the
signature (one forged frame locks a sender out), and forgets all timestamps at a restart (old frames can be
played back).

Imports: link.access, link.bus.
"""
