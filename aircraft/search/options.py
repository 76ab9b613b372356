"""The flags of a real vehicle, for `fly` and `uav`: nothing is loaded that flies it."""

import argparse
import math

from aircraft.bridge.address import ALLOWED, parse_address
from link import cli
from plume.elementary import float32

WANTED_WIND = (
    "SPEED,FROM: m/s from 0 to 100, and the direction that it comes from in degrees within ±360, "
    "clockwise from north"
)


def add_vehicle_url(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add `--vehicle`, `--wind` and `--wait`.  several: it may be given for several vehicles."""
    each = "; once for each real one of --vehicles, of which they are the first" * several
    parser.add_argument(
        "--vehicle",
        type=cli.checked(parse_address),
        action="append" if several else "store",
        metavar="URL",
        help=f"fly a real autopilot, ArduCopter or PX4, or its own simulator: {ALLOWED}; --speedup is then "
        "that of its simulator "
        f"(default: 1), --sysid its system id (default: the first heard){each}",
    )
    parser.add_argument(
        "--wind",
        type=cli.checked(parse_wind),
        metavar="SPEED,FROM",
        help="with --vehicle, the wind of all readings, m/s and the direction it comes from in degrees, "
        "instead of what payload and "
        "autopilot say",
    )
    parser.add_argument(
        "--wait",
        type=cli.number(0, math.inf, above=True),
        default=120.0,
        metavar="S",
        help="with --vehicle, give up if the search has not begun S real seconds after the start, for want "
        "of the vehicle, its position, a "
        "pilot or a service; inf waits for ever (default: %(default)g)",
    )


def parse_wind(text: str) -> tuple[float, float]:
    """Return the wind that `SPEED,FROM` says, (u cos φ, u sin φ) m/s, as float32.

    It points to where the wind comes from. Raises ValueError with what is wanted.
    """
    try:
        speed, from_deg = (float(part) for part in text.split(","))
    except ValueError:
        speed = from_deg = math.nan
    if not (0.0 <= speed <= 100.0 and abs(from_deg) <= 360.0):
        raise ValueError(f"{text!r} is not allowed; wanted {WANTED_WIND}")
    angle = math.radians(from_deg)
    return float32(speed * math.sin(angle)), float32(speed * math.cos(angle))
