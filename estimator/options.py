"""Flags that say what the estimator knows beforehand and when it may stop."""

import argparse
import math
from typing import Any

import numpy as np

from estimator import criterion
from estimator.assumptions import effective_priors, margin, unknowns
from estimator.priors import Fixed, Prior, draw, parse, table
from link import cli
from plume.parameters import PARAMETERS
from plume.problem import PAPER, Problem
from plume.problems.names import sensor_of
from plume.randomness import keyed
from plume.sensors import names as sensor

TRIED = 1000  # values that are drawn of a prior before it is taken: a service then need not refuse it


def add_sensor_argument(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say which sensor the estimator assumes, and how long the vehicle hovers for it."""
    kind = parser.add_argument(
        "--sensor",
        type=cli.checked(sensor.parse, sensor.KINDS),
        metavar="KIND[:NUMBERS]",
        help="the gas sensor: a name of `plumeward list sensors`, with numbers to change: "
        "threshold:0.5,0.3 or pid:drift=0 (default: the problem's, gaussian)",
    )
    cli.completed(kind, lambda: sensor.KINDS)
    parser.add_argument(
        "--dwell",
        type=cli.number(0, sensor.LONGEST_DWELL_S),
        metavar="S",
        help="hover S s at each place for its reading (default: as long as the sensor wants)",
    )


def criteria(args: argparse.Namespace, problem: Problem = PAPER) -> list[criterion.Criterion]:
    """Return the stop criteria of --threshold or --stop, several where a command takes several.

    Without either it is the problem's. Raises ValueError with what is allowed.
    """
    if args.stop is None and args.threshold is None:
        try:
            return [criterion.parse(problem.stop)]
        except ValueError as error:
            raise ValueError(f"--problem: stop: {error}") from None
    if args.stop is None:
        thresholds_m = args.threshold if isinstance(args.threshold, list) else [args.threshold]
        return [criterion.Criterion(threshold_m) for threshold_m in thresholds_m]
    texts = [args.stop] if isinstance(args.stop, str) else args.stop
    try:
        return list(dict.fromkeys(map(criterion.parse, texts)))
    except ValueError as error:
        raise ValueError(f"--stop: {error}") from None


def knowledge(args: argparse.Namespace, problem: Problem = PAPER) -> dict[str, Any]:
    """Return the fields of `Config` that --assume, --prior, --margin, --stop-on and --sensor set.

    problem: with what --sensor overrides. Raises ValueError with what is allowed.
    """
    assumed = sensor_of(problem)
    priors: dict[str, Prior] = {}
    try:
        for text in args.prior:
            name, prior = parse(text)
            if not isinstance(prior, Fixed):
                margin_m = margin(args.assume, problem.area, args.margin)
                rows = table({name: prior}, {}, problem.area, margin_m)
                index = np.array([PARAMETERS.index(name)])
                draw(rows, index, TRIED, keyed(0, "trial"))
            priors[name] = prior
        unknown = unknowns(effective_priors(args.assume, priors, 1.0, 1.0, assumed))
        if not unknown:
            raise ValueError("nothing is unknown; at least one parameter needs a prior that is not fixed")
    except ValueError as error:
        raise ValueError(f"--prior: {error}") from None
    wanted = args.stop_on.split(",")
    try:
        limits = [
            (name, float(limit))
            for name, _, limit in (item.partition("=") for item in wanted if item != "location")
        ]
    except ValueError:
        limits = [("", math.nan)]
    if not all(name in unknown and 0 < limit < math.inf for name, limit in limits):
        raise ValueError(
            f"--stop-on: {args.stop_on!r} is not allowed; wanted `location` and NAME=STD above 0, "
            f"between commas; unknown are {', '.join(unknown)}"
        )
    return {
        "priors": priors,
        "margin_m": args.margin,
        "stop_limits": dict(limits),
        "stop_on_location": "location" in wanted,
        "sensor": assumed,
        "assume": args.assume,
    }
