"""A Zenoh router in this process: no other software is needed to fly."""

import argparse
import contextlib
import os
import resource
import time

import msgspec
import zenoh

from link import cli
from link.access.crowds import Crowds, most_of
from link.access.identity import identity
from link.access.reach import endpoint_is_open
from link.access.refusals import Refusals
from link.access.roles import ROUTER
from link.bus.keys import STOP
from link.bus.log import Log
from link.bus.messages import Stop, stop_text
from link.bus.opening import DEFAULT_ROUTER, open_router
from link.bus.session import SIGNAL_POLL_S
from link.bus.tally import Tally

# Zenoh's threads, read by the first session of a process. Each flood that waits for a full client holds a
# receiving one; by default there are two.
MORE_RECEIVERS = "(rx: (worker_threads: 8))"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "-l",
        "--listen",
        metavar="ENDPOINT",
        default=DEFAULT_ROUTER,
        help="where to listen (default: %(default)s)",
    )
    parser.add_argument(
        "-e", "--connect", metavar="ENDPOINT", help="join the router of another site; not with --secure"
    )
    cli.add_secure_argument(parser)


def _tell_stop(log: Log, sample: zenoh.Sample) -> None:
    with contextlib.suppress(
        msgspec.DecodeError, UnicodeDecodeError
    ):  # whoever it is for refuses and counts it
        stop = msgspec.json.decode(sample.payload.to_bytes(), type=Stop)
        log.info(f"{str(sample.key_expr).removesuffix(f'/{STOP.name}')}: {stop_text(stop)}")


def run(args: argparse.Namespace) -> int:
    """Route until interrupted. Prints the endpoint on stdout; port 0 is replaced by the chosen port.

    With --connect the parts of another site hear ours. With --secure, connections and refusals are logged.
    Raises BadInput.
    """
    if args.connect and args.secure:
        raise cli.BadInput("--connect: not with --secure, whose rules admit no other router")
    log = Log("router", "-", Tally())
    refusals = Refusals() if args.secure else None
    with contextlib.suppress(ValueError, OSError):  # each connection takes a file
        resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    os.environ.setdefault("ZENOH_RUNTIME", MORE_RECEIVERS)
    session, listening = open_router(args.listen, args.secure, args.connect)
    with session:
        print(listening, flush=True)
        if not args.secure and endpoint_is_open(args.listen):
            log.warning(
                f"{args.listen} is open to other machines: whoever reaches it can command the vehicle "
                "(--secure DIR admits by role)"
            )
        known = identity(args.secure, ROUTER, None) if args.secure else None
        crowds = Crowds(session)
        session.declare_subscriber(f"uav/*/{STOP.name}", lambda sample: _tell_stop(log, sample))
        while True:
            time.sleep(SIGNAL_POLL_S)  # all the work is in Zenoh's threads
            if known and (expiry := known.expiry()):
                log.warning(expiry)
                known = None
            if refusals:
                for name, count in crowds.closed().items():
                    refusals.count("sessions", f"the certificate {name} already holds {most_of(name)}", count)
                for level, line in refusals.news(time.monotonic()):
                    log.log(level, line)
