"""What people see, keep and command: the page, the recorder, logs, replay, drawings and status are in its
rooms.

Imports: nothing of ours.
"""
