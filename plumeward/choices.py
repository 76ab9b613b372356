"""`plumeward list`: the missions, policies, sensors, assumptions and worlds to choose from."""

import argparse
import textwrap
from collections.abc import Callable, Mapping

from agent.policies import policies
from estimator.assumptions import ASSUMPTIONS
from plume.sensors.names import KINDS, numbers
from plume.worlds.names import worlds
from sitl.script.script import load, shipped

SENSORS = {
    "gaussian": "a concentration with Gaussian noise, g/m³",
    "threshold": "a concentration that reads 0 below a threshold or when missed, g/m³",
    "hits": "a Poisson count of hits",
    "pid": "a photoionisation detector, g/m³",
    "tgs2600": "a metal oxide, resistance by that in clean air",
    "tgs2611": "a metal oxide, resistance by that in clean air",
    "tgs2620": "a metal oxide, resistance by that in clean air",
    "tdlas": "an open path: the gas along a ray, g/m²",
}


def _sensors() -> dict[str, str]:
    return {
        name: f"{SENSORS[name]}: " + ", ".join(f"{key}={value:g}" for key, value in numbers(sensor).items())
        for name, sensor in KINDS.items()
    }


# The lists: how a command takes their names, and what returns the names, each with a line about it.
LISTS: dict[str, tuple[str, Callable[[], Mapping[str, str]]]] = {
    "missions": ("plumeward fly MISSION", lambda: {name: load(name).about for name in shipped()}),
    "policies": ("--policy NAME", policies),
    "sensors": ("--sensor KIND or KIND:NUMBER,NAME=NUMBER", _sensors),
    "assumptions": ("--assume NAME", lambda: ASSUMPTIONS),
    "worlds": ("--world NAME or NAME:PARAMETERS, several with + between them", worlds),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the list to print."""
    parser.description = "List the missions, policies, sensors, assumptions and worlds to choose from."
    parser.add_argument("what", nargs="?", choices=tuple(LISTS), help="list only these (default: all)")


def run(args: argparse.Namespace) -> int:
    """Print one list, or all of them."""
    for number, name in enumerate([args.what] if args.what else LISTS):
        how, names = LISTS[name]
        print(f"{chr(10) if number else ''}{name.capitalize()}: {how}")
        shown = names()
        width = max(map(len, shown)) + 4
        for key, about in shown.items():
            print(
                textwrap.fill(
                    about, 80, initial_indent=f"  {key}".ljust(width), subsequent_indent=" " * width
                )
            )
    return 0
