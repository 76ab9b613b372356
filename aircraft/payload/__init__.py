"""The payload: the gas sensor of a real autopilot, simulated or with a driver.

Imports: plume, plume.worlds, link, link.bus, aircraft.bridge.
"""
