"""The flag --problem, and the problem that it and other flags say."""

import argparse
from collections.abc import Mapping
from typing import Any

from plume.problem import PAPER, PARTS, Problem, square
from plume.problems.names import ABOUT, named

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
