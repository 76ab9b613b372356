"""Mission scripts: what is flown, which faults occur, and which outcome is expected.

Imports: plume, plume.worlds, link, aircraft.search, sitl.autopilot.
"""
