"""The flag for a real autopilot, the vehicle behind it, and how it is left."""

import argparse
import contextlib
import math
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from aircraft.bridge.address import ALLOWED, parse_address
from aircraft.remote.winds import parse_wind
from aircraft.search.clock import Clock
from aircraft.search.handling import Handling
from link import cli
from link.bus.log import Log
from link.interrupts import LAUNCHER
from sitl.autopilot.config import VehicleConfig
from sitl.script.events import Wind
from sitl.script.script import Script, VehiclePart

if TYPE_CHECKING:
    from aircraft.keeper.connection import Connection
    from aircraft.remote.vehicle import RemoteVehicle

CRITICAL, WARNING = 2, 4
"""Of MAV_SEVERITY."""
LEAVE_S, LEAVE_POLL_S = 8.0, 0.02
"""Longest real time in which a real vehicle is told to return home when this program ends; a launcher
waits for 11 s.
"""
SIMULATED_ONLY = {
    "home": "a real vehicle's home is where it stands",
    "strict": "a real autopilot has its own rules for OFFBOARD",
}
"""Flags that only the simulated vehicle takes, and why."""
TAKEN = ("takeoff_altitude_m", "silence_s", "after_stop")
"""Fields of a script's vehicle that a real one takes."""


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


def real_script(script: Script, given: argparse.Namespace) -> Script:
    """Return the script at a real vehicle's own speed, a simulated one's as it is.

    Raises ValueError with the flag that the vehicle cannot take, and why.
    """
    if not getattr(given, "vehicle", None):
        if "wind" in given:
            raise ValueError("--wind: only with --vehicle; the simulated vehicle's wind is the mission's")
        if "wait" in given:
            raise ValueError("--wait: only with --vehicle; the simulated vehicle is there at once")
        return script
    for flag, reason in SIMULATED_ONLY.items():
        if flag in given:
            raise ValueError(f"--{flag}: not with --vehicle: {reason}")
    speedup = getattr(given, "speedup", 1.0)
    if not speedup:
        raise ValueError(
            "--speedup: 0 is not allowed with --vehicle; wanted how fast its simulator runs, 1 for an "
            "aircraft"
        )
    if any(isinstance(event, Wind) for event in script.events):
        raise ValueError("MISSION: a wind event is not allowed with --vehicle: its wind is measured")
    usual = VehiclePart()
    for field in usual.__struct_fields__:
        if field not in TAKEN and getattr(script.vehicle, field) != getattr(usual, field):
            raise ValueError(
                f"MISSION: vehicle.{field} is not allowed with --vehicle: the autopilot has a setting of its "
                "own"
            )
    return script.changed({"speedup": speedup})


def real_vehicle(
    url: str, config: VehicleConfig, speedup: float, sysid: int | None, wait_s: float, log: Log
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
    if address.open:
        log.warning(
            f"{address.text} is open to other machines: whoever reaches port {address.port} can speak as the "
            "vehicle"
        )
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
