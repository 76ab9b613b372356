"""The flags that say what is flown and simulated, and the script that they make: for `fly`, `uav` and
`payload`.
"""

import argparse

from link import cli
from link.cli import BadInput
from plume import sensor
from plume.randomness import MAX_SEED
from plume.worlds import AS_MODELLED, WORLDS, check
from sitl.script.script import Script, find, load, shipped
from sitl.script.typed_yaml import Document

# The field of a mission script that each flag sets.
FIELDS = {
    "seed": "seed",
    "speedup": "speedup",
    "sensor": "sensor",
    "world": "world",
    "silence": "vehicle.silence_s",
    "policy": "agent.policy",
    "budget": "agent.budget",
    "headings": "agent.headings",
    "step": "agent.step_m",
    "measurements": "agent.measurements",
    "particles": "estimator.particles",
    "threshold": "estimator.threshold_m",
    "prior": "estimator.prior",
    "stop_on": "estimator.stop_on",
    "assume": "estimator.assume",
    "stop": "estimator.stop",
    "after_stop": "vehicle.after_stop",
    "strict": "vehicle.strict",
}
HOME = ("home_lat_deg", "home_lon_deg", "home_alt_m", "home_heading_deg")


def add_mission_argument(parser: argparse.ArgumentParser) -> None:
    """Add the mission script."""
    mission = parser.add_argument(
        "mission",
        nargs="?",
        metavar="MISSION",
        help="a mission script, MISSION.yaml, or the name of a shipped one, such as wind-shift; flags "
        "override its fields",
    )
    cli.completed(mission, shipped, "yaml", "yml")


def add_seed_argument(parser: argparse.ArgumentParser) -> None:
    """Add the seed."""
    parser.add_argument(
        "--seed",
        type=cli.whole(0, MAX_SEED),
        default=1,
        metavar="S",
        help="seed of scenario and sensor noise (default: %(default)s)",
    )


def add_world_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the sensor and the world."""
    kind = parser.add_argument(
        "--sensor",
        type=cli.checked(sensor.parse, sensor.KINDS),
        default="gaussian",
        metavar="KIND[:NUMBERS]",
        help="the gas sensor: gaussian, threshold or hits, with its numbers to change them: "
        "threshold:0.5,0.3 (default: %(default)s)",
    )
    cli.completed(kind, lambda: sensor.KINDS)
    world = parser.add_argument(
        "--world",
        type=cli.checked(check, WORLDS),
        default=AS_MODELLED,
        metavar="NAME",
        help="how the truth differs from what the estimator is told: a name of `plumeward list worlds` "
        "(default: %(default)s)",
    )
    cli.completed(world, lambda: WORLDS)


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
    script = (load(args.mission) if args.mission else Script()).changed(changes)
    if script.agent.policy == "none" and not script.scripted():
        wanted = "a policy, or a mission that scripts all its waypoints"
        raise BadInput(f"--policy: 'none' is not allowed; wanted {wanted}")
    return script


def blamed(args: argparse.Namespace, flag: str, reason: str) -> BadInput:
    """Return the refusal of a flag's value; where the script has set it, with the script's line and field."""
    name = flag.removeprefix("--").replace("-", "_")
    if args.mission and name in FIELDS and name not in args.given:
        return Document(find(args.mission)).error(FIELDS[name].split("."), reason)
    return BadInput(f"{flag}: {reason}")
