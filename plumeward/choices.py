"""`plumeward list`: the missions, policies, sensors, assumptions and worlds to choose from, with one line
about each.
"""

import argparse
import dataclasses
import textwrap
from collections.abc import Callable, Iterator

Line = tuple[str, str]  # a name, and what it is
SENSORS = {
    "gaussian": "a concentration with Gaussian noise, g/m³",
    "threshold": "a concentration that reads 0 below a threshold or when missed, g/m³",
    "hits": "a Poisson count of hits",
}


def missions() -> Iterator[Line]:
    """Yield the shipped missions: their names, and what they show."""
    from sitl.script.script import load, shipped

    for name in shipped():
        yield name, load(name).about


def policies() -> Iterator[Line]:
    """Yield the policies."""
    from agent.policies import policies

    yield from policies().items()


def sensors() -> Iterator[Line]:
    """Yield the sensors with their numbers, as the flag --sensor takes them."""
    from plume.sensor import KINDS

    for name, kind in KINDS.items():
        fields = dataclasses.fields(kind)
        numbers = ",".join(f"{field.default:g}" for field in fields)
        yield (
            f"{name}:{numbers}",
            f"{SENSORS[name]}; its numbers: {', '.join(field.name for field in fields)}",
        )


def assumptions() -> Iterator[Line]:
    """Yield the assumptions: what the estimator takes to be known."""
    from estimator.assumptions import ASSUMPTIONS

    yield from ASSUMPTIONS.items()


def worlds() -> Iterator[Line]:
    """Yield the worlds."""
    from plume.worlds import WORLDS

    for name, world in WORLDS.items():
        yield name, world.about


# Each list: how a command takes its names, and the function that yields its lines.
LISTS: dict[str, tuple[str, Callable[[], Iterator[Line]]]] = {
    "missions": ("plumeward fly MISSION", missions),
    "policies": ("--policy NAME", policies),
    "sensors": ("--sensor KIND or KIND:NUMBERS", sensors),
    "assumptions": ("--assume NAME", assumptions),
    "worlds": ("--world NAME", worlds),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the list to print."""
    parser.description = "List the missions, policies, sensors, assumptions and worlds to choose from."
    parser.add_argument("what", nargs="?", choices=tuple(LISTS), help="list only these (default: all)")


def run(args: argparse.Namespace) -> int:
    """Print one list, or all of them."""
    for number, name in enumerate([args.what] if args.what else LISTS):
        how, lines = LISTS[name]
        print(f"{chr(10) if number else ''}{name.capitalize()}: {how}")
        shown = list(lines())
        width = max(len(key) for key, _ in shown) + 4
        for key, about in shown:
            first, rest = f"  {key}".ljust(width), " " * width
            print(textwrap.fill(about, 80, initial_indent=first, subsequent_indent=rest))
    return 0
