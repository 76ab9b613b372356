"""The flags of a vehicle: for `fly`, and for `uav` alone."""

import argparse
import math
from typing import get_args

from link import cli
from plume import sensor
from plume.randomness import MAX_SEED
from plume.worlds import AS_MODELLED, WORLDS, check
from sitl.script.script import AfterStop, shipped


def add_vehicle_arguments(parser: argparse.ArgumentParser, speedup: float) -> None:
    """Add them; `speedup` is the default."""
    mission = parser.add_argument(
        "mission", nargs="?", metavar="MISSION",
        help="a mission script, MISSION.yaml, or the name of a shipped one, such as wind-shift; flags override its fields",
    )  # fmt: skip
    cli.completed(mission, shipped, "yaml", "yml")
    parser.add_argument(
        "--seed",
        type=cli.whole(0, MAX_SEED),
        default=1,
        metavar="S",
        help="seed of scenario and sensor noise (default: %(default)s)",
    )
    parser.add_argument(
        "--speedup", type=cli.number(0, 1000), default=speedup, metavar="X",
        help="times real time; 0 is as fast as possible (default: %(default)g)",
    )  # fmt: skip
    parser.add_argument(
        "-I",
        "--instance",
        type=cli.whole(0, 254),
        default=0,
        metavar="N",
        help="number of the vehicle; its system id and namespace are N+1 (default: %(default)s)",
    )
    kind = parser.add_argument(
        "--sensor", type=cli.checked(sensor.parse, sensor.KINDS), default="gaussian", metavar="KIND[:NUMBERS]",
        help="the gas sensor: gaussian, threshold or hits, with its numbers to change them: threshold:0.5,0.3 (default: %(default)s)",
    )  # fmt: skip
    cli.completed(kind, lambda: sensor.KINDS)
    world = parser.add_argument(
        "--world", type=cli.checked(check, WORLDS), default=AS_MODELLED, metavar="NAME",
        help="how the truth differs from what the estimator is told: a name of `plumeward list worlds` (default: %(default)s)",
    )  # fmt: skip
    cli.completed(world, lambda: WORLDS)
    parser.add_argument(
        "--home", type=_home, metavar="LAT,LON,ALT,HEADING", help="where home is, which is the south-west corner of the search area"
    )
    parser.add_argument(
        "--out", type=_udp_url, action="append", default=[], metavar="URL",
        help="also speak MAVLink: udpout:HOST:PORT sends (14540 MAVSDK and MAVROS, 14550 ground stations), udpin:HOST:PORT waits",
    )  # fmt: skip
    parser.add_argument(
        "--silence", type=cli.number(0, math.inf, above=True), default=30.0, metavar="S",
        help="return home and land after S real seconds without a waypoint (default: %(default)g)",
    )  # fmt: skip
    parser.add_argument(
        "--after-stop", choices=get_args(AfterStop), default="return",
        help="once the search is over: return home and land, land on the spot, or hold until told (default: %(default)s)",
    )  # fmt: skip


def _udp_url(text: str) -> str:
    from sitl.uav.udp import parse_url

    try:
        parse_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _home(text: str) -> tuple[float, float, float, float]:
    try:
        lat, lon, alt, heading = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted LAT,LON,ALT,HEADING") from None
    if not (abs(lat) <= 90 and abs(lon) <= 180 and abs(alt) <= 10_000 and abs(heading) <= 360):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not allowed; wanted LAT within ±90, LON within ±180, ALT within ±10000, HEADING within ±360"
        )
    return lat, lon, alt, heading
