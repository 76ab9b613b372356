"""The search: the loop that is the same for every aircraft, who leads it, and what happens on board.

Imports: plume, link, link.access, link.bus, link.signing, aircraft, aircraft.payload, aircraft.remote.
"""
