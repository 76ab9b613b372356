"""The keeper of a real autopilot's link, which brings the vehicle home without the search; and the way to it.

Imports: link, link.bus, aircraft, aircraft.bridge.
"""
