"""Mission scripts: what is flown, which faults occur, and which outcome is expected.

Imports: plume, plume.mistakes, plume.sensors, plume.worlds, plume.problems, link, aircraft.search,
sitl.autopilot.
"""
