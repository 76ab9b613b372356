"""What a real vehicle takes of a mission script and of the flags, and what a simulated one takes of both."""

import argparse

from aircraft.search.events import Wind
from link.cli import BadInput
from sitl.script.script import Script, VehiclePart

# Flags that mean nothing without another one, which one, and why.
NEEDS = {
    "wind": ("vehicle", "only with --vehicle; the simulated vehicle's wind is the mission's"),
    "wait": ("vehicle", "only with --vehicle; the simulated vehicle is there at once"),
    "payload": ("vehicle", "only with --vehicle; the simulated vehicle has a sensor of its own"),
    "sign": ("out", "there is nothing to sign; wanted it with --out"),
}
# Flags that only the simulated vehicle takes, and why.
SIMULATED_ONLY = {
    "home": "a real vehicle's home is where it stands",
    "strict": "a real autopilot has its own rules for OFFBOARD",
}
# Fields of a script's vehicle that a real one takes.
TAKEN = ("takeoff_altitude_m", "silence_s", "after_stop")


def script_for_vehicle(script: Script, args: argparse.Namespace) -> Script:
    """Return the script of a mission as its vehicle flies it: a real one at its own speed.

    Raises BadInput with the flag or field that the vehicle cannot take, and why.
    """
    given = args.given
    for flag, (other, reason) in NEEDS.items():
        if flag in given and other not in given:
            raise BadInput(f"--{flag}: {reason}")
    if "vehicle" not in given:
        return script
    for flag, reason in SIMULATED_ONLY.items():
        if flag in given:
            raise BadInput(f"--{flag}: not with --vehicle: {reason}")
    speedup = given.get("speedup", 1.0)
    if not speedup:
        raise BadInput(
            "--speedup: 0 is not allowed with --vehicle; wanted how fast its simulator runs, "
            "1 for an aircraft"
        )
    if any(isinstance(event, Wind) for event in script.events):
        raise BadInput("MISSION: a wind event is not allowed with --vehicle: its wind is measured")
    usual = VehiclePart()
    for field in usual.__struct_fields__:
        if field not in TAKEN and getattr(script.vehicle, field) != getattr(usual, field):
            raise BadInput(
                f"MISSION: vehicle.{field} is not allowed with --vehicle: the autopilot has its own setting"
            )
    return script.changed({"speedup": speedup})
