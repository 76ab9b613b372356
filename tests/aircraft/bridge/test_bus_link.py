"""Protects the bridge from a flood on the bus: what waits is bounded by messages and by bytes, and what is
lost is counted.
"""

from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.bus_link import BusChannel
from link.bus.keys import MAVLINK_OUT, Key
from link.bus.log import Log
from link.bus.mavlink import Codec
from link.bus.session import Arrival
from link.bus.tally import Tally

HEARTBEAT = Codec(1, 1).pack(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3))


class FakeBus:
    """A bus on which the test speaks."""

    connected = True

    def __init__(self) -> None:
        self.log = Log("bridge", "test", Tally(), "error")
        self.hears: dict[str, Callable[[Arrival], None]] = {}

    def on(self, key: Key, arrived: Callable[[Arrival], None], **_: Any) -> None:
        self.hears[key.name] = arrived


def test_large_messages_fill_no_more_memory_than_their_limit_and_the_lost_ones_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("link.bus.inbox.WAITING_BYTES", 10_000)
    bus = FakeBus()
    channel = BusChannel(bus, "bus", lambda: None)  # type: ignore[arg-type]
    say = bus.hears[MAVLINK_OUT.name]
    for _ in range(30):
        say(Arrival(MAVLINK_OUT, bytes(900), b"a" * 100))
    assert len(channel.take()) == 10
    channel.tick()
    assert channel.traffic.dropped == {"bytes of garbage": 9000}
    assert bus.log.tally.refused["overflow"] == 20
    say(Arrival(MAVLINK_OUT, HEARTBEAT, b""))
    ((_, (frame,)),) = channel.take()
    assert frame.data == HEARTBEAT
    channel.close()
