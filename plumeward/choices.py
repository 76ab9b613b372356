"""`plumeward list`: the missions, policies, sensors, assumptions and worlds to choose from, with one line
about each.
"""

import argparse
import dataclasses
import textwrap
from collections.abc import Iterable

from agent.policies import policies
from estimator.assumptions import ASSUMPTIONS
from plume.sensor import KINDS
from plume.worlds import WORLDS
from sitl.script.script import load, shipped

Line = tuple[str, str]  # a name, and what it is
SENSORS = {
    "gaussian": "a concentration with Gaussian noise, g/m³",
    "threshold": "a concentration that reads 0 below a threshold or when missed, g/m³",
    "hits": "a Poisson count of hits",
}


HOW = {
    "missions": "plumeward fly MISSION",
    "policies": "--policy NAME",
    "sensors": "--sensor KIND or KIND:NUMBERS",
    "assumptions": "--assume NAME",
    "worlds": "--world NAME",
}
"""The lists, and how a command takes their names."""


def lines(what: str) -> Iterable[Line]:
    """Yield the lines of a list."""
    match what:
        case "missions":
            yield from ((name, load(name).about) for name in shipped())
        case "policies":
            yield from policies().items()
        case "sensors":
            for name, kind in KINDS.items():
                fields = dataclasses.fields(kind)
                numbers = ",".join(f"{field.default:g}" for field in fields)
                meaning = f"its numbers: {', '.join(field.name for field in fields)}"
                yield f"{name}:{numbers}", f"{SENSORS[name]}; {meaning}"
        case "assumptions":
            yield from ASSUMPTIONS.items()
        case "worlds":
            yield from ((name, world.about) for name, world in WORLDS.items())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the list to print."""
    parser.description = "List the missions, policies, sensors, assumptions and worlds to choose from."
    parser.add_argument("what", nargs="?", choices=tuple(HOW), help="list only these (default: all)")


def run(args: argparse.Namespace) -> int:
    """Print one list, or all of them."""
    for number, name in enumerate([args.what] if args.what else HOW):
        print(f"{chr(10) if number else ''}{name.capitalize()}: {HOW[name]}")
        shown = list(lines(name))
        width = max(len(key) for key, _ in shown) + 4
        for key, about in shown:
            first, rest = f"  {key}".ljust(width), " " * width
            print(textwrap.fill(about, 80, initial_indent=first, subsequent_indent=rest))
    return 0
