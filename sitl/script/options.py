"""The flags that say what is flown and simulated, and the script that they make of a mission."""

import argparse

from aircraft.search.events import Wind
from link import cli
from link.cli import BadInput
from plume.problems.fleet import Fleet
from plume.problems.names import PROBLEMS
from plume.problems.options import FLEET_FLAGS, add_problem_argument
from plume.randomness import MAX_SEED
from plume.scenario import AS_MODELLED, NoRelease, WorldError
from plume.sensors import names as sensor
from plume.worlds.names import ABOUT, check, kinds
from sitl.script.script import SAME, Script, VehiclePart, check_places, find, load, shipped
from sitl.script.typed_yaml import Document

# The field of a mission script that each flag sets.
FIELDS = {
    "problem": "problem",
    "seed": "seed",
    "speedup": "speedup",
    "sensor": "sensor",
    "world": "world",
    "silence": "vehicle.silence_s",
    "vehicles": "fleet.vehicles",
    "formation": "fleet.formation",
    "separation": "fleet.separation_m",
    "policy": "agent.policy",
    "budget": "agent.budget",
    "headings": "agent.headings",
    "step": "agent.step_m",
    "measurements": "agent.measurements",
    "particles": "estimator.particles",
    "threshold": "estimator.threshold_m",
    "prior": "estimator.prior",
    "stop_on": "estimator.stop_on",
    "margin": "estimator.margin_m",
    "assume": "estimator.assume",
    "stop": "estimator.stop",
    "doubted": "estimator.doubted",
    "after_stop": "vehicle.after_stop",
    "strict": "vehicle.strict",
}
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
ORIGIN_WANTED = "LAT,LON,ALT,HEADING, of which the first two are the origin of the area for all"
# Fields of a script's vehicle that a real one takes; one of several takes an origin, too.
TAKEN = ("takeoff_altitude_m", "silence_s", "after_stop")
HOME = ("home_lat_deg", "home_lon_deg", "home_alt_m", "home_heading_deg")


def add_mission_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the mission script, the seed, the sensor and the world."""
    mission = parser.add_argument(
        "mission",
        nargs="?",
        metavar="MISSION",
        help="a mission script, MISSION.yaml, or the name of a shipped one, such as wind-shift; flags "
        "override its fields",
    )
    cli.completed(mission, shipped, "yaml", "yml")
    cli.completed(add_problem_argument(parser), lambda: PROBLEMS, "yaml", "yml")
    parser.add_argument(
        "--seed",
        type=cli.whole(0, MAX_SEED),
        default=1,
        metavar="S",
        help="seed of scenario and sensor noise (default: %(default)s)",
    )
    kind = parser.add_argument(
        "--sensor",
        type=cli.checked(sensor.parse, sensor.KINDS),
        default="gaussian",
        metavar="KIND[:NUMBERS]",
        help="the gas sensor: a name of `plumeward list sensors`, with numbers to change: "
        "threshold:0.5,0.3 or pid:drift=0 (default: %(default)s)",
    )
    cli.completed(kind, lambda: sensor.KINDS)
    parser.add_argument(
        "--dwell",
        type=cli.number(0, sensor.LONGEST_DWELL_S),
        metavar="S",
        help="hover S s at each place for its reading (default: as long as the sensor wants)",
    )
    world = parser.add_argument(
        "--world",
        type=cli.checked(check),
        default=AS_MODELLED,
        metavar="NAME",
        help=f"{ABOUT} (default: %(default)s)",
    )
    cli.completed(world, kinds)


def script_of(args: argparse.Namespace) -> Script:
    """Return the named mission script, or the default one, with the given flags put in. Raises BadInput.

    Only a mission that no script describes is flown at the command's own default speed-up.
    """
    given = {**args.given}
    if not args.mission and "speedup" in args:
        given["speedup"] = args.speedup
    if "prior" in given:
        given["prior"] = dict(item.partition("=")[::2] for item in given["prior"])
    changes = {field: given[name] for name, field in FIELDS.items() if name in given}
    if {"threshold", "stop"} & set(given):  # either replaces both
        changes = {"estimator.threshold_m": None, "estimator.stop": None, **changes}
    if "home" in given:
        changes |= {f"vehicle.{field}": value for field, value in zip(HOME, given["home"], strict=True)}
    script = load(args.mission) if args.mission else Script()
    try:
        script = script.changed(changes)
        if "dwell" in given:
            script = script.changed({"sensor": sensor.dwelling(script.sensor, given["dwell"])})
        check(script.world, script.problem)
    except ValueError as error:
        field, _, said = str(error).partition(": ")
        flag = {"step_m": "step", "budget": "budget"}.get(field, "")
        raise BadInput(f"--{flag}: {said}" if flag in given else f"--problem: {error}") from None
    try:
        script.simulated()
    except (NoRelease, WorldError) as error:
        raise blamed(args, "--world", str(error)) from None
    if args.mission:
        check_places(Document(find(args.mission)), script)
    if script.agent.policy == "none" and not script.scripted():
        raise BadInput(
            "--policy: 'none' is not allowed; wanted a policy, or a mission that scripts all its waypoints"
        )
    return script


def script_for_vehicle(script: Script, args: argparse.Namespace) -> Script:
    """Return the script of a mission as its vehicle flies it: a real one at its own speed.

    Raises BadInput with the flag or field that the vehicle cannot take, and why.
    """
    given = args.given
    for flag, (other, reason) in NEEDS.items():
        # Simulated vehicles that search with real ones have their wind.
        beside = flag == "wind" and given.get("vehicles", 1) > 1
        if flag in given and other not in given and not beside:
            raise BadInput(f"--{flag}: {reason}")
    if "vehicle" not in given:
        return script
    together = script.fleet.vehicles > 1
    for flag, reason in SIMULATED_ONLY.items():
        if flag in given and not (together and flag == "home"):
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
        if field not in (*TAKEN, *HOME * together) and getattr(script.vehicle, field) != getattr(
            usual, field
        ):
            raise BadInput(
                f"MISSION: vehicle.{field} is not allowed with --vehicle: the autopilot has its own setting"
            )
    return script.changed({"speedup": speedup})


def origin_of(args: argparse.Namespace, script: Script) -> tuple[float, float] | None:
    """Return the latitude and longitude of the area's origin, degrees; None if no home has been chosen.

    Raises BadInput if that of real vehicles is not the problem's.
    """
    chosen, usual, meant = script.vehicle, VehiclePart(), script.problem.home
    place = chosen.home_lat_deg, chosen.home_lon_deg
    if "home" not in args.given and place == (usual.home_lat_deg, usual.home_lon_deg):
        return meant
    if args.vehicle and meant and meant != place:
        raise BadInput(
            f"--home: {place[0]:.7f},{place[1]:.7f} is not allowed with --vehicle; the problem's home is "
            f"{meant[0]:.7f}, {meant[1]:.7f}"
        )
    return place


def fleet_of(args: argparse.Namespace, script: Script) -> Fleet:
    """Return the vehicles that fly a script together. Raises BadInput."""
    try:
        return script.together()
    except ValueError as error:
        field, _, reason = str(error).partition(" ")
        raise blamed(args, FLEET_FLAGS[field], reason) from None


def blamed(args: argparse.Namespace, flag: str, reason: str) -> BadInput:
    """Return the refusal of a flag's value.

    Where the script has set it, this names the script's line and field; where a problem has, that and its
    field.
    """
    name = flag.removeprefix("--").replace("-", "_")
    name = "formation" if name == "from" else name
    if name in FIELDS and name not in args.given:
        field = FIELDS[name]
        of_problem = next((same for same, other in SAME.items() if other == field), "")
        if of_problem and "problem" in args.given:
            return BadInput(f"--problem: {of_problem}: {reason}")
        if args.mission:
            document = Document(find(args.mission))
            if of_problem and document.given(field) is None:
                field = f"problem.{of_problem}"
            return document.error(field.split("."), reason)
    return BadInput(f"{flag}: {reason}")
