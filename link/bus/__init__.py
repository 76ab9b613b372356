"""Messages between processes: the table of keys, message types, sessions, MAVLink frames, logs and counts.
Imports: link.access.
"""
