"""The search: the loop that is the same for every aircraft, who leads it, and what happens on board.

Imports: plume, plume.worlds, link, link.bus, link.signing, aircraft, aircraft.bridge.
"""
