"""`plumeward uav`: one vehicle alone, simulated or real."""

import argparse
import shlex
from importlib import import_module

from aircraft.search.command import Orders, fly
from aircraft.search.events import OnBoard
from aircraft.search.options import add_vehicle_url
from link import cli
from plume.problem import PAPER
from sitl.autopilot.vehicle import Vehicle
from sitl.script.options import script_for_vehicle, script_of
from sitl.uav.options import add_vehicle_arguments, at_own_home
from sitl.uav.simulated import simulated_uav

REAL_VEHICLE = "aircraft.remote.command"  # flies a real vehicle; loaded only then


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    cli.add_bus_arguments(parser)
    parser.set_defaults(connect=None, namespace=None)
    add_vehicle_arguments(parser, speedup=1.0)
    add_vehicle_url(parser)


def run(args: argparse.Namespace) -> int:
    """Fly until interrupted. Raises BadInput."""
    script = script_for_vehicle(script_of(args), args)
    chosen = "" if script.sensor == "gaussian" else f" --sensor {script.sensor}"
    chosen += "" if script.estimator.assume == "field" else f" --assume {script.estimator.assume}"
    if (told := script.problem.told) != PAPER:
        chosen += f" --problem {shlex.quote(told.text)}"
    orders = Orders(
        script.simulated(),
        script.speedup,
        [event for event in script.events if isinstance(event, OnBoard)],
        script.vehicle.after_stop,
        chosen,
    )
    config = script.vehicle_config(args.sysid or args.instance + 1)
    if args.vehicle:
        return int(import_module(REAL_VEHICLE).run(args, orders, config))
    vehicle = Vehicle(at_own_home(config, args.instance))
    return fly(args, orders, lambda equipment, _: simulated_uav(vehicle, orders, equipment))
