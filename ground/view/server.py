"""The page's server: its files, and a WebSocket on which it gets scenes and gives commands."""

import asyncio
import contextlib
import math
import time
from collections import deque
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from aircraft.operator import CommandName
from ground.view.access import PROTOCOL, WORD_STATES, AccessRules, Doorkeeper, word_of
from ground.view.control import URGENT, CommandAnswer, operate
from ground.view.findings import FindingsOfRecords
from ground.view.live import LiveFleet, LiveVehicle
from ground.view.records import RecordedFleet, RecordedVehicle
from ground.view.serving import TRY_AGAIN_LATER, converse, guarded
from ground.view.wire import Sent, packed
from link.access.roles import MOST_VEHICLES
from plume import __version__

PAGE = Path(__file__).with_name("page")
MOST_CLIENTS = 20  # pages that may command, and pages that may only look
LONGEST_MESSAGE = 4096  # bytes of a message from the page
EVERY_S = 1 / 30  # shortest time between two live scenes of a vehicle
ASIDE_S = 0.2  # the same of one that is only on the map of another
MOST_COMMANDS, COMMANDS_S = 5, 1.0  # commands of a page within a time; more are refused, but for urgent ones
TOO_MANY = f"more than {MOST_COMMANDS} commands within {COMMANDS_S:g} s: wait a moment"
MOST_ANSWERS = 100  # a page that leaves this many answers to its commands unread is closed
UNDRAWN_S = 1.0  # after this long the next scene is sent, though the last one was not drawn

Fleet = LiveFleet | RecordedFleet
Vehicle = LiveVehicle | RecordedVehicle


class PageMessage(msgspec.Struct, forbid_unknown_fields=True):
    """What the page says: what it wants to see, which scene it has drawn, or a command to a vehicle."""

    show: Annotated[list[str], Meta(max_length=2)] | None = None
    beside: Annotated[list[str], Meta(max_length=MOST_VEHICLES)] = []  # on the map of the first one as well
    truth: bool = False
    at_s: float | None = None
    drawn: int | None = None
    command: CommandName | None = None
    vehicle: str = ""


def message_of(text: str | bytes) -> PageMessage:
    """Return a message from the page; raises one of UNREADABLE."""
    message = msgspec.json.decode(text, type=PageMessage)
    if (message.show, message.drawn, message.command) == (None, None, None):
        raise ValueError("not a message of the page: wanted one with show, drawn or command")
    return message


class PageServer:
    """Serves one list of vehicles to many pages."""

    def __init__(self, shown: Fleet, rules: AccessRules) -> None:
        self._shown = shown
        self._rules = rules
        self._door = Doorkeeper(rules)
        self._findings_of = FindingsOfRecords()
        self.clients: set[Client] = set()  # the pages that are connected
        self._commanded: dict[str, tuple[CommandName, asyncio.Task[CommandAnswer]]] = {}  # last, by vehicle
        self.bye = ""  # set when there will be nothing new to say; pages keep what they show
        self.left_at: float | None = None  # when the last page went, by time.monotonic()

    def app(self) -> ASGIApp:
        """Return the application."""
        app = Starlette(
            routes=[
                Route("/", self._index),
                WebSocketRoute("/scenes", self._scenes),
                Route("/findings/{name:path}", self._findings),
                Mount("/static", GZipMiddleware(StaticFiles(directory=PAGE, check_dir=False))),
            ]
        )
        app.router.redirect_slashes = False  # it fails on a query that is not UTF-8
        return guarded(app, self._rules)

    def news(self) -> None:
        """Wake all connections: there may be something new to see."""
        for client in self.clients:
            client.wake.set()

    async def _index(self, _request: Request) -> Response:
        return FileResponse(PAGE / "index.html")

    async def _findings(self, request: Request) -> Response:
        vehicle = self._shown.vehicles.get(request.path_params["name"])
        if not isinstance(vehicle, RecordedVehicle):
            return PlainTextResponse("no findings: there is no such record\n", 404)
        return await self._findings_of.page(vehicle.path)

    async def _scenes(self, socket: WebSocket) -> None:
        offered = socket.scope["subprotocols"]
        await socket.accept(PROTOCOL if PROTOCOL in offered else None)
        address = socket.client.host if socket.client else ""
        why_not = self._door.why_no_commands(word_of(offered), address, time.monotonic())
        client = Client(socket, self, self._shown, why_not)
        if sum(other.may_command == client.may_command for other in self.clients) >= MOST_CLIENTS:
            await socket.close(TRY_AGAIN_LATER, f"{MOST_CLIENTS} pages are open; close one of them")
            return
        self.clients.add(client)
        try:
            await client.run()
        finally:
            self.clients.discard(client)
            self.left_at = time.monotonic()

    async def order(self, name: CommandName, to: str) -> CommandAnswer:
        """Carry out a command from a page that may command."""
        vehicle = self._shown.vehicles.get(to)
        if not isinstance(vehicle, LiveVehicle):
            return CommandAnswer(False, f"there is no vehicle {to!r}")
        if self.bye:
            return CommandAnswer(False, self.bye)
        before, task = self._commanded.get(to, (name, None))
        if task is None or task.done() or before != name:
            if task and not task.done():
                if name not in URGENT:
                    return CommandAnswer(False, "the vehicle has not answered the last command yet")
                task.cancel()
            task = asyncio.create_task(operate(vehicle, name))
            self._commanded[to] = name, task
        await asyncio.wait([task])  # it goes on without the page that gave it
        return CommandAnswer(False, "an urgent command took its place") if task.cancelled() else task.result()


class Client:
    """One page. It gets the newest scene when it has drawn the last one, so none ever waits."""

    def __init__(self, socket: WebSocket, server: PageServer, shown: Fleet, why_not: str) -> None:
        """Serve a page; `why_not` says why it may not command."""
        self.wake = asyncio.Event()
        self._socket, self._server, self._shown = socket, server, shown
        self._live = not any(isinstance(each, RecordedVehicle) for each in shown.vehicles.values())
        self._why_not = why_not if self._live else "a record takes no commands"
        self.may_command = not self._why_not
        self._want = PageMessage(show=[])
        self._sent: dict[str, Sent] = {}
        self._number = 0
        self._answers: deque[dict[str, Any]] = deque()
        self._ordered_s: deque[float] = deque([-math.inf] * MOST_COMMANDS, MOST_COMMANDS)  # the last ones
        self._orders: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Serve it until it goes or breaks the contract."""
        try:
            await converse(self._socket, self._hear, self._speak)
        finally:
            for order in self._orders:
                order.cancel()

    # ---- from the page ----

    def _hear(self, text: str | bytes) -> None:
        message = message_of(text)
        if message.show is not None:
            self._want = message
        if message.drawn is not None:
            for sent in self._sent.values():
                sent.drawn = sent.drawn or sent.number <= message.drawn
        if message.command:
            self._order(message.command, message.vehicle)
            if len(self._answers) >= MOST_ANSWERS:
                raise ValueError("commands come faster than their answers are read")
        self.wake.set()

    def _order(self, name: CommandName, vehicle: str) -> None:
        def answered(answer: CommandAnswer) -> None:
            self._answers.append({"answer": {"vehicle": vehicle, "command": name, **answer._asdict()}})
            self.wake.set()

        async def carry_out() -> None:
            answered(await self._server.order(name, vehicle))

        now_s = time.monotonic()
        if self._why_not:
            answered(CommandAnswer(False, self._why_not))
        elif name not in URGENT and now_s - self._ordered_s[0] < COMMANDS_S:
            answered(CommandAnswer(False, TOO_MANY))
        else:
            if name not in URGENT:
                self._ordered_s.append(now_s)
            task = asyncio.create_task(carry_out())
            self._orders.add(task)
            task.add_done_callback(self._orders.discard)

    # ---- to the page ----

    async def _speak(self) -> None:
        await self._say(
            {
                "hello": {
                    "live": self._live,
                    "may_command": self.may_command,
                    "why_not": self._why_not,
                    "word": WORD_STATES.get(self._why_not, ""),
                    "version": __version__,
                }
            }
        )
        listed, bye_said = None, False
        while True:
            self.wake.clear()
            if listed != self._shown.list_version:
                listed = self._shown.list_version
                rows = [vehicle.entry() for vehicle in self._shown.vehicles.values()]
                await self._say({"vehicles": rows, "notice": self._shown.notice})
            while self._answers:
                await self._say(self._answers.popleft())
            bye, vehicles = self._server.bye, self._shown.vehicles
            wanted = [vehicles[name] for name in self._want.show or () if name in vehicles]
            waits_s = [await self._show(vehicle) for vehicle in wanted]
            aside = [vehicles[name] for name in self._want.beside if name in vehicles]
            waits_s += [await self._show(each, aside=True) for each in aside if each not in wanted]
            if bye and not bye_said and all(self._what(it) == self._sent[it.name].what for it in wanted):
                bye_said = True
                await self._say({"bye": bye})
            with contextlib.suppress(TimeoutError):  # Python 3.11's wait_for may swallow a cancellation
                async with asyncio.timeout(min(waits_s, default=UNDRAWN_S)):
                    await self.wake.wait()

    def _what(self, vehicle: Vehicle) -> tuple[object, ...]:
        """Return what identifies the scene that the page wants to see of a vehicle now."""
        seen_aside = vehicle.name not in (self._want.show or ())
        return vehicle.version, self._want.truth, None if self._live else self._want.at_s, seen_aside

    async def _show(self, vehicle: Vehicle, *, aside: bool = False) -> float:
        """Send a vehicle's scene if it is due; returns in how many seconds to look again.

        aside: only for the map of another vehicle, and less often.
        """
        want, sent, now_s = self._want, self._sent.setdefault(vehicle.name, Sent()), time.monotonic()
        what = self._what(vehicle)
        if what == sent.what:
            return UNDRAWN_S
        every_s = ASIDE_S if aside else EVERY_S
        due_s = sent.at_s + (UNDRAWN_S if not sent.drawn else every_s if self._live else 0.0)
        if now_s < due_s:
            return due_s - now_s
        self._number += 1
        data = await asyncio.to_thread(self._packed, vehicle, want, sent, aside)
        sent.number, sent.at_s, sent.drawn, sent.what = self._number, now_s, False, what
        await self._socket.send_bytes(data)
        return UNDRAWN_S

    def _packed(self, vehicle: Vehicle, want: PageMessage, sent: Sent, aside: bool) -> bytes:
        """Build and pack a scene; in another thread, as it may take long."""
        scene, mission, published_ms = vehicle.scene(None if self._live else want.at_s)
        truth = want.truth and not aside
        return packed(scene, sent, mission, self._number, truth=truth, published_ms=published_ms, aside=aside)

    async def _say(self, message: dict[str, Any]) -> None:
        await self._socket.send_text(msgspec.json.encode(message).decode())
