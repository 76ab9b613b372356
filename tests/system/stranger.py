"""A client written from docs/bus.md alone: plain Zenoh, pymavlink and JSON, without our code."""

import json
import math
import queue
import struct
import time
from collections.abc import Callable

import zenoh
from pymavlink.dialects.v20 import common as mavlink

from tests.conftest import wait_until


class Stranger:
    """Stands in for a vehicle, an agent or a viewer on the bus of vehicle 1."""

    def __init__(self, router: str, *tokens: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([router]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self._held: list[object] = []
        self.announce(*tokens)

    def __enter__(self) -> "Stranger":
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def announce(self, *tokens: str, namespace: str = "uav/1") -> None:
        """Say that it is there, as services do, by one liveliness token or more."""
        self._held += [self.session.liveliness().declare_token(f"{namespace}/{token}") for token in tokens]

    def subscribe(self, key: str) -> "queue.SimpleQueue[zenoh.Sample]":
        samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._held.append(self.session.declare_subscriber(f"uav/1/{key}", samples.put))
        return samples

    def publisher(self, key: str) -> Callable[..., None]:
        publisher = self.session.declare_publisher(
            f"uav/1/{key}", congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )
        self._held.append(publisher)
        wait_until(
            lambda: publisher.matching_status.matching
        )  # a message sent before the subscription is known reaches nobody
        return publisher.put

    def frames(self, *messages: object) -> bytes:
        return b"".join(bytes(message.pack(self.mav)) for message in messages)

    def reading(
        self, time_boot_ms: int, north: float = 4.0, east: float = 3.0, gas: float = 0.5, system: int = 1
    ) -> bytes:
        self.mav.srcSystem = system
        frames = self.frames(
            mavlink.MAVLink_local_position_ned_message(time_boot_ms, north, east, -5.0, 0.0, 0.0, 0.0),
            mavlink.MAVLink_wind_cov_message(
                time_boot_ms * 1000, -1.0, -2.0, 0.0, 0.0, 0.0, math.nan, 0.0, 0.0
            ),
            mavlink.MAVLink_named_value_float_message(time_boot_ms, b"gas", gas),
        )
        self.mav.srcSystem = 1
        return frames

    def waypoint(
        self, time_boot_ms: int, north: float, east: float, down: float = -5.0, system: int = 1
    ) -> bytes:
        return self.frames(
            mavlink.MAVLink_set_position_target_local_ned_message(
                time_boot_ms,
                system,
                1,
                mavlink.MAV_FRAME_LOCAL_NED,
                0xDF8,
                north,
                east,
                down,
                0,
                0,
                0,
                0,
                0,
                0,
                0,
                0,
            )
        )

    def announced(self) -> list[str]:
        """The liveliness tokens that are known here."""
        return [
            str(reply.ok.key_expr) for reply in self.session.liveliness().get("**") if reply.ok is not None
        ]

    def has_service(self, service: str) -> bool:
        return any(reply.ok is not None for reply in self.session.liveliness().get(f"uav/1/health/{service}"))


def messages(sample: zenoh.Sample) -> dict[str, object]:
    """The MAVLink messages of a payload, by type."""
    return {m.get_type(): m for m in mavlink.MAVLink(None).parse_buffer(sample.payload.to_bytes())}


def belief(sample: zenoh.Sample) -> dict:
    """The summary of a belief."""
    return json.loads(sample.payload.to_bytes())


def particles(sample: zenoh.Sample) -> list[tuple[float, float, float]]:
    """The particle array of a belief."""
    return list(struct.iter_unpack("<3f", sample.attachment.to_bytes()))


def nothing_more(samples: "queue.SimpleQueue[zenoh.Sample]", within_s: float = 0.5) -> bool:
    """True if nothing arrives within a time."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        if not samples.empty():
            return False
        time.sleep(0.01)
    return True
