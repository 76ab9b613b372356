"""The page's server: its files, and a WebSocket on which it gets scenes and gives commands."""

import asyncio
import contextlib
import math
import time
from collections import deque
from pathlib import Path
from typing import Annotated, Any, Protocol

import msgspec
from msgspec import Meta
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from aircraft.operator import CommandName
from ground.view.control import URGENT, CommandAnswer, operate
from ground.view.guard import AccessRules, Asgi, guarded
from ground.view.live import LiveVehicle
from ground.view.wire import Cursor, packed
from ground.view.word import ASKS, PROTOCOL, Doorkeeper, word_of
from plume import __version__
from scene.scene import Scene

PAGE = Path(__file__).with_name("page")
MOST_CLIENTS = 20
"""Most pages that may command, and most that may only look."""
LONGEST_MESSAGE = 4096
"""Bytes of a message from the page."""
EVERY_S = 1 / 30
"""Shortest time between two live scenes of a vehicle."""
MOST_COMMANDS, COMMANDS_S = 5, 1.0
"""A page may give so many commands within this time; more are refused, but for the urgent ones."""
MOST_ANSWERS = 100
"""A page that leaves so many answers to its commands unread is closed."""
UNDRAWN_S = 1.0
"""After this long the next scene is sent, though the last one was not drawn."""
SEND_S = 5.0
"""A client that takes longer to read what was sent is gone."""
GONE = (WebSocketDisconnect, TimeoutError, RuntimeError)
"""What a send to a client that has gone raises; the last one if it went just before."""
TRY_AGAIN_LATER, POLICY = 1013, 1008
"""Reasons for closing a WebSocket, by its standard's numbers."""


class Showable(Protocol):
    """A vehicle to show, live or recorded."""

    name: str
    version: int

    def entry(self) -> dict[str, Any]:
        """Return its row of the list of vehicles."""

    def scene(self, at_s: float | None = None) -> tuple[Scene, object, float | None]:
        """Return the scene at a time, None for the newest; which mission it is of; when it was published,
        ms since 1970.
        """


class Fleet(Protocol):
    """All vehicles to show."""

    list_version: int
    notice: str

    @property
    def vehicles(self) -> "dict[str, Any]":
        """Each by its name."""

    def entries(self) -> list[dict[str, Any]]:
        """Return the list of vehicles."""


class Show(msgspec.Struct, forbid_unknown_fields=True):
    """What the page wants to see."""

    show: Annotated[list[str], Meta(max_length=2)]
    truth: bool = False
    at_s: float | None = None


class Drawn(msgspec.Struct, forbid_unknown_fields=True):
    """The number of a scene that the page has drawn."""

    drawn: int


class Order(msgspec.Struct, forbid_unknown_fields=True):
    """A command to a vehicle."""

    command: CommandName
    vehicle: str


KINDS: dict[str, type[Show | Drawn | Order]] = {"show": Show, "drawn": Drawn, "command": Order}


def message_of(text: str | bytes) -> Show | Drawn | Order:
    """Return a message from the page; raises ValueError with a line that says what is wrong."""
    try:
        fields = msgspec.json.decode(text, type=dict[str, msgspec.Raw])
        kind = next((KINDS[name] for name in fields if name in KINDS), None)
        if kind is None:
            raise ValueError(f"wanted a message with one of {', '.join(KINDS)}")
        return msgspec.json.decode(text, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None


class PageServer:
    """Serves one list of vehicles to many pages."""

    def __init__(self, shown: Fleet, rules: AccessRules, page: Path = PAGE) -> None:
        """Take what to show and who may do what."""
        self._shown = shown
        self._rules = rules
        self._door = Doorkeeper(rules)
        self._page = page
        self._clients: set[Client] = set()
        self._commanded: dict[str, tuple[CommandName, asyncio.Task[CommandAnswer]]] = {}
        """The last command of each vehicle, and what becomes of it."""
        self.bye = ""
        """Set when the server has nothing new to say any more; pages keep what they show."""
        self.left_at: float | None = None
        """When the last page went, by time.monotonic(); None if none was ever there."""

    def app(self) -> Asgi:
        """Return the application."""
        routes = [
            Route("/", self._index),
            WebSocketRoute("/scenes", self._scenes),
            Mount("/static", StaticFiles(directory=self._page, check_dir=False)),
        ]
        app = Starlette(routes=routes)
        app.router.redirect_slashes = False  # it fails on a query that is not UTF-8
        return guarded(app, self._rules)

    @property
    def watched(self) -> bool:
        """Whether a page is connected."""
        return bool(self._clients)

    def news(self) -> None:
        """Wake all connections: there may be something new to see."""
        for client in self._clients:
            client.wake.set()

    async def _index(self, _request: Request) -> Response:
        return FileResponse(self._page / "index.html")

    async def _scenes(self, socket: WebSocket) -> None:
        await socket.accept(PROTOCOL if PROTOCOL in socket.scope["subprotocols"] else None)
        client = Client(socket, self, self._shown, self._why_no_commands(socket))
        if sum(other.may_command == client.may_command for other in self._clients) >= MOST_CLIENTS:
            await socket.close(TRY_AGAIN_LATER, f"{MOST_CLIENTS} pages are open; close one of them")
            return
        self._clients.add(client)
        try:
            await client.run()
        finally:
            self._clients.discard(client)
            self.left_at = time.monotonic()

    def _why_no_commands(self, socket: WebSocket) -> str:
        """Return why a client may only look; empty if it may command."""
        address = socket.client.host if socket.client else ""
        return self._door.why_no_commands(word_of(socket.scope["subprotocols"]), address, time.monotonic())

    async def order(self, order: Order) -> CommandAnswer:
        """Carry out a command from a page that may command."""
        vehicle = self._shown.vehicles.get(order.vehicle)
        if not isinstance(vehicle, LiveVehicle):
            return CommandAnswer(False, f"there is no vehicle {order.vehicle!r}")
        if self.bye:
            return CommandAnswer(False, self.bye)
        name, task = self._commanded.get(order.vehicle, (order.command, None))
        if task and not task.done() and name != order.command:
            if order.command not in URGENT:
                return CommandAnswer(False, "the vehicle has not answered the last command yet")
            task.cancel()
        if task is None or task.done() or name != order.command:
            task = asyncio.create_task(operate(vehicle, order.command))
            self._commanded[order.vehicle] = order.command, task
        await asyncio.wait([task])  # it goes on without the page that gave it
        return CommandAnswer(False, "an urgent command took its place") if task.cancelled() else task.result()


class _Sent:
    """What was sent of one vehicle to one page."""

    def __init__(self) -> None:
        self.cursor = Cursor()
        self.number = -1
        self.at_s = -math.inf
        self.drawn = True
        self.what: object = None


class Client:
    """One page. It gets the newest scene when it has drawn the last one, so none ever waits."""

    def __init__(self, socket: WebSocket, server: PageServer, shown: Fleet, why_not: str) -> None:
        """Serve a page; `why_not` says why it may not command."""
        self.wake = asyncio.Event()
        self._socket, self._server, self._shown = socket, server, shown
        self._live = not any(vehicle.entry()["end_s"] is not None for vehicle in shown.vehicles.values())
        self._why_not = why_not if self._live else "a record takes no commands"
        self.may_command = not self._why_not
        self._want = Show([])
        self._sent: dict[str, _Sent] = {}
        self._number = 0
        self._answers: deque[dict[str, Any]] = deque()
        self._ordered_s: deque[float] = deque([-math.inf] * MOST_COMMANDS, MOST_COMMANDS)
        """When it gave its last commands."""
        self._listed: object = None
        self._bye = ""
        self._orders: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Serve it until it goes or breaks the contract."""
        tasks = [asyncio.create_task(self._read()), asyncio.create_task(self._write())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in (*tasks, *self._orders):
                each.cancel()
        for ended in await asyncio.gather(*tasks, *self._orders, return_exceptions=True):
            if isinstance(ended, Exception) and not isinstance(ended, GONE):
                raise ended
        with contextlib.suppress(*GONE):
            async with asyncio.timeout(UNDRAWN_S):
                await self._socket.close(POLICY, self._bye)

    # ---- from the page ----

    async def _read(self) -> None:
        while True:
            received = await self._socket.receive()
            if received["type"] == "websocket.disconnect":
                return
            try:
                message = message_of(received.get("text") or received.get("bytes") or b"")
            except ValueError as error:
                self._bye = f"not a message of the page: {error}"[:120]
                return
            match message:
                case Show():
                    self._want = message
                case Drawn(drawn=number):
                    for sent in self._sent.values():
                        sent.drawn = sent.drawn or sent.number <= number
                case Order():
                    self._order(message)
                    if len(self._answers) >= MOST_ANSWERS:
                        self._bye = "commands come faster than their answers are read"
                        return
            self.wake.set()
            await asyncio.sleep(0)  # a flood of one page leaves the others their turn

    def _order(self, order: Order) -> None:
        if self._why_not:
            self._answered(order, CommandAnswer(False, self._why_not))
            return
        now_s = time.monotonic()
        if order.command not in URGENT:
            if now_s - self._ordered_s[0] < COMMANDS_S:
                self._answered(
                    order,
                    CommandAnswer(
                        False, f"more than {MOST_COMMANDS} commands within {COMMANDS_S:g} s: wait a moment"
                    ),
                )
                return
            self._ordered_s.append(now_s)

        async def carry_out() -> None:
            self._answered(order, await self._server.order(order))

        task = asyncio.create_task(carry_out())
        self._orders.add(task)
        task.add_done_callback(self._orders.discard)

    def _answered(self, order: Order, answer: CommandAnswer) -> None:
        about = {
            "vehicle": order.vehicle,
            "command": order.command,
            "accepted": answer.accepted,
            "reason": answer.reason,
        }
        self._answers.append({"answer": about})
        self.wake.set()

    # ---- to the page ----

    async def _write(self) -> None:
        may, word = self.may_command, ASKS.get(self._why_not, "")
        hello = {
            "live": self._live,
            "may_command": may,
            "why_not": self._why_not,
            "word": word,
            "version": __version__,
        }
        await self._say({"hello": hello})
        told = False
        while True:
            self.wake.clear()
            if self._listed != self._shown.list_version:
                self._listed = self._shown.list_version
                await self._say({"vehicles": self._shown.entries(), "notice": self._shown.notice})
            while self._answers:
                await self._say(self._answers.popleft())
            bye, wanted = (
                self._server.bye,
                [self._shown.vehicles[name] for name in self._want.show if name in self._shown.vehicles],
            )
            waits_s = [await self._show(vehicle) for vehicle in wanted]
            if (
                bye
                and not told
                and all(self._what(vehicle) == self._sent[vehicle.name].what for vehicle in wanted)
            ):
                told = True
                await self._say({"bye": bye})
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(
                    min(waits_s, default=UNDRAWN_S)
                ):  # Python 3.11's wait_for may swallow a cancellation
                    await self.wake.wait()

    def _what(self, vehicle: Showable) -> tuple[object, ...]:
        """Return what identifies the scene that the page wants to see of a vehicle now."""
        return vehicle.version, self._want.truth, None if self._live else self._want.at_s

    async def _show(self, vehicle: Showable) -> float:
        """Send a vehicle's scene if it is due; returns in how many seconds to look again."""
        want, sent, now_s = self._want, self._sent.setdefault(vehicle.name, _Sent()), time.monotonic()
        what = self._what(vehicle)
        since_s = now_s - sent.at_s
        if since_s < UNDRAWN_S:
            if what == sent.what or not sent.drawn:
                return UNDRAWN_S - since_s
            if self._live and since_s < EVERY_S:
                return EVERY_S - since_s
        elif what == sent.what:
            return UNDRAWN_S
        self._number += 1
        data = await asyncio.to_thread(self._packed, vehicle, want, sent.cursor)
        sent.number, sent.at_s, sent.drawn, sent.what = self._number, now_s, False, what
        async with asyncio.timeout(SEND_S):
            await self._socket.send_bytes(data)
        return UNDRAWN_S

    def _packed(self, vehicle: Showable, want: Show, cursor: Cursor) -> bytes:
        """Build and pack a scene; in another thread, as it may take long."""
        scene, mission, published_ms = vehicle.scene(None if self._live else want.at_s)
        return packed(scene, cursor, mission, self._number, truth=want.truth, published_ms=published_ms)

    async def _say(self, message: dict[str, Any]) -> None:
        async with asyncio.timeout(SEND_S):
            await self._socket.send_text(msgspec.json.encode(message).decode())
