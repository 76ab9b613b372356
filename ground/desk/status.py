"""`plumeward status`: the state of each part of each vehicle on a router."""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from typing import Any

import msgspec
from rich.console import Console, Group
from rich.live import Live

from aircraft.together import searchers
from link import cli
from link.access.roles import MOST_VEHICLES
from link.bus.inbox import NAME
from link.bus.keys import HEALTH, OF_VEHICLE
from link.bus.messages import Health
from link.bus.opening import NoRouter
from link.bus.session import Arrival, Bus, LivelinessChange, part_of
from link.terminal import Column, table, tell, width_of
from scene.follow.parts import (
    MISSING,
    OK,
    PARTS,
    REFUSING,
    STALE,
    STALE_S,
    STARTING,
    in_order,
    verdict,
)

WATCH_EVERY_S = 1.0
LISTEN_S = 0.1  # how long it listens to all vehicles before it judges them again
FIRST = "uav/1"  # whose parts are missing where no vehicle is on the router
SHORTEST_STATE = 20  # characters of a part's state that a narrow terminal shows at least
COLOURS = {OK: "green", MISSING: "red", STARTING: "yellow", STALE: "red", REFUSING: "yellow"}


@dataclass
class Part:
    """What is known about one part."""

    alive: bool = False
    known_since_s: float = 0.0
    spoke_s: float = -math.inf  # Time of its last new message. The first one may be old, kept by the bus.
    health: Health | None = None


class Board:
    """Judges the parts by their messages. All times are of one clock, s."""

    def __init__(
        self, wanted: Iterable[str], alive: Iterable[str], now_s: float, *, only_wanted: bool = False
    ) -> None:
        """Start with the parts that must be there and those alive; `only_wanted` ignores all others.

        `uav` stands for all vehicles, if several search together.
        """
        self._wanted = set(wanted)
        self._only_wanted = only_wanted
        self._all_vehicles = not only_wanted or "uav" in self._wanted
        self._parts = {name: Part(known_since_s=now_s) for name in wanted}
        for name in alive:
            self.lives(name, True, now_s)

    def _part(self, name: str, now_s: float) -> Part | None:
        if name not in self._parts and not self._only_wanted:
            self._parts[name] = Part(known_since_s=now_s)
        return self._parts.get(name)

    @property
    def wanted(self) -> list[str]:
        """The parts that must be there."""
        return sorted(self._wanted)

    def _want(self, vehicles: Iterable[str], now_s: float) -> None:
        """Want vehicles of a search by several in place of the one that is elsewhere."""
        for name in vehicles if self._all_vehicles else ():
            self._wanted = self._wanted - {"uav"} | {name}
            self._parts.pop("uav", None)
            self._parts.setdefault(name, Part(known_since_s=now_s))

    def lives(self, name: str, alive: bool, now_s: float) -> None:
        """Take that a part appeared or disappeared."""
        if alive and name.startswith(OF_VEHICLE):
            self._want([name], now_s)
        part = self._part(name, now_s)
        if part and alive and not part.alive:
            self._parts[name] = Part(True, now_s)
        elif part and not alive:
            part.alive = False
            if name not in self._wanted:
                del self._parts[name]

    def hears(self, health: Health, now_s: float, name: str = "") -> None:
        """Take a part's health message. name: the part's, by default that of its service."""
        if health.service == "estimator":
            self._want(searchers(health.about), now_s)
        if part := self._part(name or health.service, now_s):
            if part.health is not None and health.uptime_s != part.health.uptime_s:
                part.spoke_s = now_s
            part.health = health

    def verdict(self, name: str, now_s: float) -> str:
        """Return the verdict on a part: ok, missing, starting, stale or refusing."""
        part = self._parts[name]
        return verdict(part.alive, part.health, now_s - max(part.spoke_s, part.known_since_s))

    def settled(self, now_s: float) -> bool:
        """Whether waiting longer is pointless: every part alive has spoken or had the time to."""
        return all(
            not part.alive or part.spoke_s >= part.known_since_s or now_s - part.known_since_s >= STALE_S
            for part in self._parts.values()
        )

    def report(self, now_s: float) -> dict[str, dict[str, Any]]:
        """Return verdict and last health message of each part by name, required parts first."""
        order = sorted(self._parts, key=lambda name: (name not in self._wanted, *in_order(name)))
        return {
            name: {
                "status": self.verdict(name, now_s),
                **(msgspec.to_builtins(health) if (health := self._parts[name].health) else {}),
            }
            for name in order
        }


def part_named(text: str) -> str:
    """Argument type: the name of a part."""
    if not all(map(NAME.fullmatch, text.split("/"))):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a part, such as agent or uav/1")
    return text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    cli.add_bus_arguments(parser, namespace=None)
    parser.add_argument(
        "--parts",
        type=cli.listed(part_named),
        metavar="NAME,NAME",
        help=f"show only these (default: {','.join(PARTS)} and all others there)",
    )
    parser.add_argument("--watch", action="store_true", help="repeat until interrupted")
    parser.add_argument(
        "--json", action="store_true", help="print one line of JSON, with --watch one each second"
    )


def run(args: argparse.Namespace) -> int:
    """Show the status once, or until interrupted; returns 0 if all parts of all vehicles are ok."""
    live = Live(console=Console(highlight=False), auto_refresh=False)
    known: dict[str, list[str]] = {}  # the parts that must be there, of each vehicle or search that was
    with live if args.watch and sys.stdout.isatty() and not args.json else nullcontext() as shown:
        while True:
            try:
                with ExitStack() as joined:
                    well = _look(joined, args, shown, known)
            except NoRouter as error:
                wanted = known or {args.namespace or FIRST: [*(args.parts or PARTS)]}
                missing = {
                    name: {part: {"status": MISSING} for part in sorted(parts, key=in_order)}
                    for name, parts in wanted.items()
                }
                well = _show(args, shown, str(error), missing)
            if not args.watch:
                return 0 if well else cli.FAILED
            time.sleep(WATCH_EVERY_S)


def _join(joined: ExitStack, args: argparse.Namespace, namespace: str | None) -> Bus:
    """Join the bus of a vehicle or of a search by several; without a namespace, the whole router."""
    return joined.enter_context(
        Bus(
            "status",
            args.connect,
            namespace,
            log_level=args.log_level,
            announced=False,
            secure=args.secure,
            vehicles=() if namespace is None else (1,),  # it then hears the health of all vehicles, if any
        )
    )


def _look(
    joined: ExitStack, args: argparse.Namespace, shown: Live | None, known: dict[str, list[str]]
) -> bool:
    """Listen until all verdicts are known, or with --watch for ever; returns whether all is well.

    known: the parts that must be there, by their namespaces; what is met is put there.

    Raises NoRouter when the router is gone.
    """
    router = None if args.namespace else _join(joined, args, None)
    met = {args.namespace} if args.namespace else {*known}
    vehicles: dict[str, tuple[Bus, Board]] = {}
    show_at, meet_at = math.inf, -math.inf
    while True:
        now_s = time.monotonic()
        if now_s >= meet_at:
            meet_at = now_s + WATCH_EVERY_S
            met |= router.vehicles() if router else set()
            order = sorted(met or {FIRST}, key=lambda name: (len(name), name))[:MOST_VEHICLES]
            vehicles = {
                name: vehicles.get(name) or _meet(joined, args, name, known.get(name)) for name in order
            }
        for bus, _ in vehicles.values():
            if not bus.connected:
                raise NoRouter(f"--connect: {bus.expiry() or f'the router at {args.connect} is gone'}")
        if now_s >= show_at or (
            math.isinf(show_at) and all(board.settled(now_s) for _, board in vehicles.values())
        ):
            well = _show(
                args, shown, "", {name: board.report(now_s) for name, (_, board) in vehicles.items()}
            )
            known |= {name: board.wanted for name, (_, board) in vehicles.items() if name in met}
            if not args.watch:
                return well
            show_at = now_s + WATCH_EVERY_S
        for bus, board in vehicles.values():
            _hear(bus, board, LISTEN_S / len(vehicles))


def _meet(
    joined: ExitStack, args: argparse.Namespace, namespace: str, known: list[str] | None
) -> tuple[Bus, Board]:
    """Join the bus of a vehicle, and begin to judge its parts: those that were known, if any."""
    bus = _join(joined, args, namespace)
    wanted = known or args.parts or PARTS
    board = Board(wanted, bus.services(), time.monotonic(), only_wanted=bool(args.parts))
    bus.watch_services()
    bus.subscribe(HEALTH)
    return bus, board


def _hear(bus: Bus, board: Board, for_s: float) -> None:
    """Give what a vehicle's parts say within a time to its board."""
    until_s = time.monotonic() + for_s
    while (left_s := until_s - time.monotonic()) > 0:
        match bus.receive(left_s):
            case LivelinessChange(service, alive):
                board.lives(service, alive, time.monotonic())
            case Arrival() as message:
                if (health := bus.decode(message, Health)) is not None:
                    board.hears(health, time.monotonic(), part_of(message.name))


def _show(
    args: argparse.Namespace,
    shown: Live | None,
    no_router: str,
    vehicles: dict[str, dict[str, dict[str, Any]]],
) -> bool:
    """Show a report of each vehicle; returns whether all is well."""
    reports = {
        name: {
            "ok": not no_router and all(part["status"] == OK for part in parts.values()),
            "ceased": bool(_knowing(parts)),
            "parts": parts,
        }
        for name, parts in vehicles.items()
    }
    well = all(report["ok"] for report in reports.values())
    if args.json:
        namespace, first = next(iter(reports.items()))
        print(
            json.dumps(
                {
                    "ok": well,
                    "namespace": namespace,
                    "router": {"endpoint": args.connect, "status": MISSING if no_router else OK},
                    "ceased": first["ceased"],
                    "parts": first["parts"],
                    "vehicles": reports,
                }
            ),
            flush=True,
        )
    else:
        told = Group(*(_table(args, no_router, name, parts) for name, parts in vehicles.items()))
        if shown:
            shown.update(told, refresh=True)
        else:
            tell(told, sys.stdout)
        if no_router and not args.watch:
            tell(f"error: {no_router}")
    return well


def _table(
    args: argparse.Namespace, no_router: str, namespace: str, parts: dict[str, dict[str, Any]]
) -> Group:
    verdicts = [MISSING if no_router else OK, *(part["status"] for part in parts.values())]
    told = [{}, *(part if "state" in part else {} for part in parts.values())]

    def column(
        heading: str,
        text: Callable[[dict[str, Any]], str],
        rank: int,
        *,
        left: bool = False,
        least: int | None = None,
    ) -> Column:
        return Column(
            heading,
            [text(part) if part else "" for part in told],
            rank,
            heading.partition(",")[0],
            left=left,
            least=least,
        )

    columns = [
        Column("part", ["router", *parts], left=True),
        Column("status", verdicts, left=True, styles=[COLOURS[verdict] for verdict in verdicts]),
        column("does", _state, 0, left=True, least=SHORTEST_STATE),
        column("step", lambda part: str(part["step"]) if part["step"] >= 0 else "", 1),
        column("per s", lambda part: f"{part['rate_hz']:.2f}", 2),
        column("latency, ms", lambda part: f"{1000 * part['latency_s']:.2f}", 3),
        column("up, s", lambda part: f"{part['uptime_s']:.0f}", 4),
    ]
    knowing = _knowing(parts)
    below = [f"the search has ceased, say {', '.join(knowing)}"] if knowing else []
    below += [line for name, part in parts.items() for line in _troubles(name, part)]
    return table(columns, width_of(sys.stdout), "--json", [f"{namespace} at {args.connect}"], below)


def _knowing(parts: dict[str, dict[str, Any]]) -> list[str]:
    """Return the parts that know of the stop."""
    return [name for name, part in parts.items() if part.get("ceased")]


def _state(part: dict[str, Any]) -> str:
    return f"{part['state']}: {part['about']}" if part["about"] else str(part["state"])


def _troubles(name: str, part: dict[str, Any]) -> list[str]:
    """Return a line with the messages that a part refused, and one for each warning and its last error."""
    refused = ", ".join(f"{count} {kind}" for kind, count in part.get("refused", {}).items())
    wrong = dict.fromkeys(filter(None, [*part.get("warnings", ()), part.get("last_error")]))
    return [f"{name} refused: {refused}"] * bool(refused) + [f"{name}: {text}" for text in wrong]
