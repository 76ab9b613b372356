"""A real autopilot as the vehicle: a MAVLink client that flies it for a search.

Imports: plume, link, link.bus, link.signing, sitl.bridge, sitl.autopilot.
"""
