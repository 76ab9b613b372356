"""Flags that say what the estimator knows beforehand and when it may stop."""

import argparse
import math
from typing import Any

import numpy as np

from estimator import criterion
from estimator.assumptions import effective_priors, unknowns
from estimator.criterion import Criterion
from estimator.priors import Fixed, Prior, draw, parse, table
from link import cli
from plume import sensor
from plume.parameters import PARAMETERS
from plume.randomness import keyed
from plume.scenario import AREA_M

TRIED = 1000  # values that are drawn of a prior before it is taken: a service then need not refuse it


def add_sensor_argument(parser: argparse.ArgumentParser) -> None:
    """Add the flag that chooses the sensor that the estimator assumes."""
    kind = parser.add_argument(
        "--sensor",
        type=cli.checked(sensor.parse, sensor.KINDS),
        default="gaussian",
        metavar="KIND[:NUMBERS]",
        help="the gas sensor: gaussian, threshold or hits, with its numbers to change them: "
        "threshold:0.5,0.3 (default: %(default)s)",
    )
    cli.completed(kind, lambda: sensor.KINDS)


def criteria(args: argparse.Namespace) -> list[Criterion]:
    """Return the stop criteria of --threshold or --stop, several where a command takes several.

    Raises ValueError with what is allowed.
    """
    if args.stop is None:
        return [
            Criterion(threshold_m)
            for threshold_m in (args.threshold if isinstance(args.threshold, list) else [args.threshold])
        ]
    try:
        return list(
            dict.fromkeys(
                criterion.parse(text) for text in ([args.stop] if isinstance(args.stop, str) else args.stop)
            )
        )
    except ValueError as error:
        raise ValueError(f"--stop: {error}") from None


def knowledge(args: argparse.Namespace, area_m: float = AREA_M) -> dict[str, Any]:
    """Return the fields of `Config` that --assume, --prior, --stop-on and --sensor set, for an area of
    side `area_m`.

    Raises ValueError with what is allowed.
    """
    assumed = sensor.parse(args.sensor)
    priors: dict[str, Prior] = {}
    for text in args.prior:
        try:
            name, prior = parse(text)
            if not isinstance(prior, Fixed):
                draw(
                    table({name: prior}, {}, area_m),
                    np.array([PARAMETERS.index(name)]),
                    TRIED,
                    keyed(0, "trial"),
                )
        except ValueError as error:
            raise ValueError(f"--prior: {error}") from None
        priors[name] = prior
    try:
        unknown = unknowns(effective_priors(args.assume, priors, 1.0, 1.0, assumed))
    except ValueError as error:
        raise ValueError(f"--prior: {error}") from None
    if not unknown:
        raise ValueError(
            "--prior: nothing is unknown; at least one parameter needs a prior that is not fixed"
        )
    limits: dict[str, float] = {}
    for item in args.stop_on.split(","):
        name, _, limit = item.partition("=")
        if item == "location":
            continue
        try:
            limits[name] = float(limit)
        except ValueError:
            limits[name] = math.nan
        if name not in unknown or not 0 < limits[name] < math.inf:
            wanted = ", ".join(unknown)
            raise ValueError(
                f"--stop-on: {args.stop_on!r} is not allowed; wanted `location` and NAME=STD above 0, "
                f"between commas; unknown are {wanted}"
            )
    location = "location" in args.stop_on.split(",")
    return {
        "priors": priors,
        "stop_limits": limits,
        "stop_on_location": location,
        "sensor": assumed,
        "assume": args.assume,
    }
