"""How the processes talk: the table of keys, messages, sessions, the MAVLink codec, command lines."""
