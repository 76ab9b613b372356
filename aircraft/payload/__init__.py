"""The payload: the gas sensor of a real autopilot, simulated or with a driver, and the vehicle's questions
to it.

Imports: plume, link, link.bus, aircraft, aircraft.bridge.
"""
