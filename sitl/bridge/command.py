"""`plumeward bridge`: joins the bus of a vehicle with MAVLink endpoints."""

import argparse
import signal
import sys

from link import cli
from link.bus.session import Bus
from sitl.bridge.address import ALLOWED, parse_address
from sitl.bridge.bridge import Bridge


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "urls",
        nargs="+",
        type=cli.checked(parse_address),
        metavar="URL",
        help=f"a MAVLink endpoint: {ALLOWED}. Ground stations and autopilots may be behind any of them",
    )
    cli.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Route until interrupted; stderr says how to connect, and at the end what went where."""
    addresses = [parse_address(url) for url in args.urls]
    if twice := next((address.text for at, address in enumerate(addresses) if address in addresses[:at]), None):
        print(f"error: URL: {twice} is given twice; wanted different endpoints", file=sys.stderr)
        return cli.BAD_INPUT
    with Bus("bridge", args.connect, args.namespace, log_level=args.log_level, secure=args.secure) as bus:
        try:
            bridge = Bridge(addresses, bus, f"bus {args.namespace}")
        except ValueError as error:
            print(f"error: URL: {error}", file=sys.stderr)
            return cli.BAD_INPUT
        bus.log.info(f"on the bus at {args.connect} as {args.namespace}")
        for address in addresses:
            bus.log.info(f"{address.text}: {address.other_side}")
            if address.open_to_all:
                bus.log.warning(f"{address.text} listens on all interfaces: whoever reaches port {address.port} can command the vehicle")
        for number in (signal.SIGINT, signal.SIGTERM):  # no KeyboardInterrupt, which could strike within a frame
            signal.signal(number, lambda *_: bridge.end())
        signal.set_wakeup_fd(bridge.wake_descriptor, warn_on_full_buffer=False)
        bus.publish_health()
        try:
            bridge.run()
        finally:
            signal.set_wakeup_fd(-1)
            bridge.close()
            for line in bridge.counts():
                bus.log.info(line)
    return 0
