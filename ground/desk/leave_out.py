"""`plumeward leave-out K`: an order to let a vehicle leave a search of several, or to begin without it."""

import argparse
import time

from aircraft.together import searching
from link import cli
from link.bus.keys import DEPARTURE, HEALTH, LATECOMER, LEAVE_OUT, OF_VEHICLE
from link.bus.messages import Departure, Health, Latecomer, LeaveOut, departure_text, latecomer_text
from link.bus.session import Arrival, Bus
from link.terminal import printable

REFUSED = f"refused {LEAVE_OUT.name}: "  # so the estimator begins, in its health, to say why
ANSWER_S = 5.0  # longest time until the estimator says that the vehicle has left


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.description = (
        "Let a vehicle leave a search of several. The others go on, and its readings are forgotten. With "
        "--late, let them begin without one that has not come yet."
    )
    parser.add_argument(
        "vehicle", type=cli.whole(1, cli.MOST_VEHICLES), metavar="K", help="the number of the vehicle: uav/K"
    )
    parser.add_argument(
        "--late",
        action="store_true",
        help="it has not come yet: the others begin without it, and it joins when it comes",
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
            return cli.failed(f"no estimator on {printable(args.namespace)}")
        said = [bus.decode(arrival, Health) for arrival in bus.kept(HEALTH, "estimator")]
        among = max((searching(health.about) for health in said if health), default=0)
        if among == 1 or (args.late and 0 < among < args.vehicle):
            several = f"{among} vehicles" if among > 1 else "1 vehicle"
            raise cli.BadInput(f"K: {args.vehicle} is not allowed; the estimator is for {several}")
        known = sorted(part for part in there if part.startswith(OF_VEHICLE))
        if args.late and f"{OF_VEHICLE}{args.vehicle}" in known:
            raise cli.BadInput(f"--late: uav/{args.vehicle} is there; wanted one that has not come")
        if not args.late and f"{OF_VEHICLE}{args.vehicle}" not in known:
            raise cli.BadInput(
                f"K: uav/{args.vehicle} is not there; wanted one of {', '.join(known) or 'several vehicles'}"
            )
        refused = max((_refusals(health) for health in said if health), default=0)
        bus.subscribe(LATECOMER if args.late else DEPARTURE, HEALTH)
        bus.publish(LEAVE_OUT, LeaveOut(args.vehicle, "left out by an operator", args.late))
        until_s = time.monotonic() + ANSWER_S
        while (left_s := until_s - time.monotonic()) > 0:
            item = bus.receive(left_s)
            if answer := _answer(bus, item, args.vehicle):
                print(answer)
                return 0
            if why := _refusal(bus, item, refused):
                return cli.failed(f"the estimator has {why}")
    return cli.failed(f"the estimator has not obeyed within {ANSWER_S:g} s; its log says why")


def _answer(bus: Bus, item: object, vehicle: int) -> str:
    """Return in words that a vehicle has left or comes late, if this says so."""
    if not isinstance(item, Arrival):
        return ""
    if item.key is LATECOMER:
        late = bus.decode(item, Latecomer)
        return latecomer_text(late) if late and late.vehicle == vehicle else ""
    left = bus.decode(item, Departure) if item.key is DEPARTURE else None
    return departure_text(left) if left and left.vehicle == vehicle else ""


def _refusal(bus: Bus, item: object, before: int) -> str:
    """Return in words that the estimator has refused more orders than before, if this says so."""
    if not isinstance(item, Arrival) or item.name != HEALTH.named("estimator"):
        return ""
    health = bus.decode(item, Health)
    is_ours = health and _refusals(health) > before and health.last_error.startswith(REFUSED)
    return printable(health.last_error) if health and is_ours else ""


def _refusals(health: Health) -> int:
    return health.refused.get("order", 0)
