"""The flags that say which world is simulated: for `fly`, `uav` and `payload`."""

import argparse

from link import cli
from plume import sensor
from plume.randomness import MAX_SEED
from plume.worlds import AS_MODELLED, WORLDS, check
from sitl.script.script import shipped


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
