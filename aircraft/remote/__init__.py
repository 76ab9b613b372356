"""A real autopilot as the vehicle: a MAVLink client that flies it for a search, and asks its payload.

Imports: plume, link, link.bus, link.signing, aircraft, aircraft.bridge, aircraft.keeper, aircraft.payload,
aircraft.search.
"""
