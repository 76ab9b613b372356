"""The flags of a problem and of the fleet that searches it, and what they and other flags say."""

import argparse
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from plume.problem import PAPER, PARTS, Problem, square
from plume.problems.fleet import ALONE, FARTHEST_APART_M, FORMATIONS, MOST_VEHICLES, Fleet
from plume.problems.names import ABOUT, named

# The flag of each field of a fleet.
FLEET_FLAGS = {"vehicles": "--vehicles", "formation": "--from", "separation_m": "--separation"}
# The fields that flags of other names override.
FLAGS = {"sensor": "sensor", "dwell": "dwell_s", "step": "step_m", "budget": "budget"}


def add_problem_argument(parser: argparse.ArgumentParser) -> argparse.Action:
    """Add the flag; its value is a Problem, None if it is not given."""
    return parser.add_argument(
        "--problem", type=_problem, metavar="FILE|NAME", help=f"{ABOUT} (default: paper)"
    )


def _problem(text: str) -> Problem:
    try:
        return named(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def problem_of(args: argparse.Namespace) -> Problem:
    """Return the problem of --problem, with what --sensor, --dwell, --step, --budget and --area override.

    Raises ValueError with the flag and what is allowed.
    """
    given = {field: getattr(args, flag, None) for flag, field in FLAGS.items()}
    changes: dict[str, Any] = {field: value for field, value in given.items() if value is not None}
    if getattr(args, "area", None) is not None:
        changes["area"] = square(args.area)
        changes.setdefault("step_m", min((args.problem or PAPER).step_m, args.area / PARTS))
    return overridden(args.problem or PAPER, changes)


def overridden(problem: Problem, changes: Mapping[str, Any]) -> Problem:
    """Return a problem with fields that flags override. Raises ValueError with the flag."""
    changes = {**changes}
    if "sensor" in changes:
        changes.setdefault("dwell_s", None)
    try:
        return problem.changed(**changes)
    except ValueError as error:
        field, _, said = str(error).partition(": ")
        flag = {of: flag for flag, of in FLAGS.items()}.get(field if field in changes else "")
        raise ValueError(f"--{flag}: {said}" if flag else f"--problem: {error}") from None


def add_fleet_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of vehicles that search together."""
    parser.add_argument(
        "--vehicles",
        type=_ranged(int, 1, MOST_VEHICLES, "a whole number"),
        default=ALONE.vehicles,
        metavar="N",
        help=f"vehicles that search together with one belief, 1 to {MOST_VEHICLES} (default: %(default)s)",
    )
    starts = "; ".join(f"{name}: {text}" for name, text in FORMATIONS.items())
    parser.add_argument(
        "--from",
        dest="formation",
        choices=tuple(FORMATIONS),
        default=ALONE.formation,
        help=f"where they start ({starts}; default: %(default)s)",
    )
    parser.add_argument(
        "--separation",
        type=_ranged(float, 0, FARTHEST_APART_M, "a number"),
        default=ALONE.separation_m,
        metavar="M",
        help="least distance between the ways of two vehicles, m (default: %(default)g)",
    )


def fleet_given(args: argparse.Namespace, problem: Problem) -> Fleet:
    """Return what the flags of `add_fleet_arguments` say, within the problem. Raises ValueError."""
    try:
        return Fleet(args.vehicles, args.formation, args.separation).within(problem)
    except ValueError as error:
        field, _, said = str(error).partition(" ")
        raise ValueError(f"{FLEET_FLAGS[field]}: {said}") from None


def _ranged(kind: Callable[[str], float], low: float, high: float, what: str) -> Callable[[str], float]:
    def parse(text: str) -> float:
        with suppress(ValueError):
            if low <= (value := kind(text)) <= high:
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted {what} from {low:g} to {high:g}")

    return parse
