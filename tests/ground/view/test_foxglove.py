"""Protects the live connection for Foxglove: any viewer gets the whole scene, whenever it joins, and is no
web page of a stranger.
"""

import asyncio
import json
import socket
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import websockets
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from ground.view.foxglove import HOST, LONGEST_REQUEST, LiveFoxglove
from ground.view.serving import server_of
from link.bus.messages import Belief
from scene.foxglove import SceneEncoder, schema_of
from scene.scene import Backdrop, Craft, Measurement, Scatter, Scene

PLACES = np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)
SCENE = Scene(
    Backdrop("uav/1"),
    craft=Craft(1.0, (1.0, 2.0)),
    measurements=(Measurement(0, 1.0, (1.0, 2.0), 0.25, 3.0, (5.0, 6.0), (1.0, 0.0, 2.0)),),
    scatter=Scatter(PLACES, np.array([0.25, 0.75], np.float32)),
)
CLOUD = "scene/particles"
HANDSHAKE = (
    "GET / HTTP/1.1\r\nHost: {}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: "
    "MDEyMzQ1Njc4OWFiY2RlZg==\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)


@asynccontextmanager
async def streaming(*origins: str) -> AsyncIterator[LiveFoxglove]:
    """Serve it."""
    with socket.create_server((HOST, 0)) as listening:
        live = LiveFoxglove(listening.getsockname()[1], origins)
        server = server_of(live.app(), LONGEST_REQUEST, proxied=False)
        serving = asyncio.create_task(server.serve(sockets=[listening]))
        try:
            yield live
        finally:
            server.should_exit = server.force_exit = True
            await serving


class Viewer:
    """A viewer's end of the protocol."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.channels: dict[str, Any] = {}
        self.info: dict[str, Any] = {}
        self._topics: dict[int, str] = {}
        self._messages: deque[tuple[str, bytes]] = deque()

    @classmethod
    @asynccontextmanager
    async def joined(
        cls, address: str, protocol: str = "foxglove.sdk.v1", **how: Any
    ) -> AsyncIterator["Viewer"]:
        async with websockets.connect(
            address, subprotocols=[websockets.Subprotocol(protocol)], **how
        ) as socket:
            viewer = cls(socket)
            viewer.info = json.loads(await socket.recv())
            yield viewer

    async def subscribe(self, *topics: str) -> None:
        """Wait until these topics are announced, and ask for them."""
        while not set(topics) <= set(self.channels):
            await self._hear()
        first = len(self._topics)
        self._topics |= dict(enumerate(topics, first))
        wanted = [
            {"id": number, "channelId": self.channels[topic]["id"]}
            for number, topic in enumerate(topics, first)
        ]
        await self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    async def next(self) -> tuple[str, bytes]:
        """The topic and the data of the next message."""
        while not self._messages:
            await self._hear()
        return self._messages.popleft()

    async def _hear(self) -> None:
        said = await self.socket.recv()
        if isinstance(said, str):
            self.channels |= {channel["topic"]: channel for channel in json.loads(said).get("channels", ())}
        elif said[0] == 1:  # MESSAGE_DATA: subscription (4 bytes), time (8 bytes), payload
            self._messages.append((self._topics[int.from_bytes(said[1:5], "little")], said[13:]))


async def heard(address: str, topics: Sequence[str], **how: Any) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Join as a viewer does; returns the channels by topic, and the first message of each of these topics."""
    async with Viewer.joined(address, **how) as viewer:
        await viewer.subscribe(*topics)
        messages: dict[str, bytes] = {}
        while len(messages) < len(topics):
            topic, data = await viewer.next()
            messages[topic] = data
        return viewer.channels, messages


def run(test: Callable[[LiveFoxglove], Awaitable[Any]], *origins: str) -> Any:
    """Run a test beside the server."""

    async def both() -> Any:
        async with asyncio.timeout(60), streaming(*origins) as live:
            return await test(live)

    return asyncio.run(both())


def scatter(first: float) -> Scene:
    """A scene whose first particle lies so far east."""
    return Scene(
        Backdrop("uav/1"), scatter=Scatter(PLACES + np.float32(first - 1), np.array([0.5, 0.5], np.float32))
    )


def east(cloud: bytes) -> float:
    return float(np.frombuffer(PointCloud.FromString(cloud).data, "<f4")[0])


@pytest.mark.parametrize("protocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_a_viewer_that_joins_late_gets_the_whole_scene(protocol: str) -> None:
    topics = [CLOUD, "scene/area", "scene/transforms", "scene/path", "scene/estimate", "belief"]

    async def late(live: LiveFoxglove) -> Any:
        live.show(SCENE)
        return await heard(live.address, topics, protocol=protocol)

    channels, messages = run(late)
    assert (channels[CLOUD]["schemaName"], channels[CLOUD]["encoding"]) == ("foxglove.PointCloud", "protobuf")
    cloud = PointCloud.FromString(messages[CLOUD])
    assert np.frombuffer(cloud.data, "<f4").tolist() == [1.0, 2.0, 0.0, 0.25, 3.0, 4.0, 0.0, 0.75]
    belief = json.loads(messages["belief"])
    assert set(belief) - {"simulation_s"} <= set(Belief.__struct_fields__)  # a record's names
    assert (belief["step"], belief["gas"], belief["spread"], belief["mean"]) == (0, 0.25, 3.0, [5.0, 6.0])


def test_a_viewer_that_stays_gets_what_comes_and_the_topics_that_come_until_it_wants_no_more() -> None:
    async def staying(live: LiveFoxglove) -> None:
        async with Viewer.joined(live.address) as viewer, Viewer.joined(live.address) as other:
            live.show(scatter(1.0))
            for each in (viewer, other):
                await each.subscribe(CLOUD)
                assert await each.next() == (CLOUD, (await each_cloud(live)))
            live.show(scatter(2.0))
            assert [east((await each.next())[1]) for each in (viewer, other)] == [2.0, 2.0]
            live.show(SCENE)  # with readings: topics that were not there before
            assert east((await viewer.next())[1]) == 1.0
            await viewer.socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [0]}))
            await viewer.subscribe("belief")
            assert (await viewer.next())[0] == "belief"
            live.show(scatter(3.0))
            live.show(
                Scene(
                    SCENE.backdrop, measurements=(*SCENE.measurements, replace(SCENE.measurements[0], step=1))
                )
            )
            assert json.loads((await viewer.next())[1])["step"] == 1  # nothing of the cloud before it
            assert east((await other.next())[1]) == 1.0

    async def each_cloud(live: LiveFoxglove) -> bytes:
        return (await heard(live.address, [CLOUD]))[1][CLOUD]

    run(staying)


def test_a_second_vehicle_has_topics_and_frames_of_its_own() -> None:
    async def second(live: LiveFoxglove) -> Any:
        live.show(SCENE)
        live.show(Scene(Backdrop("uav/2"), scatter=Scatter(PLACES + 1, np.array([0.5, 0.5], np.float32))))
        return await heard(live.address, [CLOUD, f"uav/2/{CLOUD}"])

    _, messages = run(second)
    one, two = (PointCloud.FromString(messages[topic]) for topic in (CLOUD, f"uav/2/{CLOUD}"))
    assert (one.frame_id, two.frame_id) == ("map", "uav/2/map")
    assert np.frombuffer(two.data, "<f4")[:2].tolist() == [2.0, 3.0]


@pytest.mark.parametrize("order", [(1, 2), (2, 1)])
def test_of_a_search_by_several_the_second_vehicle_says_its_own_way_only(order: tuple[int, int]) -> None:
    async def second(live: LiveFoxglove) -> Any:
        for number in order:  # whoever is seen first
            live.show(replace(SCENE, backdrop=Backdrop(f"search/1/uav/{number}")))
        return await heard(live.address, [CLOUD, "uav/2/scene/path", "uav/2/belief"])

    channels, _ = run(second)
    assert f"uav/2/{CLOUD}" not in channels


# ---- who may look ----

APP = "https://app.foxglove.dev"


@pytest.mark.parametrize(
    ("origin", "host", "origins", "allowed"),
    [
        (None, "", (), True),  # a program
        ("file://", "", (), True),  # a desktop app that is made like a web page
        (None, "localhost:PORT", (), True),
        ("http://evil.example", "", (), False),
        ("http://evil.example:PORT", "evil.example:PORT", (), False),  # a page whose name was pointed here
        (None, "evil.example:PORT", (), False),
        ("null", "", (), False),
        ("http://localhost:3000", "", (), False),
        (APP, "", (), False),
        (APP, "", (APP,), True),
        ("http://evil.example", "", (APP,), False),
    ],
)
def test_programs_of_this_machine_may_look_and_web_pages_only_if_named(
    origin: str | None, host: str, origins: tuple[str, ...], allowed: bool
) -> None:
    async def looks(live: LiveFoxglove) -> None:
        live.show(SCENE)
        port = live.address.rpartition(":")[2]
        plain = socket.create_connection(("127.0.0.1", int(port)))
        named = websockets.Origin(origin.replace("PORT", port)) if origin else None
        await heard(
            f"ws://{(host or '127.0.0.1:PORT').replace('PORT', port)}", [CLOUD], origin=named, sock=plain
        )

    with nullcontext() if allowed else pytest.raises(websockets.InvalidStatus, match="403"):
        run(looks, *origins)


def test_who_speaks_another_protocol_is_refused() -> None:
    async def looks(live: LiveFoxglove) -> None:
        for protocols in (None, [websockets.Subprotocol("plumeward")]):
            with pytest.raises(websockets.InvalidStatus):
                await websockets.connect(live.address, subprotocols=protocols)

    run(looks)


@pytest.mark.parametrize(
    "said",
    [
        "nonsense",
        "[]",
        "{}",
        '{"op": 1}',
        '{"op": "subscribe", "subscriptions": 1}',
        '{"op": "subscribe", "subscriptions": [{"id": -1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 4294967296, "channelId": 0}]}',
        "[" * 60000,
        "x" * 70000,
    ],
)
def test_nonsense_closes_the_connection_of_who_said_it_and_of_nobody_else(said: str) -> None:
    async def both(live: LiveFoxglove) -> None:
        async with Viewer.joined(live.address) as good, Viewer.joined(live.address) as bad:
            await bad.socket.send(said)
            await bad.socket.wait_closed()
            live.show(SCENE)
            await good.subscribe(CLOUD)
            assert (await good.next())[0] == CLOUD

    run(both)


@pytest.mark.parametrize(
    "said",
    [
        '{"op": "getParameters", "parameterNames": [], "id": "1"}',
        '{"op": "subscribeConnectionGraph"}',
        b"\x01" + bytes(20),
        '{"op": "advertise", "channels": [{"id": 1, "topic": "/move", "encoding": "json", "schemaName": '
        '""}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 9, "channelId": 999}]}',
        '{"op": "unsubscribe", "subscriptionIds": [7]}',
    ],
)
def test_what_a_viewer_asks_for_that_is_not_served_does_no_harm(said: str | bytes) -> None:
    async def asks(live: LiveFoxglove) -> None:
        live.show(SCENE)
        async with Viewer.joined(live.address) as viewer:
            await viewer.socket.send(said)
            await viewer.subscribe(CLOUD)
            assert (await viewer.next())[0] == CLOUD

    run(asks)


def test_one_viewer_more_than_fit_is_refused_until_one_goes() -> None:
    async def many(live: LiveFoxglove) -> None:
        live.show(SCENE)
        open_now = [
            await websockets.connect(live.address, subprotocols=[websockets.Subprotocol("foxglove.sdk.v1")])
            for _ in range(20)
        ]
        with pytest.raises(websockets.InvalidStatus):
            await heard(live.address, [CLOUD])
        await open_now.pop().close()
        await heard(live.address, [CLOUD])
        for each in open_now:
            await each.close()

    run(many)


def test_a_viewer_that_reads_nothing_is_left_and_keeps_nobody_waiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ground.view.serving.SEND_S", 0.2)
    monkeypatch.setattr("ground.view.foxglove.MOST_VIEWERS", 2)
    many = np.zeros((100_000, 2), np.float32)

    async def deaf(live: LiveFoxglove) -> None:
        live.show(scatter(0.0))
        async with Viewer.joined(live.address, max_size=None) as hearing:
            await hearing.subscribe(CLOUD)
            reader, writer = await asyncio.open_connection("127.0.0.1", int(live.address.rpartition(":")[2]))
            wanted = (
                b'{"op":"subscribe","subscriptions":[{"id":0,"channelId":%d}]}'
                % hearing.channels[CLOUD]["id"]
            )
            frame = bytes([0x81, 0x80 | len(wanted), 0, 0, 0, 0]) + wanted  # a whole text, masked by zeros
            writer.write(HANDSHAKE.format(live.address.removeprefix("ws://")).encode())
            assert b" 101 " in await reader.readuntil(b"\r\n\r\n")
            writer.write(frame)
            for number in range(20):  # 32 MB: more than sockets hold
                live.show(
                    Scene(
                        Backdrop("uav/1"),
                        scatter=Scatter(many + np.float32(number), np.full(100_000, 1e-5, np.float32)),
                    )
                )
                while east((await hearing.next())[1]) != number:
                    pass
            while True:  # until the deaf one has made room
                try:
                    await heard(live.address, [CLOUD], max_size=None)
                    break
                except websockets.InvalidStatus:
                    assert not reader.at_eof()
            writer.close()

    run(deaf)


def test_it_says_what_foxglove_sdk_says() -> None:
    import foxglove as sdk

    context = sdk.Context()
    _, kind, data = next(each for each in SceneEncoder().encode(SCENE, 1) if each.topic == CLOUD)
    name, schema = schema_of(kind)
    channel = sdk.Channel(
        CLOUD,
        schema=sdk.Schema(name=name, encoding="protobuf", data=schema),
        message_encoding="protobuf",
        context=context,
    )

    async def ours(live: LiveFoxglove) -> Any:
        live.show(SCENE)
        return await both(live.address, lambda: None)

    async def both(address: str, joined: Callable[[], None]) -> Any:
        async with Viewer.joined(address) as viewer:
            await viewer.subscribe(CLOUD)
            joined()
            said = viewer.channels[CLOUD]
            return {name for name in viewer.info if name not in ("sessionId", "metadata")}, {
                key: said[key] for key in said if key != "id"
            }

    server = sdk.start_server(name="plumeward", host="127.0.0.1", port=0, context=context)
    try:
        theirs = asyncio.run(both(f"ws://127.0.0.1:{server.port}", lambda: channel.log(data)))
    finally:
        server.stop()
    assert run(ours) == theirs


def test_a_reading_without_a_value_leaves_the_gas_out() -> None:
    async def none(live: LiveFoxglove) -> Any:
        live.show(Scene(Backdrop("uav/1"), measurements=(replace(SCENE.measurements[0], gas=float("nan")),)))
        return await heard(live.address, ["belief"])

    assert "gas" not in json.loads(run(none)[1]["belief"])
