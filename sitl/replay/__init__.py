"""A log in the vehicle's place, and whether the services say what they said then.

Imports: plume, link, link.bus, link.record, sitl.script, sitl.launch, sitl.tlog.
"""
