"""`plumeward status`: the state of each part of a mission."""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import msgspec
from rich.console import Console, Group
from rich.live import Live

from link import cli
from link.bus.keys import HEALTH
from link.bus.messages import Health
from link.bus.opening import NoRouter
from link.bus.session import Arrival, Bus, LivelinessChange
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
        """Start with the parts that must be there and those alive; `only_wanted` ignores all others."""
        self._wanted = set(wanted)
        self._only_wanted = only_wanted
        self._parts = {name: Part(known_since_s=now_s) for name in wanted}
        for name in alive:
            self.lives(name, True, now_s)

    def _part(self, name: str, now_s: float) -> Part | None:
        if name not in self._parts and not self._only_wanted:
            self._parts[name] = Part(known_since_s=now_s)
        return self._parts.get(name)

    def lives(self, name: str, alive: bool, now_s: float) -> None:
        """Take that a part appeared or disappeared."""
        part = self._part(name, now_s)
        if part and alive and not part.alive:
            self._parts[name] = Part(True, now_s)
        elif part and not alive:
            part.alive = False
            if name not in self._wanted:
                del self._parts[name]

    def hears(self, health: Health, now_s: float) -> None:
        """Take a part's health message."""
        if part := self._part(health.service, now_s):
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    cli.add_bus_arguments(parser)
    parser.add_argument(
        "--parts",
        type=cli.listed(str),
        metavar="NAME,NAME",
        help=f"show only these (default: {','.join(PARTS)} and all others there)",
    )
    parser.add_argument("--watch", action="store_true", help="repeat until interrupted")
    parser.add_argument(
        "--json", action="store_true", help="print one line of JSON, with --watch one each second"
    )


def run(args: argparse.Namespace) -> int:
    """Show the status once, or until interrupted; returns 0 if all parts are ok."""
    live = Live(console=Console(highlight=False), auto_refresh=False)
    with live if args.watch and sys.stdout.isatty() and not args.json else nullcontext() as shown:
        while True:
            try:
                with Bus(
                    "status",
                    args.connect,
                    args.namespace,
                    log_level=args.log_level,
                    announced=False,
                    secure=args.secure,
                ) as bus:
                    well = _look(bus, args, shown)
            except NoRouter as error:
                well = _show(
                    args, shown, str(error), {name: {"status": MISSING} for name in args.parts or PARTS}
                )
            if not args.watch:
                return 0 if well else cli.FAILED
            time.sleep(WATCH_EVERY_S)


def _look(bus: Bus, args: argparse.Namespace, shown: Live | None) -> bool:
    """Listen until all verdicts are known, or with --watch for ever; returns whether all is well.

    Raises NoRouter when the router is gone.
    """
    board = Board(args.parts or PARTS, bus.services(), time.monotonic(), only_wanted=bool(args.parts))
    bus.watch_services()
    bus.subscribe(HEALTH)
    show_at = math.inf
    while True:
        now_s = time.monotonic()
        if not bus.connected:
            raise NoRouter(f"--connect: {bus.expiry() or f'the router at {args.connect} is gone'}")
        if now_s >= show_at or (math.isinf(show_at) and board.settled(now_s)):
            well = _show(args, shown, "", board.report(now_s))
            if not args.watch:
                return well
            show_at = now_s + WATCH_EVERY_S
        match bus.receive(timeout_s=0.1):
            case LivelinessChange(service, alive):
                board.lives(service, alive, time.monotonic())
            case Arrival() as message:
                if (health := bus.decode(message, Health)) is not None:
                    board.hears(health, time.monotonic())


def _show(
    args: argparse.Namespace, shown: Live | None, no_router: str, parts: dict[str, dict[str, Any]]
) -> bool:
    """Show a report; returns whether all is well."""
    well = not no_router and all(part["status"] == OK for part in parts.values())
    if args.json:
        print(
            json.dumps(
                {
                    "ok": well,
                    "namespace": args.namespace,
                    "router": {"endpoint": args.connect, "status": MISSING if no_router else OK},
                    "ceased": bool(_knowing(parts)),
                    "parts": parts,
                }
            ),
            flush=True,
        )
    else:
        told = _table(args, no_router, parts)
        if shown:
            shown.update(told, refresh=True)
        else:
            tell(told, sys.stdout)
        if no_router and not args.watch:
            tell(f"error: {no_router}")
    return well


def _table(args: argparse.Namespace, no_router: str, parts: dict[str, dict[str, Any]]) -> Group:
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
    return table(columns, width_of(sys.stdout), "--json", [f"{args.namespace} at {args.connect}"], below)


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
