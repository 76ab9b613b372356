"""Messages between processes: keys, message types, sessions, MAVLink frames, logs. Imports: link.access."""
