"""What people see, keep and command: page, recorder, logs, replay, drawings and status are its rooms.

Imports: nothing of ours.
"""
