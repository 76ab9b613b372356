"""`plumeward leave-out K`: an order to let a vehicle leave a search of several, its readings forgotten."""

import argparse
import sys
import time

from link import cli
from link.bus.keys import DEPARTURE, LEAVE_OUT, OF_VEHICLE
from link.bus.messages import Departure, LeaveOut, departure_text
from link.bus.session import Arrival, Bus
from link.terminal import printable

ANSWER_S = 5.0  # longest time until the estimator says that the vehicle has left


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.description = (
        "Let a vehicle leave a search of several. The others go on, and its readings are forgotten."
    )
    parser.add_argument(
        "vehicle", type=cli.whole(1, cli.MOST_VEHICLES), metavar="K", help="the number of the vehicle: uav/K"
    )
    cli.add_bus_arguments(parser, namespace="search/1")


def run(args: argparse.Namespace) -> int:
    """Give the order, and wait until it is obeyed. Raises BadInput."""
    numbers = range(1, cli.MOST_VEHICLES + 1)
    with Bus(
        "view",
        args.connect,
        args.namespace,
        log_level=args.log_level,
        announced=False,
        secure=args.secure,
        vehicles=numbers,
    ) as bus:
        there = bus.services()
        if "estimator" not in there:
            print(f"error: no estimator on {printable(args.namespace)}", file=sys.stderr)
            return cli.FAILED
        known = sorted(part for part in there if part.startswith(OF_VEHICLE))
        if f"{OF_VEHICLE}{args.vehicle}" not in known:
            raise cli.BadInput(
                f"K: uav/{args.vehicle} is not there; wanted one of {', '.join(known) or 'several vehicles'}"
            )
        bus.subscribe(DEPARTURE)
        bus.publish(LEAVE_OUT, LeaveOut(args.vehicle, "left out by an operator"))
        until_s = time.monotonic() + ANSWER_S
        while (left_s := until_s - time.monotonic()) > 0:
            if left := _departure(bus, bus.receive(left_s), args.vehicle):
                print(departure_text(left))
                return 0
    print(
        f"error: uav/{args.vehicle} has not left within {ANSWER_S:g} s; the estimator's log says why",
        file=sys.stderr,
    )
    return cli.FAILED


def _departure(bus: Bus, item: object, vehicle: int) -> Departure | None:
    """Return that a vehicle has left, if this says so."""
    if not isinstance(item, Arrival) or item.key is not DEPARTURE:
        return None
    said = bus.decode(item, Departure)
    return said if said and said.vehicle == vehicle else None
