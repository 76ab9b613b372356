"""The command that flies missions; the vehicle and all around it are in its rooms.

Imports: link.
"""
