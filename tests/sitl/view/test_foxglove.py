"""Protects the live connection for Foxglove: any viewer gets the whole scene, whenever it joins, and can only look."""

import asyncio
import json
import socket
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import websockets
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from scene.scene import Backdrop, Craft, Measurement, Scatter, Scene
from sitl.view.foxglove import LiveFoxglove, NoFoxglove

PLACES = np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)
SCENE = Scene(
    Backdrop("uav/1"),
    craft=Craft(1.0, (1.0, 2.0)),
    measurements=(Measurement(0, 1.0, (1.0, 2.0), 0.25, 3.0, (5.0, 6.0), (1.0, 0.0, 2.0)),),
    scatter=Scatter(PLACES, np.array([0.25, 0.75], np.float32)),
)


async def heard(address: str, topics: Sequence[str], protocol: str = "foxglove.sdk.v1") -> tuple[dict[str, Any], dict[str, bytes]]:
    """Join as a viewer does; returns the channels by topic, and the first message of each of these topics."""
    async with websockets.connect(address, subprotocols=[websockets.Subprotocol(protocol)]) as viewer:
        channels: dict[str, Any] = {}
        while not set(topics) <= set(channels):
            said = json.loads(await viewer.recv())
            channels |= {channel["topic"]: channel for channel in said.get("channels", ())}
        wanted = [{"id": number, "channelId": channels[topic]["id"]} for number, topic in enumerate(topics)]
        await viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        messages: dict[str, bytes] = {}
        while len(messages) < len(topics):
            said = await viewer.recv()
            if isinstance(said, bytes) and said[0] == 1:  # MESSAGE_DATA: subscription (4 bytes), time (8 bytes), payload
                messages[topics[int.from_bytes(said[1:5], "little")]] = said[13:]
        return channels, messages


def test_a_viewer_that_joins_late_gets_the_whole_scene() -> None:
    live = LiveFoxglove(0)
    try:
        live.show(SCENE)
        topics = ["scene/particles", "scene/area", "scene/transforms", "scene/path", "scene/estimate", "belief"]
        channels, messages = asyncio.run(asyncio.wait_for(heard(live.address, topics), 20.0))
    finally:
        live.close()
    assert (channels["scene/particles"]["schemaName"], channels["scene/particles"]["encoding"]) == ("foxglove.PointCloud", "protobuf")
    cloud = PointCloud.FromString(messages["scene/particles"])
    assert np.frombuffer(cloud.data, "<f4").tolist() == [1.0, 2.0, 0.0, 0.25, 3.0, 4.0, 0.0, 0.75]
    belief = json.loads(messages["belief"])
    assert (belief["step"], belief["gas"], belief["spread"], belief["mean"]) == (0, 0.25, 3.0, [5.0, 6.0])


def test_a_second_vehicle_has_topics_and_frames_of_its_own() -> None:
    live = LiveFoxglove(0)
    try:
        live.show(SCENE)
        live.show(Scene(Backdrop("uav/2"), scatter=Scatter(PLACES + 1, np.array([0.5, 0.5], np.float32))))
        _, messages = asyncio.run(asyncio.wait_for(heard(live.address, ["scene/particles", "uav/2/scene/particles"]), 20.0))
    finally:
        live.close()
    one, two = (PointCloud.FromString(messages[topic]) for topic in ("scene/particles", "uav/2/scene/particles"))
    assert (one.frame_id, two.frame_id) == ("map", "uav/2/map")
    assert np.frombuffer(two.data, "<f4")[:2].tolist() == [2.0, 3.0]


def test_it_listens_on_this_machine_only_and_frees_its_port() -> None:
    live = LiveFoxglove(0)
    port = int(live.address.rpartition(":")[2])
    with pytest.raises(NoFoxglove, match=f"^--foxglove: port {port} of 127.0.0.1 cannot be opened: .*in use"):
        LiveFoxglove(port)
    live.close()
    deadline = time.monotonic() + 10
    while True:  # its thread may need a moment to end
        try:
            socket.create_server(("127.0.0.1", port)).close()
            return
        except OSError:
            assert time.monotonic() < deadline


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_no_other_address_is_bound() -> None:
    live = LiveFoxglove(0)
    port = int(live.address.rpartition(":")[2])
    with open("/proc/net/tcp") as table:
        local = [line.split()[1] for line in table if line.split()[3] == "0A"]
    live.close()
    assert [address for address in local if address.endswith(f":{port:04X}")] == [f"0100007F:{port:04X}"]


def test_without_the_sdk_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(NoFoxglove, match=r"^--foxglove needs foxglove-sdk: pip install 'plumeward\[foxglove\]'$"):
        LiveFoxglove(0)


def test_a_reading_without_a_value_leaves_the_gas_out() -> None:
    live = LiveFoxglove(0)
    try:
        live.show(Scene(Backdrop("uav/1"), measurements=(Measurement(0, 1.0, (1.0, 2.0), float("nan"), 3.0, (5.0, 6.0), (1.0, 0.0, 2.0)),)))
        _, messages = asyncio.run(asyncio.wait_for(heard(live.address, ["belief"]), 20.0))
    finally:
        live.close()
    assert "gas" not in json.loads(messages["belief"])
