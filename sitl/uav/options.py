"""The flags of a vehicle: for `fly`, and for `uav` alone."""

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import get_args

from aircraft.bridge.address import LISTENING, parse_out
from aircraft.search.search import AfterStop
from aircraft.together import Berth
from link import cli
from link.access.roles import MOST_SEARCHES, MOST_VEHICLES
from link.signing.key import read_key
from plume.flight import TRY_AGAIN_S, leg_s
from plume.geodesy import to_global
from plume.sensors.instruments import Instrument
from plume.sensors.names import Sensor
from sitl.autopilot.config import VehicleConfig
from sitl.script.options import add_mission_arguments

LATE_IN_A_MOVING_WORLD = (
    "a simulated vehicle cannot join late where gas, wind or sensor change with time: it would not know it"
)
MOST_SYSTEMS = 255  # MAVLink's system ids begin with 1
HOMES_APART_M = 40.0  # default homes lie so far apart that search areas do not overlap


def add_vehicle_arguments(
    parser: argparse.ArgumentParser, speedup: float, usual_instance: str = "%(default)s"
) -> None:
    """Add them; `speedup` is the default.  usual_instance: the default of -I in words."""
    add_mission_arguments(parser)
    parser.add_argument(
        "--speedup",
        type=cli.number(0, 1000),
        default=speedup,
        metavar="X",
        help="times real time; 0 is as fast as possible (default: %(default)g)",
    )
    parser.add_argument(
        "-I",
        "--instance",
        type=cli.whole(0, 254),
        default=0,
        metavar="N",
        help="number of the vehicle: its namespace is uav/N+1, and by it differ system id, home and ports "
        f"(default: {usual_instance})",
    )
    parser.add_argument(
        "--sysid",
        type=cli.whole(1, 255),
        metavar="N",
        help="its MAVLink system id (default: that of -I, plus 1)",
    )
    parser.add_argument(
        "--home",
        type=_home,
        metavar="LAT,LON,ALT,HEADING",
        help="where home is, the origin of the search area, in the paper's problem its south-west corner "
        "(default: Zurich, each -I 40 m further east)",
    )
    parser.add_argument(
        "--out",
        type=cli.checked(parse_out),
        action="append",
        default=[],
        metavar="URL",
        help="also speak MAVLink: udpout:HOST:PORT sends (14540 MAVSDK and MAVROS, 14550 ground stations), "
        "udpin:HOST:PORT waits; "
        "without :PORT it is 14540 + N of -I, udpin: 14580 + N; may be given several times",
    )
    parser.add_argument(
        "--sign",
        type=cli.checked(read_key),
        metavar="KEYFILE",
        help="sign MAVLink on all --out links, and refuse frames without a valid signature; the file holds "
        "64 hexadecimal digits or a "
        "passphrase",
    )
    parser.add_argument(
        "--silence",
        type=cli.number(0, math.inf, above=True),
        default=30.0,
        metavar="S",
        help="return home and land after S real seconds without a waypoint, beyond the sensor's dwell and "
        "warm-up (default: %(default)g)",
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="OFFBOARD as in PX4, to test a companion: setpoints at 2 Hz or more, and a return home 1 s "
        "after the last",
    )
    parser.add_argument(
        "--after-stop",
        choices=get_args(AfterStop),
        default="return",
        help="once the search is over: return home and land, land on the spot, or hold until told (default: "
        "%(default)s)",
    )


def check_ids(args: argparse.Namespace, vehicles: int, number: int = 1) -> None:
    """Raise BadInput if -I or --sysid is not for a vehicle of that number among several, or for --secure."""
    which = f" for vehicle {number} of {vehicles}, whose system ids follow each other" if vehicles > 1 else ""
    low, high = number - 1, MOST_SYSTEMS - 1 - vehicles + number
    wanted = [("--sysid", args.sysid, low + 1, high + 1, which)]
    if args.secure and not getattr(args, "namespace", None):
        most = number - 2 + (MOST_SEARCHES if vehicles > 1 else MOST_VEHICLES)
        wanted.append(("-I", args.instance, 0, most, " with --secure"))
    wanted.append(("-I", args.instance, 0 if args.sysid else low, high, which))
    for flag, value, least, most, why in wanted:
        if value is not None and not least <= value <= most:
            raise cli.BadInput(f"{flag}: {value} is not allowed{why}; wanted {least} to {most}")


def check_outs(urls: Sequence[str], vehicles: int) -> None:
    """Raise BadInput if several vehicles would listen at one port."""
    for address in map(parse_out, urls if vehicles > 1 else ()):
        if address.kind in LISTENING and address.text in urls:
            raise cli.BadInput(
                f"--out: {address.text} is not allowed for {vehicles} vehicles, which cannot listen at one "
                f"port; wanted {address.kind}:{address.host}, by which each has its own"
            )


def at_own_home(config: VehicleConfig, instance: int) -> VehicleConfig:
    """Return the configuration of vehicle `instance`, moved east unless a home of its own was chosen."""
    usual = VehicleConfig()
    if (config.home_lat_deg, config.home_lon_deg) != (usual.home_lat_deg, usual.home_lon_deg):
        return config
    apart_m = max(HOMES_APART_M, config.flown.size_m[0] + HOMES_APART_M / 4)
    lat_deg, lon_deg = to_global(usual.home_lat_deg, usual.home_lon_deg, 0.0, apart_m * instance)
    return replace(config, home_lat_deg=lat_deg, home_lon_deg=lon_deg)


def at_own_stand(config: VehicleConfig, berth: Berth) -> VehicleConfig:
    """Return the configuration of one of several, which stands where its search begins.

    It returns there above those that search on, each at an altitude of its own, the separation apart. The
    further its stand is from the middle of the area, the higher: on its way out it passes above those that
    come down to theirs.
    """
    middle = [(low + high) / 2 for low, high in zip(config.area.low, config.area.high, strict=True)]
    stands = sorted((berth.start, *berth.others), key=lambda stand: (math.dist(stand, middle), stand))
    above_m = (1 + stands.index(berth.start)) * berth.separation_m
    higher_m = max(config.return_altitude_m, config.takeoff_altitude_m) + above_m
    x, y = berth.start
    return replace(config, stand=(y, x), return_altitude_m=min(higher_m, config.ceiling_m))


def reading_s(sensor: Sensor) -> float:
    """Return the longest time that a sensor may take for a reading: no waypoint comes before it, s."""
    return sensor.dwell + (sensor.warmup if isinstance(sensor, Instrument) else 0.0)


def longest_wait_s(config: VehicleConfig, sensor: Sensor) -> float:
    """Return the longest time that others may take to their next reading: no agent is silent for that, s."""
    area = config.flown
    corners = [(0.0, 0.0), area.low, area.high]
    legs = [leg_s(a, b, config.speed_mps, config.accel_mps2) for a, b in combinations(corners, 2)]
    return float(max(legs)) + reading_s(sensor) + TRY_AGAIN_S


def _home(text: str) -> tuple[float, float, float, float]:
    try:
        lat, lon, alt, heading = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted LAT,LON,ALT,HEADING") from None
    if not (abs(lat) <= 90 and abs(lon) <= 180 and abs(alt) <= 10_000 and abs(heading) <= 360):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not allowed; wanted LAT within ±90, LON within ±180, ALT within ±10000, HEADING "
            "within ±360"
        )
    return lat, lon, alt, heading
