"""QGroundControl as a script: the requests that it sends, in its order, with its retries (its Vehicle,
ParameterManager, PlanManager).

It has a socket and a dialect of its own, so that it decodes what the vehicle says without the vehicle's
code.
"""

import math
import socket
import struct
import time
import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

from pymavlink.dialects.v20 import development as mavlink

STATION, COMPONENT, AUTOPILOT = 255, 190, 1
PATIENCE_S = 30.0
ACK_S, ITEM_S, TRIES = 0.6, 0.25, 6
"""How long it waits for an answer and for an item of a plan, and how often it asks. QGroundControl waits
1.5 s and more for an answer.
"""
NO_PARAMETER = 0xFFFF
UINT32 = 5
MISSION, FENCE, RALLY = 0, 1, 2


class Item(NamedTuple):
    """An item of a plan."""

    frame: int
    command: int
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float


class Parameters(NamedTuple):
    """What a vehicle says of its parameters."""

    checksum: int
    """The vehicle's own, from `_HASH_CHECK`."""
    computed: int
    """From names and values, as QGroundControl computes it."""
    values: dict[str, float | int]


class QGroundControl:
    """One station at a free port. It sends its heartbeat whenever it listens."""

    def __init__(self, system: int = 1) -> None:
        self.system = system
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.05)
        self.port = int(self.socket.getsockname()[1])
        self.vehicle: tuple[str, int] | None = None
        self.beat_at = 0.0
        self.mavlink = mavlink.MAVLink(None, STATION, COMPONENT)
        self.mavlink.robust_parsing = True
        self.said: list[str] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    # ---- messages ----

    def send(self, message: Any) -> None:
        if self.vehicle:
            self.socket.sendto(message.pack(self.mavlink), self.vehicle)

    def receive(self) -> list[Any]:
        """Return the messages of the next datagram; none if there is none for a moment."""
        if time.monotonic() > self.beat_at:
            self.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 192, 0, 4, 3
                )
            )
            self.beat_at = time.monotonic() + 1
        try:
            datagram, self.vehicle = self.socket.recvfrom(65535)
        except TimeoutError:
            return []
        messages = self.mavlink.parse_buffer(datagram) or []
        self.said += [message.text for message in messages if message.get_type() == "STATUSTEXT"]
        return list(messages)

    def wait(self, holds: Callable[[Any], object], timeout_s: float = PATIENCE_S) -> Any | None:
        """Return the first message that holds; None if none comes in time."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            for message in self.receive():
                if holds(message):
                    return message
        return None

    def until(self, kind: str, holds: Callable[[Any], object] = bool) -> Any:
        """Return the first message of a kind that holds; fails if none comes."""
        found = self.wait(lambda message: message.get_type() == kind and holds(message))
        assert found, f"no such {kind} within {PATIENCE_S:g} s; the vehicle said {self.said[-5:]}"
        return found

    def until_said(self, text: str) -> None:
        """Wait for a text, which may come in chunks."""

        def heard(_: Any = None) -> bool:
            return text in "".join(self.said)

        assert heard() or self.wait(heard), self.said

    # ---- commands ----

    def command(self, number: int, *params: float, component: int = AUTOPILOT) -> int:
        """Send a COMMAND_LONG, again if need be; returns its MAV_RESULT."""
        padded = (*params, *[0.0] * (7 - len(params)))
        return self.acknowledged(
            number, lambda n: mavlink.MAVLink_command_long_message(self.system, component, number, n, *padded)
        )

    def command_int(
        self, number: int, frame: int, p1: float, p2: float, p3: float, p4: float, x: int, y: int, z: float
    ) -> int:
        """Send a COMMAND_INT, again if need be; returns its MAV_RESULT."""
        message = mavlink.MAVLink_command_int_message(
            self.system, AUTOPILOT, frame, number, 0, 0, p1, p2, p3, p4, x, y, z
        )
        return self.acknowledged(number, lambda _: message)

    def acknowledged(self, number: int, message: Callable[[int], Any]) -> int:
        for tries in range(TRIES):
            self.send(message(tries))
            if ack := self.wait(lambda m: m.get_type() == "COMMAND_ACK" and m.command == number, ACK_S):
                return int(ack.result)
        raise AssertionError(f"command {number} got no answer")

    def request(self, message_id: int, p2: float = 0.0) -> tuple[int, Any | None]:
        """Ask for a message; returns the MAV_RESULT and, if accepted, the message."""
        seen: list[Any] = []
        message = mavlink.MAVLink_command_long_message(
            self.system, AUTOPILOT, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, message_id, p2, 0, 0, 0, 0, 0
        )

        def is_wanted(m: Any) -> bool:
            return m.get_msgId() == message_id or m.get_type() == f"UNKNOWN_{message_id}"

        def noted(m: Any) -> bool:
            seen.append(m)
            return m.get_type() == "COMMAND_ACK" and m.command == mavlink.MAV_CMD_REQUEST_MESSAGE

        for _ in range(TRIES):
            self.send(message)
            ack = self.wait(noted, ACK_S)
            if ack and ack.result != mavlink.MAV_RESULT_ACCEPTED:
                return int(ack.result), None
            if wanted := next(filter(is_wanted, seen), None) or self.wait(is_wanted, ACK_S):
                return mavlink.MAV_RESULT_ACCEPTED, wanted
        raise AssertionError(f"message {message_id} was neither sent nor refused")

    def set_mode(self, custom_mode: int) -> None:
        """Change the mode with SET_MODE, as QGroundControl does with PX4, and wait for it."""
        self.send(
            mavlink.MAVLink_set_mode_message(
                self.system, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, custom_mode
            )
        )
        self.until("HEARTBEAT", lambda beat: beat.custom_mode == custom_mode)

    # ---- parameters ----

    def parameters(self) -> Parameters:
        """Load all parameters; those that are missing are asked for one by one."""
        found: dict[int, Any] = {}
        total, checksum = NO_PARAMETER, 0

        def noted(m: Any) -> bool:
            nonlocal total, checksum
            if m.get_type() != "PARAM_VALUE":
                return False
            if m.param_index < m.param_count:
                total = m.param_count
                found[m.param_index] = m
            elif m.param_id == "_HASH_CHECK":
                checksum = as_number(m.param_value, UINT32)
            return len(found) == total

        self.send(mavlink.MAVLink_param_request_list_message(self.system, AUTOPILOT))
        for _ in range(3 * TRIES):
            if self.wait(noted, 0.5):
                break
            if total == NO_PARAMETER:
                self.send(mavlink.MAVLink_param_request_list_message(self.system, AUTOPILOT))
            for index in sorted(set(range(total if total != NO_PARAMETER else 0)) - set(found))[:10]:
                self.send(mavlink.MAVLink_param_request_read_message(self.system, AUTOPILOT, b"", index))
        assert len(found) == total, f"{len(found)} parameters of {total}"
        computed = 0
        for _, m in sorted(found.items()):
            computed = crc32(m.param_id.encode(), computed)
            computed = crc32(struct.pack("<f", m.param_value), computed)
        return Parameters(
            checksum, computed, {m.param_id: as_number(m.param_value, m.param_type) for m in found.values()}
        )

    def set_parameter(self, name: str, value: float) -> float:
        """Set a float parameter; returns the value that the vehicle tells back."""
        for _ in range(TRIES):
            self.send(
                mavlink.MAVLink_param_set_message(
                    self.system, AUTOPILOT, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
                )
            )
            if told := self.wait(lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == name, ACK_S):
                return float(told.param_value)
        raise AssertionError(f"{name}: no answer")

    # ---- plans ----

    def upload(self, kind: int, items: Sequence[Item]) -> int:
        """Send a plan; returns the MAV_MISSION_RESULT."""
        message, left = mavlink.MAVLink_mission_count_message(self.system, AUTOPILOT, len(items), kind), TRIES
        kinds = ("MISSION_REQUEST_INT", "MISSION_REQUEST", "MISSION_ACK")
        while left:
            self.send(message)
            answer = self.wait(lambda m: m.get_type() in kinds and m.mission_type == kind, ACK_S)
            if answer is None:
                left -= 1
            elif answer.get_type() == "MISSION_ACK":
                return int(answer.type)
            else:
                left, item = TRIES, items[answer.seq]
                head = (self.system, AUTOPILOT, answer.seq, item.frame, item.command, int(answer.seq == 0), 1)
                message = mavlink.MAVLink_mission_item_int_message(
                    *head, *item.params, item.x, item.y, item.z, kind
                )
        raise AssertionError(f"plan {kind}: the vehicle fell silent")

    def download(self, kind: int) -> list[Item]:
        """Load a plan."""
        ask = mavlink.MAVLink_mission_request_list_message(self.system, AUTOPILOT, kind)
        count = self.repeated(
            ask, lambda m: m.get_type() == "MISSION_COUNT" and m.mission_type == kind, ACK_S
        ).count
        items = []
        for number in range(count):
            ask = mavlink.MAVLink_mission_request_int_message(self.system, AUTOPILOT, number, kind)
            m = self.repeated(
                ask,
                lambda m, n=number: (
                    m.get_type() == "MISSION_ITEM_INT" and (m.mission_type, m.seq) == (kind, n)
                ),
                ITEM_S,
            )
            items.append(Item(m.frame, m.command, (m.param1, m.param2, m.param3, m.param4), m.x, m.y, m.z))
        self.send(
            mavlink.MAVLink_mission_ack_message(self.system, AUTOPILOT, mavlink.MAV_MISSION_ACCEPTED, kind)
        )
        return items

    def clear(self, kind: int) -> int:
        """Remove a plan; returns the MAV_MISSION_RESULT."""
        ask = mavlink.MAVLink_mission_clear_all_message(self.system, AUTOPILOT, kind)
        return int(
            self.repeated(ask, lambda m: m.get_type() == "MISSION_ACK" and m.mission_type == kind, ACK_S).type
        )

    def repeated(self, ask: Any, holds: Callable[[Any], object], wait_s: float) -> Any:
        """Ask until there is an answer."""
        for _ in range(TRIES):
            self.send(ask)
            if answer := self.wait(holds, wait_s):
                return answer
        raise AssertionError(f"{ask.get_type()} got no answer")


def as_number(value: float, kind: int) -> float | int:
    """The value of a parameter: an integer lies bytewise in the float."""
    if kind == mavlink.MAV_PARAM_TYPE_REAL32:
        return value
    return int(struct.unpack("<I" if kind == UINT32 else "<i", struct.pack("<f", value))[0])


def crc32(data: bytes, crc: int) -> int:
    """QGC::crc32: the polynomial of zip, but begun with `crc` and not inverted."""
    return zlib.crc32(data, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


def place(north_m: float, east_m: float) -> tuple[int, int]:
    """Latitude and longitude of a place relative to the default home, 1e-7 degrees."""
    lat_deg, lon_deg, metres_a_degree = 47.397742, 8.545594, math.radians(6_371_000)
    lon_deg += east_m / metres_a_degree / math.cos(math.radians(lat_deg))
    return round((lat_deg + north_m / metres_a_degree) * 1e7), round(lon_deg * 1e7)


def waypoint(command: int, north_m: float, east_m: float, up_m: float, p1: float = 0.0) -> Item:
    """An item at a place relative to home."""
    return Item(
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
        command,
        (p1, 0.0, 0.0, math.nan),
        *place(north_m, east_m),
        up_m,
    )


def polygon(command: int, *corners: tuple[float, float]) -> list[Item]:
    """The corners of a fence."""
    return [
        Item(mavlink.MAV_FRAME_GLOBAL, command, (float(len(corners)), 0.0, 0.0, 0.0), *place(*corner), 0.0)
        for corner in corners
    ]


def same(one: Sequence[Item], other: Sequence[Item]) -> bool:
    """Whether two plans are the same; NaN equals NaN."""
    return [struct.pack("<2H4f2if", item[0], item[1], *item.params, *item[3:]) for item in one] == [
        struct.pack("<2H4f2if", item[0], item[1], *item.params, *item[3:]) for item in other
    ]
