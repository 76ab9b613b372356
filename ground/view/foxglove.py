"""A live connection for Foxglove and Lichtblick: a WebSocket server on this machine that streams scenes.

Its protocol is https://github.com/foxglove/ws-protocol. foxglove-sdk has a server of it that we do not use:
it asks nobody for Host and Origin, so any web page of any browser on this machine may read it, it limits
neither viewers nor their messages, and it is 100 times as large as the schemas that we need.
"""

import asyncio
import base64
import contextlib
import json
import math
import struct
import time
from collections import deque
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from ground.view.access import AccessRules
from ground.view.serving import converse, guarded
from link.bus.keys import OF_VEHICLE
from link.bus.messages import Belief
from link.record.decoded import struct_schema
from scene.foxglove import Fix, SceneEncoder, schema_of
from scene.scene import Measurement, Scene

HOST = "127.0.0.1"
# Topic of the readings and what was believed after them, as JSON with the names that a record has: one
# layout plots both.
BELIEF_TOPIC = "belief"
PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")  # the protocol's names, the newer first
MESSAGE = struct.Struct("<BIQ")  # before a message: 1, the viewer's number for its topic, ns since 1970
MOST_VIEWERS = 20
MOST_UNREAD = 256  # messages for a viewer that reads slowly; more take the place of the oldest
LONGEST_REQUEST = 65536  # bytes of a message from a viewer
Number = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Said = tuple[int, bytes]  # time, ns since 1970, and data of a message


class _Subscription(msgspec.Struct, rename="camel"):
    id: Number
    channel_id: Number


class ViewerRequest(msgspec.Struct, rename="camel"):
    """What a viewer asks for. Of the protocol's other requests none is served, and none needs an answer."""

    op: str
    subscriptions: list[_Subscription] = []
    subscription_ids: list[Number] = []


class LiveFoxglove:
    """Streams the scenes of vehicles to every viewer that connects.

    Viewers can only look: the server takes no commands.

    The first vehicle has the topics and frames of a record; those of others begin with their names:
    `uav/2/scene/path`. Of a search by several they do not have what all vehicles share.
    """

    def __init__(self, port: int, origins: Sequence[str] = ()) -> None:
        """Take the port of this machine that it is served on, and the origins of web pages that may look."""
        self._rules = AccessRules(HOST, port, origins=tuple(origins), programs=True)
        self._loop = asyncio.get_running_loop()
        self._encoders: dict[str, SceneEncoder] = {}
        self._first = ""  # the vehicle whose topics have no prefix
        self._first_home: Fix | None = None
        self._measurements: dict[str, Measurement] = {}
        self._topics: dict[str, dict[str, Any]] = {}  # as they are announced
        self._newest: dict[str, Said] = {}  # of each topic
        self._viewers: set[_Viewer] = set()

    @property
    def address(self) -> str:
        """What to enter in Foxglove: ws://127.0.0.1:8765."""
        return f"ws://{HOST}:{self._rules.port}"

    def app(self) -> ASGIApp:
        """Return the application."""
        return guarded(Starlette(routes=[WebSocketRoute("/", self._join)]), self._rules)

    def show(self, scene: Scene) -> None:
        """Send what has changed in a vehicle's scene. One thread at a time may call it, any one."""
        now_ns, vehicle = time.time_ns(), scene.backdrop.vehicle
        search = (self._first or vehicle).rpartition(OF_VEHICLE)[0]  # `search/1/`; empty if it searches alone
        self._first = first = self._first or (f"{search}{OF_VEHICLE}1" if search else vehicle)
        together = bool(search) and vehicle.startswith(search + OF_VEHICLE)
        prefix = "" if vehicle == first else f"{vehicle.removeprefix(search)}/"
        encoder = self._encoders.setdefault(vehicle, SceneEncoder(prefix, aside=bool(prefix) and together))
        if not prefix:
            self._first_home = scene.home
        said: list[tuple[str, Any, bytes]] = list(encoder.encode(scene, now_ns, self._first_home))
        last = scene.measurements[-1] if scene.measurements else None
        if last is not None and last is not self._measurements.get(vehicle):
            self._measurements[vehicle] = last
            said.append((prefix + BELIEF_TOPIC, Belief, _belief(last)))
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._say, now_ns, said)

    def _say(self, now_ns: int, said: list[tuple[str, Any, bytes]]) -> None:
        for topic, kind, data in said:
            if topic not in self._topics:
                self._topics[topic] = {"id": len(self._topics), "topic": topic, **_announced(kind)}
            self._newest[topic] = now_ns, data
            for viewer in self._viewers:
                viewer.take(topic)

    async def _join(self, socket: WebSocket) -> None:
        protocol = next((name for name in PROTOCOLS if name in socket.scope["subprotocols"]), None)
        if protocol is None or len(self._viewers) >= MOST_VIEWERS:
            await socket.close()  # it was not accepted: the browser gets 403
            return
        await socket.accept(protocol)
        viewer = _Viewer(socket, self._topics, self._newest)
        self._viewers.add(viewer)
        try:
            await converse(socket, viewer.hear, viewer.speak)
        finally:
            self._viewers.discard(viewer)


class _Viewer:
    """One viewer. It gets the newest message of a topic when it subscribes, and all that come after it."""

    def __init__(self, socket: WebSocket, topics: dict[str, dict[str, Any]], newest: dict[str, Said]) -> None:
        self._socket, self._topics, self._newest = socket, topics, newest
        self._numbers: dict[str, int] = {}  # the viewer's own, of each topic that it wants
        self._waiting: deque[bytes] = deque(maxlen=MOST_UNREAD)
        self._wake = asyncio.Event()

    def take(self, topic: str) -> None:
        """Send it the newest message of a topic, if it wants the topic; and tell it of new topics."""
        if topic in self._numbers:
            time_ns, data = self._newest[topic]
            self._waiting.append(MESSAGE.pack(1, self._numbers[topic], time_ns) + data)
        self._wake.set()

    def hear(self, said: str | bytes) -> None:
        """Take a request; raises one of UNREADABLE if it is none."""
        if isinstance(said, bytes):
            return  # a message of its own: it may not publish
        request, names = msgspec.json.decode(said, type=ViewerRequest), list(self._topics)
        if request.op == "subscribe":
            for wanted in request.subscriptions:
                if wanted.channel_id < len(names):
                    name = names[wanted.channel_id]
                    self._numbers[name] = wanted.id
                    self.take(name)
        elif request.op == "unsubscribe":
            gone = request.subscription_ids
            self._numbers = {name: number for name, number in self._numbers.items() if number not in gone}

    async def speak(self) -> None:
        """Send it topics and messages as they come."""
        await self._socket.send_json({"op": "serverInfo", "name": "plumeward", "capabilities": []})
        announced = 0
        while True:
            self._wake.clear()
            if new := list(self._topics.values())[announced:]:
                await self._socket.send_json({"op": "advertise", "channels": new})
                announced += len(new)
            while self._waiting:
                await self._socket.send_bytes(self._waiting.popleft())
            await self._wake.wait()


def _announced(kind: Any) -> dict[str, str]:
    """Return how messages of a kind are announced: of Belief, or of a protobuf class."""
    if kind is Belief:
        schema = json.dumps(struct_schema(Belief))
        return {"encoding": "json", "schemaName": "Belief", "schema": schema, "schemaEncoding": "jsonschema"}
    name, described = schema_of(kind)
    schema = base64.b64encode(described).decode()
    return {"encoding": "protobuf", "schemaName": name, "schema": schema, "schemaEncoding": "protobuf"}


def _belief(said: Measurement) -> bytes:
    return json.dumps(
        {
            "step": said.step,
            "simulation_s": said.time_s,
            "position": said.position,
            **({"gas": said.gas} if math.isfinite(said.gas) else {}),  # JSON knows no NaN
            "spread": said.spread_m,
            "mean": said.estimate,
            "covariance": said.covariance,
            "ceased": said.ceased,
            "p_value": said.p_value,
            "evidence": said.evidence,
            "outside": said.outside,
            "intermittency": said.intermittency,
            "advised_dwell": said.advised_dwell_s,
            **({"wind": said.wind} if said.wind else {}),
            **(
                {"effective_sample_size": said.effective_sample_size}
                if math.isfinite(said.effective_sample_size)
                else {}
            ),
        }
    ).encode()
