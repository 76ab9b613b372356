"""What a real vehicle takes of a mission script and of the flags."""

import argparse

from aircraft.search.events import Wind
from sitl.script.script import Script, VehiclePart

SIMULATED_ONLY = {
    "home": "a real vehicle's home is where it stands",
    "strict": "a real autopilot has its own rules for OFFBOARD",
}
"""Flags that only the simulated vehicle takes, and why."""
TAKEN = ("takeoff_altitude_m", "silence_s", "after_stop")
"""Fields of a script's vehicle that a real one takes."""


def real_script(script: Script, given: argparse.Namespace) -> Script:
    """Return the script at a real vehicle's own speed, a simulated one's as it is.

    Raises ValueError with the flag that the vehicle cannot take, and why.
    """
    if not getattr(given, "vehicle", None):
        if "wind" in given:
            raise ValueError("--wind: only with --vehicle; the simulated vehicle's wind is the mission's")
        if "wait" in given:
            raise ValueError("--wait: only with --vehicle; the simulated vehicle is there at once")
        return script
    for flag, reason in SIMULATED_ONLY.items():
        if flag in given:
            raise ValueError(f"--{flag}: not with --vehicle: {reason}")
    speedup = getattr(given, "speedup", 1.0)
    if not speedup:
        raise ValueError(
            "--speedup: 0 is not allowed with --vehicle; wanted how fast its simulator runs, 1 for an "
            "aircraft"
        )
    if any(isinstance(event, Wind) for event in script.events):
        raise ValueError("MISSION: a wind event is not allowed with --vehicle: its wind is measured")
    usual = VehiclePart()
    for field in usual.__struct_fields__:
        if field not in TAKEN and getattr(script.vehicle, field) != getattr(usual, field):
            raise ValueError(
                f"MISSION: vehicle.{field} is not allowed with --vehicle: the autopilot has a setting of its "
                "own"
            )
    return script.changed({"speedup": speedup})
