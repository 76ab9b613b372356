"""The payload: the gas sensor of a real autopilot, simulated or with a driver.

Imports: plume, link, link.bus, aircraft.bridge.
"""
