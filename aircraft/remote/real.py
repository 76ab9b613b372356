"""The flag for a real autopilot, the vehicle behind it, and how it is left."""

import argparse
import contextlib
import math
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from aircraft.bridge.address import ALLOWED, parse_address
from aircraft.config import AircraftConfig
from aircraft.remote.winds import parse_wind
from aircraft.search.clock import Clock
from aircraft.search.handling import Handling
from link import cli
from link.bus.log import Log
from link.interrupts import LAUNCHER

if TYPE_CHECKING:
    from aircraft.keeper.connection import Connection
    from aircraft.remote.vehicle import RemoteVehicle

CRITICAL, WARNING = 2, 4  # of MAV_SEVERITY
LEAVE_S, LEAVE_POLL_S = 8.0, 0.02
"""Longest real time in which a real vehicle is told to return home when this program ends; a launcher
waits for 11 s.
"""


def add_vehicle_url(parser: argparse.ArgumentParser) -> None:
    """Add `--vehicle`, `--wind` and `--wait`."""
    parser.add_argument(
        "--vehicle",
        type=cli.checked(parse_address),
        metavar="URL",
        help=f"fly a real autopilot, ArduCopter or PX4, or its own simulator: {ALLOWED}; --speedup is then "
        "that of its simulator "
        "(default: 1), --sysid its system id (default: the first heard)",
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


def real_vehicle(
    url: str, config: AircraftConfig, speedup: float, sysid: int | None, wait_s: float, log: Log
) -> "tuple[RemoteVehicle, Connection]":
    """Return the vehicle at a URL, and the connection to close in the end. Raises ValueError if the URL
    cannot be used.
    """
    from aircraft.keeper.connection import Connection
    from aircraft.remote.commander import (
        Commander,
    )  # all of pymavlink's dialects: only a real vehicle takes the time to load them
    from aircraft.remote.vehicle import RemoteVehicle

    connection = Connection(parse_address(url), log)
    address = connection.address
    log.info(f"vehicle at {address.text}; the other side: {address.other_side}")
    if risk := address.risk("speak as the vehicle"):
        log.warning(risk)
    commander = Commander(connection, speedup, sysid, Handling(log).of)
    return RemoteVehicle(config, commander, wait_s=wait_s, launched=LAUNCHER in os.environ), connection


def leave(vehicle: "RemoteVehicle", clock: Clock, tell: Callable[[int, str], None]) -> None:
    """See to it that a real vehicle in the air has someone in charge when this program ends. It takes at
    most `LEAVE_S`.

    Call it where no signal can cut it short (`link.interrupts.uninterrupted`).
    """
    until_s, told = time.monotonic() + LEAVE_S, False
    while True:
        with contextlib.suppress(Exception):  # whatever fails, the way home is asked for again
            if (said := vehicle.leave()) and not told:
                told = True
                tell(WARNING, said)
        with contextlib.suppress(Exception):
            vehicle.catch_up(clock.now_s())
        if vehicle.left or time.monotonic() >= until_s:
            break
        time.sleep(LEAVE_POLL_S)
    if not vehicle.left:
        tell(CRITICAL, "The vehicle has not answered: its keeper goes on")
