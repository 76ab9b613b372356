"""`plumeward payload`: the gas sensor of a real autopilot."""

import argparse
import contextlib

from aircraft.payload import service
from aircraft.payload.drivers import Driven, Measure, make, said
from aircraft.payload.options import SIMULATED, add_payload_argument
from aircraft.payload.simulated import Simulated
from link import cli
from link.bus.inbox import Inbox
from link.bus.session import Bus
from plume.worlds.world import World

OF_THE_PLUME = ("mission", "seed", "sensor", "dwell", "world")  # arguments of the simulated payload alone


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags, but for those of the simulated world."""
    add_payload_argument(parser)
    cli.add_bus_arguments(parser)


def run(args: argparse.Namespace, world: World) -> int:
    """Answer the vehicle's questions until interrupted. world: what is simulated. Raises BadInput."""
    if args.payload != SIMULATED and (idle := [name for name in OF_THE_PLUME if name in args.given]):
        flag = "MISSION" if idle[0] == "mission" else f"--{idle[0]}"
        raise cli.BadInput(f"{flag}: only with --payload {SIMULATED}; {args.payload} measures what there is")
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(
            Bus("payload", args.connect, args.namespace, inbox, args.log_level, secure=args.secure)
        )
        bus.log.info(f"on the bus at {args.connect} as {args.namespace}")
        bus.tally.about = args.payload
        measure: Measure = Simulated(world)
        if args.payload != SIMULATED:
            try:
                driver = make(args.payload, bus.log)
                driver.open()
            except ValueError as error:
                raise cli.BadInput(f"--payload: {error}") from None
            except Exception as error:  # a plug-in may be anybody's code
                raise cli.BadInput(f"--payload: {args.payload}: {said(error)}") from None
            stack.callback(driver.close)
            measure = Driven(driver, bus.log)
        service.run(bus, service.Measuring(measure, inbox))
    return 0
