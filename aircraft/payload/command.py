"""`plumeward payload`: the gas sensor of a real autopilot."""

import argparse
import contextlib
import math

from aircraft.payload import service
from aircraft.payload.drivers import SENSOR_ERROR, Driven, Measure, opened
from aircraft.payload.messages import Question, Sample
from aircraft.payload.options import SIMULATED, add_payload_argument
from aircraft.payload.simulated import Simulated
from link import cli
from link.bus.inbox import Inbox
from link.bus.keys import OF_VEHICLE
from link.bus.log import Log
from link.bus.session import Bus
from plume.scenario import WorldError
from plume.worlds.world import World

OF_THE_PLUME = ("mission", "seed", "sensor", "dwell", "world")  # arguments of the simulated payload alone


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags, but for those of the simulated world."""
    add_payload_argument(parser)
    cli.add_bus_arguments(parser)
    parser.set_defaults(namespace=None)
    parser.add_argument(
        "--number",
        type=cli.whole(1, cli.MOST_VEHICLES),
        metavar="K",
        help="of vehicles that search together, the number of its own; the namespace is then their search's, "
        "search/1",
    )


def run(args: argparse.Namespace, world: World) -> int:
    """Answer the vehicle's questions until interrupted. world: what is simulated. Raises BadInput."""
    if args.payload != SIMULATED and (idle := [name for name in OF_THE_PLUME if name in args.given]):
        flag = "MISSION" if idle[0] == "mission" else f"--{idle[0]}"
        raise cli.BadInput(f"{flag}: only with --payload {SIMULATED}; {args.payload} measures what there is")
    inbox = Inbox()
    vehicles = [args.number] * bool(args.number)
    namespace = cli.namespace_of(args, bool(vehicles))
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(
            Bus(
                "payload",
                args.connect,
                namespace,
                inbox,
                args.log_level,
                secure=args.secure,
                vehicles=vehicles,
            )
        )
        own = "".join(f"/{OF_VEHICLE}{number}" for number in vehicles)
        bus.log.info(f"on the bus at {args.connect} as {namespace}{own}")
        bus.tally.about = args.payload
        measure: Measure = sensor_in(world.of_vehicle(args.number or 1), bus.log)
        if args.payload != SIMULATED:
            try:
                measure = driven = Driven(opened(args.payload, bus.log), bus.log)
            except ValueError as error:
                raise cli.BadInput(f"--payload: {error}") from None
            stack.callback(driven.close)
        service.run(bus, service.Measuring(measure, inbox))
    return 0


def sensor_in(world: World, log: Log) -> Measure:
    """Return a sensor in a world. Where the world fails it has no value, which the log says once."""
    simulated, told = Simulated(world), set[str]()

    def measure(question: Question) -> Sample:
        try:
            return simulated(question)
        except WorldError as error:
            log.tally.refuse(SENSOR_ERROR)
            if str(error) not in told:
                told.add(str(error))
                log.warning(str(error))
            return Sample(question.time_boot_ms, math.nan, question.wind)

    return measure
