"""`plumeward uav`: one vehicle alone, simulated or real."""

import argparse
import math
import shlex
from dataclasses import replace
from importlib import import_module

from aircraft.payload.simulated import turned
from aircraft.search.command import Orders, fly
from aircraft.search.events import OnBoard, happens_to
from aircraft.search.options import add_vehicle_url, parse_wind
from aircraft.together import Berth
from link import cli
from plume.problem import PAPER
from plume.problems.fleet import ALONE, MOST_VEHICLES, Fleet
from plume.problems.options import add_fleet_arguments
from sitl.autopilot.vehicle import Vehicle
from sitl.script.options import ORIGIN_WANTED, fleet_of, origin_of, script_for_vehicle, script_of
from sitl.script.script import Script
from sitl.uav.options import (
    add_vehicle_arguments,
    at_own_home,
    at_own_stand,
    check_ids,
    longest_wait_s,
    reading_s,
)
from sitl.uav.simulated import simulated_uav

REAL_VEHICLE = "aircraft.remote.command"  # flies a real vehicle; loaded only then


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    cli.add_bus_arguments(parser)
    parser.set_defaults(connect=None, namespace=None)
    add_vehicle_arguments(parser, speedup=1.0, usual_instance="%(default)s; with --number K it is K - 1")
    add_vehicle_url(parser)
    add_fleet_arguments(parser)
    parser.add_argument(
        "--number",
        type=cli.whole(1, MOST_VEHICLES),
        metavar="K",
        help="which of --vehicles N it is; its keys are then those of uav/K in the search's namespace "
        "(default: -I plus 1)",
    )


def run(args: argparse.Namespace) -> int:
    """Fly until interrupted. Raises BadInput."""
    script = script_for_vehicle(script_of(args), args)
    fleet, number = _place_in_fleet(args, script)
    chosen = "" if script.sensor == "gaussian" else f" --sensor {script.sensor}"
    chosen += "" if script.estimator.assume == "field" else f" --assume {script.estimator.assume}"
    if (told := script.problem.told) != PAPER:
        chosen += f" --problem {shlex.quote(told.text)}"
    together = fleet.vehicles > 1
    chosen += f" --vehicles {fleet.vehicles}" if together else ""
    apart = together and fleet.separation_m != ALONE.separation_m
    world = script.simulated()
    if args.wind and not args.vehicle:
        world = turned(world, math.hypot(*(wind := parse_wind(args.wind))), math.atan2(wind[1], wind[0]))
    orders = Orders(
        world,
        script.speedup,
        [event for event in script.events if isinstance(event, OnBoard) and happens_to(event, number)],
        script.vehicle.after_stop,
        chosen,
        f" --separation {fleet.separation_m!r}" if apart else "",
        number if together else None,
        _berth(args, script, fleet, number) if together else None,
    )
    config = script.vehicle_config(args.sysid or args.instance + 1)
    waits_s = longest_wait_s(config, world.sensor) if together else reading_s(world.sensor)
    config = replace(config, silence_s=config.silence_s + waits_s)
    if args.vehicle:
        if together:  # each has an id of its own, or a waypoint would be for two
            args.sysid = config.sysid
        return int(import_module(REAL_VEHICLE).run(args, orders, config))
    # All of a search have one home, the origin of what they search: that of the first one.
    config = at_own_home(config, max(args.instance + 1 - number, 0))
    if orders.berth:
        config = at_own_stand(config, orders.berth)
    vehicle = Vehicle(config)
    return fly(args, orders, lambda equipment, _: simulated_uav(vehicle, orders, equipment, number, fleet))


def _berth(args: argparse.Namespace, script: Script, fleet: Fleet, number: int) -> Berth:
    """Return a vehicle's place among several. Raises BadInput if it is real and has no origin."""
    world = script.simulated()
    starts = fleet.starts(world.start, world.seed, world.problem.ground)
    if args.vehicle and origin_of(args, script) is None:
        raise cli.BadInput(f"--home: wanted with --vehicle and --vehicles: {ORIGIN_WANTED}")
    return Berth(
        starts[number - 1],
        [start for other, start in enumerate(starts, 1) if other != number],
        fleet.separation_m,
        origin_of(args, script),
    )


def _place_in_fleet(args: argparse.Namespace, script: Script) -> tuple[Fleet, int]:
    """Return the fleet that a vehicle searches with, and its number there, from 1. Raises BadInput."""
    fleet = fleet_of(args, script)
    if fleet.vehicles == 1:
        if "number" in args.given:
            raise cli.BadInput("--number: it needs --vehicles N: one vehicle alone has no number")
        check_ids(args, 1)
        return fleet, 1
    number = args.number or args.instance + 1
    if number > fleet.vehicles:
        given, most = f"--number: {number} is not allowed; wanted 1", fleet.vehicles
        if not args.number:
            given, most = f"-I: {args.instance} is not allowed without --number; wanted 0", most - 1
        raise cli.BadInput(f"{given} to {most} (--vehicles)")
    if "instance" not in args.given:
        args.instance = number - 1
    check_ids(args, fleet.vehicles, number)
    args.namespace = args.namespace or f"search/{max(args.instance + 2 - number, 1)}"
    return fleet, number
