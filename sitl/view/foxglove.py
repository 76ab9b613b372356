"""A live connection for Foxglove and Lichtblick: a WebSocket server on this machine that streams scenes."""

import json
import math
import time
from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any

from scene.foxglove import SceneEncoder, schema_of
from scene.scene import Measurement, Scene

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView, Client

HOST = "127.0.0.1"
BELIEF = "belief"
"""Topic of the readings and what was believed after them, as JSON with the names that a record has: one layout plots both."""


class NoFoxglove(Exception):
    """The connection cannot be offered; the text is one line."""


class LiveFoxglove:
    """Streams the scenes of vehicles to every viewer that connects. Viewers can only look: the server takes no commands.

    The first vehicle has the topics and frames of a record; those of others begin with their names: `uav/2/scene/path`.
    """

    def __init__(self, port: int) -> None:
        """Listen on a port of this machine, 0 for any free one. Raises NoFoxglove, in one line, if that fails."""
        try:
            import foxglove
        except ImportError:
            raise NoFoxglove("--foxglove needs foxglove-sdk: pip install 'plumeward[foxglove]'") from None
        self._context = foxglove.Context()
        self._channels: dict[str, Channel] = {}
        self._said: dict[str, tuple[bytes, int]] = {}
        self._lock = Lock()  # viewers join in another thread
        self._encoders: dict[str, SceneEncoder] = {}
        self._measurements: dict[str, Measurement] = {}
        try:
            self._server = foxglove.start_server(
                name="plumeward", host=HOST, port=port, context=self._context, server_listener=_Joining(self._repeat)
            )
        except (RuntimeError, OverflowError) as error:
            raise NoFoxglove(f"--foxglove: port {port} of {HOST} cannot be opened: {error}") from None

    @property
    def address(self) -> str:
        """What to enter in Foxglove: ws://127.0.0.1:8765."""
        return f"ws://{HOST}:{self._server.port}"

    def show(self, scene: Scene) -> None:
        """Send what has changed in a vehicle's scene."""
        now_ns = time.time_ns()
        vehicle = scene.backdrop.vehicle
        prefix = "" if vehicle == next(iter(self._encoders), vehicle) else f"{vehicle}/"
        encoder = self._encoders.setdefault(vehicle, SceneEncoder(prefix))
        for topic, kind, data in encoder.encode(scene, now_ns):
            self._send(topic, "protobuf", partial(schema_of, kind), data, now_ns)
        last = scene.measurements[-1] if scene.measurements else None
        if last is not None and last is not self._measurements.get(vehicle):
            self._measurements[vehicle] = last
            self._send(prefix + BELIEF, "json", _belief_schema, _belief(last), now_ns)

    def close(self) -> None:
        """Disconnect all viewers and free the port."""
        self._server.stop()

    def _send(self, topic: str, encoding: str, schema: Callable[[], tuple[str, bytes]], data: bytes, now_ns: int) -> None:
        if topic not in self._channels:
            from foxglove import Channel, Schema

            name, described = schema()
            about = Schema(name=name, encoding="jsonschema" if encoding == "json" else encoding, data=described)
            self._channels[topic] = Channel(topic, schema=about, message_encoding=encoding, context=self._context)
        with self._lock:
            self._said[topic] = data, now_ns
            self._channels[topic].log(data, log_time=now_ns)

    def _repeat(self, topic: str) -> None:
        """Send the newest message of a topic again, for a viewer that has just joined."""
        with self._lock:
            if topic in self._said:
                data, sent_ns = self._said[topic]
                self._channels[topic].log(data, log_time=sent_ns)


class _Joining:
    """Hears of viewers that subscribe to a topic."""

    def __init__(self, repeat: Callable[[str], None]) -> None:
        self._repeat = repeat

    def on_subscribe(self, client: "Client", channel: "ChannelView") -> None:
        self._repeat(channel.topic)

    def __getattr__(self, name: str) -> Any:
        """Take no notice of anything else."""
        return lambda *_: None


def _belief(said: Measurement) -> bytes:
    fields: dict[str, Any] = {
        "step": said.step, "simulation_s": said.time_s, "position": said.position, "gas": said.gas, "spread": said.spread_m,
        "mean": said.estimate, "covariance": said.covariance, "ceased": said.ceased,
    }  # fmt: skip
    if not math.isfinite(said.gas):
        del fields["gas"]  # JSON knows no NaN
    return json.dumps(fields).encode()


def _belief_schema() -> tuple[str, bytes]:
    number = {"type": "number"}
    numbers = {"type": "array", "items": number}
    fields = {
        "step": {"type": "integer"}, "simulation_s": number, "position": numbers, "gas": number, "spread": number, "mean": numbers,
        "covariance": numbers, "ceased": {"type": "boolean"},
    }  # fmt: skip
    return "Belief", json.dumps({"title": "Belief", "type": "object", "properties": fields}).encode()
