"""`python -m sitl.protocol`: prints the page of what the vehicle's MAVLink supports."""

from sitl.protocol.document import document

print(document(), end="")
