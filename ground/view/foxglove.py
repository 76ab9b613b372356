"""A live connection for Foxglove and Lichtblick: a WebSocket server on this machine that streams scenes.

Its protocol is https://github.com/foxglove/ws-protocol. foxglove-sdk has a server of it, but that asks
nobody for Host and Origin: any web page of any browser on this machine may read it.
"""

import asyncio
import base64
import contextlib
import json
import math
import socket
import struct
import time
from collections import deque
from collections.abc import Sequence
from functools import cache
from threading import Lock
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from ground.view.guard import AccessRules, Asgi, guarded
from ground.view.server import GONE, POLICY, SEND_S, UNDRAWN_S
from scene.foxglove import SceneEncoder, schema_of
from scene.scene import Measurement, Scene

HOST = "127.0.0.1"
BELIEF = "belief"
"""Topic of the readings and what was believed after them, as JSON with the names that a record has: one
layout plots both.
"""
PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""The protocol's names, the newer first."""
MESSAGE = struct.Struct("<BIQ")
"""What precedes a message: that it is one, the viewer's number for its topic, and its time, ns since 1970.
"""
MOST_VIEWERS = 20
MOST_WAITING = 256
"""Messages that wait for a viewer that reads slowly; more take the place of the oldest."""
LONGEST_REQUEST = 65536
"""Bytes of a message from a viewer."""
Number = Annotated[int, Meta(ge=0, le=2**32 - 1)]


class NoFoxglove(Exception):
    """The connection cannot be offered; the text is one line."""


class _Topic(NamedTuple):
    """A topic as it is announced."""

    name: str
    encoding: str
    schema_name: str
    schema: str


class _Subscription(msgspec.Struct, rename="camel"):
    id: Number
    channel_id: Number


class ViewerRequest(msgspec.Struct, rename="camel"):
    """What a viewer asks for. Of the protocol's other requests none is served, and none has to be
    answered.
    """

    op: str
    subscriptions: list[_Subscription] = []
    subscription_ids: list[Number] = []


def request_of(text: str | bytes) -> ViewerRequest:
    """Return a message from a viewer; raises ValueError if it is none."""
    try:
        return msgspec.json.decode(text, type=ViewerRequest)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None


class LiveFoxglove:
    """Streams the scenes of vehicles to every viewer that connects. Viewers can only look: the server
    takes no commands.

    The first vehicle has the topics and frames of a record; those of others begin with their names:
    `uav/2/scene/path`.
    """

    def __init__(self, port: int, origins: Sequence[str] = ()) -> None:
        """Take a port of this machine, 0 for any free one, and the origins of web pages that may look.
        Raises NoFoxglove, in one line.
        """
        try:
            self.listening = socket.create_server((HOST, port))
        except OSError as error:
            reason = str(error.strerror).partition(" (while")[0]
            raise NoFoxglove(f"--foxglove: port {port} of {HOST} cannot be opened: {reason}") from None
        self._rules = AccessRules(
            HOST, self.listening.getsockname()[1], origins=tuple(origins), programs=True
        )
        self._loop = asyncio.get_running_loop()
        self._lock = Lock()  # scenes come from another thread
        self._encoders: dict[str, SceneEncoder] = {}
        self._measurements: dict[str, Measurement] = {}
        self._topics: dict[str, _Topic] = {}
        """Those announced; a topic's number is its place."""
        self._said: dict[str, tuple[int, bytes]] = {}
        """The newest message of each topic, with its time."""
        self._viewers: set[_Viewer] = set()

    @property
    def address(self) -> str:
        """What to enter in Foxglove: ws://127.0.0.1:8765."""
        return f"ws://{HOST}:{self._rules.port}"

    def app(self) -> Asgi:
        """Return the application, which `listening` is for."""
        return guarded(Starlette(routes=[WebSocketRoute("/", self._join)]), self._rules)

    def show(self, scene: Scene) -> None:
        """Send what has changed in a vehicle's scene. Safe in any thread."""
        now_ns = time.time_ns()
        vehicle = scene.backdrop.vehicle
        with self._lock:
            prefix = "" if vehicle == next(iter(self._encoders), vehicle) else f"{vehicle}/"
            encoder = self._encoders.setdefault(vehicle, SceneEncoder(prefix))
            said: list[tuple[_Topic, bytes]] = []
            for name, kind, data in encoder.encode(scene, now_ns):
                said.append((_Topic(name, "protobuf", *_schema(kind)), data))
            last = scene.measurements[-1] if scene.measurements else None
            if last is not None and last is not self._measurements.get(vehicle):
                self._measurements[vehicle] = last
                said.append((_Topic(prefix + BELIEF, "json", "Belief", _belief_schema()), _belief(last)))
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._say, now_ns, said)

    def _say(self, now_ns: int, said: list[tuple[_Topic, bytes]]) -> None:
        for topic, data in said:
            self._topics.setdefault(topic.name, topic)
            self._said[topic.name] = now_ns, data
            for viewer in self._viewers:
                viewer.take(topic.name, now_ns, data)

    async def _join(self, viewer: WebSocket) -> None:
        protocol = next((name for name in PROTOCOLS if name in viewer.scope["subprotocols"]), None)
        if protocol is None or len(self._viewers) >= MOST_VIEWERS:
            await viewer.close()  # it was not accepted: the browser gets 403
            return
        await viewer.accept(protocol)
        joined = _Viewer(viewer, self._topics, self._said)
        self._viewers.add(joined)
        try:
            await joined.run()
        finally:
            self._viewers.discard(joined)


class _Viewer:
    """One viewer. It gets the newest message of a topic when it subscribes, and all that come after it."""

    def __init__(
        self, viewer: WebSocket, topics: dict[str, _Topic], said: dict[str, tuple[int, bytes]]
    ) -> None:
        self._socket, self._topics, self._said = viewer, topics, said
        self._numbers: dict[str, int] = {}
        """The viewer's own number of each topic that it wants."""
        self._waiting: deque[tuple[int, int, bytes]] = deque(maxlen=MOST_WAITING)
        self._wake = asyncio.Event()

    async def run(self) -> None:
        """Serve it until it goes or breaks the protocol."""
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(self._read())
                both.create_task(self._write())
        except* (*GONE, ValueError):
            with contextlib.suppress(*GONE):
                async with asyncio.timeout(UNDRAWN_S):
                    await self._socket.close(POLICY)

    def take(self, topic: str, time_ns: int, data: bytes) -> None:
        """Send it a message, if it wants the topic; and tell it of new topics."""
        if topic in self._numbers:
            self._waiting.append((self._numbers[topic], time_ns, data))
        self._wake.set()

    async def _read(self) -> None:
        while True:
            received = await self._socket.receive()
            if received["type"] == "websocket.disconnect":
                raise WebSocketDisconnect
            if text := received.get("text"):
                self._answer(request_of(text))

    def _answer(self, request: ViewerRequest) -> None:
        names = list(self._topics)
        if request.op == "subscribe":
            for wanted in request.subscriptions:
                if wanted.channel_id < len(names):
                    name = names[wanted.channel_id]
                    self._numbers[name] = wanted.id
                    self.take(name, *self._said[name])
        elif request.op == "unsubscribe":
            self._numbers = {
                name: number
                for name, number in self._numbers.items()
                if number not in request.subscription_ids
            }

    async def _write(self) -> None:
        await self._send({"op": "serverInfo", "name": "plumeward", "capabilities": []})
        told = 0
        while True:
            self._wake.clear()
            if new := list(self._topics.values())[told:]:
                await self._send(
                    {
                        "op": "advertise",
                        "channels": [_announced(told + at, topic) for at, topic in enumerate(new)],
                    }
                )
                told += len(new)
            while self._waiting:
                number, time_ns, data = self._waiting.popleft()
                async with asyncio.timeout(SEND_S):
                    await self._socket.send_bytes(MESSAGE.pack(1, number, time_ns) + data)
            await self._wake.wait()

    async def _send(self, message: dict[str, Any]) -> None:
        async with asyncio.timeout(SEND_S):
            await self._socket.send_text(json.dumps(message))


@cache
def _schema(kind: Any) -> tuple[str, str]:
    """Return the name of a protobuf class and its schema as it is announced."""
    name, schema = schema_of(kind)
    return name, base64.b64encode(schema).decode()


def _announced(number: int, topic: _Topic) -> dict[str, Any]:
    return {
        "id": number,
        "topic": topic.name,
        "encoding": topic.encoding,
        "schemaName": topic.schema_name,
        "schema": topic.schema,
        "schemaEncoding": "jsonschema" if topic.encoding == "json" else topic.encoding,
    }


def _belief(said: Measurement) -> bytes:
    fields: dict[str, Any] = {
        "step": said.step,
        "simulation_s": said.time_s,
        "position": said.position,
        "gas": said.gas,
        "spread": said.spread_m,
        "mean": said.estimate,
        "covariance": said.covariance,
        "ceased": said.ceased,
    }
    if not math.isfinite(said.gas):
        del fields["gas"]  # JSON knows no NaN
    return json.dumps(fields).encode()


def _belief_schema() -> str:
    number = {"type": "number"}
    numbers = {"type": "array", "items": number}
    fields = {
        "step": {"type": "integer"},
        "simulation_s": number,
        "position": numbers,
        "gas": number,
        "spread": number,
        "mean": numbers,
        "covariance": numbers,
        "ceased": {"type": "boolean"},
    }
    return json.dumps({"title": "Belief", "type": "object", "properties": fields})
