"""`plumeward bridge`: joins the bus of a vehicle with MAVLink endpoints."""

import argparse
from contextlib import ExitStack, closing

from aircraft.bridge.address import ALLOWED, parse_address, repeated
from aircraft.bridge.bridge import Bridge
from link import cli
from link.bus.session import Bus
from link.interrupts import on_end
from link.signing.key import read_key
from link.signing.signer import Signing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "urls",
        nargs="+",
        type=cli.checked(parse_address),
        metavar="URL",
        help=f"a MAVLink endpoint: {ALLOWED}. Ground stations and autopilots may be behind any of them",
    )
    parser.add_argument(
        "--sign",
        type=cli.checked(read_key),
        metavar="KEYFILE",
        help="sign MAVLink on all UDP and TCP endpoints, and refuse frames without a valid signature; the "
        "file holds 64 hexadecimal "
        "digits or a passphrase",
    )
    cli.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Route until interrupted; stderr says how to connect, and in the end what went where.

    Raises BadInput.
    """
    addresses = [parse_address(url) for url in args.urls]
    if twice := repeated(addresses):
        raise cli.BadInput(f"URL: {twice} is given twice; wanted different endpoints")
    if args.sign and all(address.kind == "serial" for address in addresses):
        raise cli.BadInput("--sign: serial lines are not signed; wanted it with a UDP or TCP endpoint")
    with ExitStack() as stack:
        bus = stack.enter_context(
            Bus("bridge", args.connect, args.namespace, log_level=args.log_level, secure=args.secure)
        )
        flag = "--sign"
        try:
            who = f"bridge-{args.namespace.replace('/', '-')}"
            signing = stack.enter_context(closing(Signing(args.sign, who, bus.log))) if args.sign else None
            flag = "URL"
            bridge = Bridge(addresses, bus, f"bus {args.namespace}", signing)
        except ValueError as error:
            raise cli.BadInput(f"{flag}: {error}") from None
        # Before it says that it is there; no KeyboardInterrupt, which could strike within a frame.
        on_end(lambda _: bridge.end())
        bus.log.info(f"on the bus at {args.connect} as {args.namespace}")
        bus.tell_fleet()
        for address in addresses:
            bus.log.info(f"{address.text}: {address.other_side}")
            if (risk := address.risk("command the vehicle")) and not args.sign:
                bus.log.warning(risk)
        bus.publish_health()
        try:
            bridge.run()
        finally:
            bridge.close()
            for line in bridge.counts():
                bus.log.info(line)
    return 0
