"""What `plumeward uav` does for any vehicle: join the bus, open the links, fly until interrupted."""

import argparse
import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from aircraft.bridge.address import parse_out, repeated
from aircraft.search.clock import Clock
from aircraft.search.events import OnBoard
from aircraft.search.search import AfterStop
from aircraft.search.uav import Equipment, Speaker, Uav
from aircraft.state import VehicleFailed
from aircraft.together import Berth
from link import cli
from link.bus.inbox import Inbox
from link.bus.log import Log
from link.bus.opening import DEFAULT_ROUTER
from link.bus.session import Bus
from link.bus.tally import Tally
from link.signing.signer import Signing
from plume.worlds.world import World


@dataclass(frozen=True)
class Orders:
    """What a uav does, whichever its vehicle is."""

    world: World  # the mission's; of a real vehicle it is what a simulated payload measures
    speedup: float = 1.0
    events: Sequence[OnBoard] = ()
    after_stop: AfterStop = "return"
    estimator: str = ""  # flags that its estimator needs
    agent: str = ""  # flags that its agent needs
    number: int | None = None  # its number in a search of several vehicles; None: it searches alone
    berth: Berth | None = None  # its place among them


# Makes the service; what it opens is closed with the stack. Raises ValueError for a URL of `outs` that cannot
# be used.
Make = Callable[[Equipment, contextlib.ExitStack], Uav]


@contextlib.contextmanager
def given_by(flag: str) -> Iterator[None]:
    """Blame a flag for a ValueError. Raises BadInput."""
    try:
        yield
    except cli.BadInput:
        raise
    except ValueError as error:
        raise cli.BadInput(f"{flag}: {error}") from None


def fly(args: argparse.Namespace, orders: Orders, make: Make) -> int:
    """Fly until interrupted; returns the exit status. Raises BadInput."""
    outs = [parse_out(url, args.instance) for url in args.out]
    if twice := repeated(outs):
        raise cli.BadInput(f"--out: {twice} is given twice; wanted different endpoints")
    namespace, inbox = args.namespace or f"uav/{args.instance + 1}", Inbox()
    sysid, bus = args.sysid or args.instance + 1, None
    log = Log("uav", namespace, Tally(), args.log_level)
    if not args.out and not args.connect and not args.vehicle:
        usual = parse_out("udpout:127.0.0.1", args.instance)
        log.info(
            f"no client can connect by UDP without --out; --out {usual.text} is for {usual.other_side}; "
            "QGroundControl: port 14550"
        )
    with contextlib.ExitStack() as stack:
        if args.connect or args.vehicle or not args.out:
            endpoint = args.connect or DEFAULT_ROUTER
            bus = stack.enter_context(
                Bus(
                    "uav",
                    endpoint,
                    namespace,
                    inbox,
                    args.log_level,
                    secure=args.secure,
                    sole=True,
                    # A real one of several is not there for the others before it can take off.
                    announced=not (args.vehicle and orders.number),
                    vehicles=() if orders.number is None else (orders.number,),
                )
            )
            log = bus.log
            first = sysid if orders.number is None else sysid - orders.number + 1
            for line in _how_to_join(args, orders, endpoint, namespace, first):
                log.info(line)
        signing = None
        if args.sign:
            with given_by("--sign"):
                signing = stack.enter_context(contextlib.closing(Signing(args.sign, f"uav-{sysid}", log)))
        with given_by("--out"):
            urls = [out.text for out in outs]
            uav = make(Equipment(Clock(orders.speedup), inbox, bus, Speaker(log), urls, signing), stack)
        for out in outs:
            log.info(f"MAVLink to {out.text}; {out.other_side}")
            if (risk := out.risk("command the vehicle")) and not args.sign:
                log.warning(risk)
        try:
            uav.run()
        except VehicleFailed as failure:
            return cli.failed(failure)
    return 0


def _how_to_join(
    args: argparse.Namespace, orders: Orders, endpoint: str, namespace: str, sysid: int
) -> Iterator[str]:
    """Yield what the log says at first: where the vehicle is, and what starts the services that it needs."""
    needed = "payload, estimator and agent" if args.vehicle else "estimator and agent"
    ends = f"; gives up after {args.wait:g} s (--wait)" if args.vehicle else ""
    own = "" if orders.number is None else f"/uav/{orders.number}"
    needed += "" if orders.number is None else " and all vehicles"
    yield f"on the bus at {endpoint} as {namespace}{own}; takes off when {needed} are there{ends}"
    joining = f"--connect {endpoint} --namespace {namespace}"
    joining += f" --secure {args.secure}" if args.secure else ""
    who = "" if args.vehicle and not args.sysid else f" --sysid {sysid}"
    release = orders.world.scenario
    yield (
        f"its estimator: plumeward estimator {joining} --rate {release.q!r} --diffusivity "
        f"{release.d!r}{orders.estimator}{who}"
    )
    yield f"its agent: plumeward agent {joining}{orders.agent}{who}"
    if args.vehicle:
        number = "" if orders.number is None else f" --number {orders.number}"
        yield f"its payload: plumeward payload {joining}{number}"
