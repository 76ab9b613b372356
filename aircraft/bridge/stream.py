"""Frames cut out of the bytes that an endpoint delivers, with what routing needs to know of each."""

import re
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from link.bus.frames import MAVLINK_2, SIGNED, Frame, checksums, frame_at, frame_length
from link.bus.px4 import ADDED

MARKER = re.compile(rb"[\xfd\xfe]")
"""The first byte of a frame."""
MARKERS = frozenset(b"\xfd\xfe")
MOST_FALSE_STARTS = 500
"""Bytes in a delivery that look like the start of a frame and are none. Of noise one byte in 128 does;
only a flood comes this far.
"""
TEXT = bytes({*range(0x20, 0x7F), *b"\0\a\b\t\n\r\x1b"})
"""What a console prints, its escape sequences included."""
LONGEST_FRAME = 280
SIZES = {
    "char": 1,
    "int8_t": 1,
    "uint8_t": 1,
    "int16_t": 2,
    "uint16_t": 2,
    "int32_t": 4,
    "uint32_t": 4,
    "float": 4,
} | dict.fromkeys(("int64_t", "uint64_t", "double"), 8)
"""Bytes of each type of field."""
HEARTBEAT, TYPE_AT, AUTOPILOT_AT = mavlink.MAVLINK_MSG_ID_HEARTBEAT, 4, 5
NO_VEHICLES = frozenset(
    {
        mavlink.MAV_TYPE_GENERIC,
        mavlink.MAV_TYPE_ANTENNA_TRACKER,
        mavlink.MAV_TYPE_GCS,
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        mavlink.MAV_TYPE_GIMBAL,
        mavlink.MAV_TYPE_ADSB,
        mavlink.MAV_TYPE_CAMERA,
        mavlink.MAV_TYPE_CHARGING_STATION,
        mavlink.MAV_TYPE_FLARM,
        mavlink.MAV_TYPE_SERVO,
        mavlink.MAV_TYPE_ODID,
        mavlink.MAV_TYPE_BATTERY,
        mavlink.MAV_TYPE_LOG,
    }
)
"""Types in a HEARTBEAT that are no vehicle's, even if the sender forgot to say that it has no autopilot.
"""


class _Kind(NamedTuple):
    """What the bridge knows of a message type."""

    seed: bytes
    """CRC_EXTRA: the checksum covers this byte after the frame's own."""
    system_at: int
    """Offset of target_system in the payload; -1 if the type has none."""
    component_at: int


def _kind(message: Any) -> _Kind:
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    offsets, at = {}, 0
    for name, length in zip(message.ordered_fieldnames, message.array_lengths, strict=True):
        offsets[name] = at
        at += SIZES[types[name]] * max(length, 1)
    return _Kind(
        bytes([message.crc_extra]), offsets.get("target_system", -1), offsets.get("target_component", -1)
    )


KINDS = {number: _kind(message) for number, message in ({**ADDED, **mavlink.mavlink_map}).items()}
"""The message types of all of pymavlink's dialects, by number."""


class Letter(NamedTuple):
    """A frame, and what routing needs to know of it."""

    data: bytes
    """The frame as it came."""
    system: int
    component: int
    target_system: int = 0
    """0: all systems, also where the type is unknown or has no target."""
    target_component: int = 0
    """0: all components."""
    autopilot: bool = False
    """Whether it is the HEARTBEAT of a vehicle's autopilot."""
    message_id: int = HEARTBEAT


class FrameStream:
    """Cuts what one sender delivers into frames of MAVLink 1 and 2. Frames may be split over deliveries.

    A frame of an unknown type has no checksum that could be verified. It is believed where a frame must
    begin: at the start of a datagram or a connection, or right behind a good frame, and only if another
    frame or nothing follows it.
    """

    def __init__(self) -> None:
        """Start at the beginning of a connection."""
        self.garbage = 0
        """Bytes so far that belong to no frame."""
        self.opening = 0
        """How many of them came before the first frame and are text, or noise that is no longer than a
        frame.
        """
        self._noise_left = LONGEST_FRAME
        self._heard = False
        self.rest = b""
        """What came last and is no whole frame yet."""
        self._in_step = True
        """Whether a frame must begin where the rest begins."""

    def take(self, data: bytes, *, datagram: bool = False) -> list[Letter]:
        """Return the frames that are now complete; after MOST_FALSE_STARTS the rest of the delivery is
        garbage.

        Garbage cannot swallow a good frame that follows it, also not a frame's beginning whose end never
        comes.
        """
        boundary = len(self.rest) if datagram else -1
        data = self.rest + data
        letters: list[Letter] = []
        end = rest_at = len(data)
        at, used, first, false_starts, in_step, rest_in_step = 0, 0, 0, 0, self._in_step, False
        while (found := MARKER.search(data, at)) and false_starts < MOST_FALSE_STARTS:
            start = found.start()
            due = (in_step and start == at) or start == boundary
            frame = frame_at(data, start)
            if frame and _is_good(data, frame, due):
                first = first if letters else start
                letters.append(_letter(data, frame))
                at, in_step = frame.end, True
                used, rest_at = used + frame.end - start, end
            else:
                false_starts += 1
                if frame is None and rest_at == end and _may_begin(data[start : start + 3], end - start):
                    rest_at, rest_in_step = start, due
                at, in_step = start + 1, False
        if false_starts >= MOST_FALSE_STARTS:
            rest_at = end
        self._in_step = rest_in_step if rest_at < end else in_step and at == end
        self.rest = data[rest_at:]
        self.garbage += end - used - len(self.rest)
        if not self._heard:
            self._open(data[: first if letters else rest_at])
            self._heard = bool(letters)
        return letters

    def _open(self, data: bytes) -> None:
        """Take what came before the first frame: a console's text, and the frame in whose middle the line
        was opened.
        """
        noise = len(data.translate(None, TEXT))
        excused = min(noise, self._noise_left)
        self._noise_left -= excused
        self.opening += len(data) - noise + excused


def _may_begin(head: bytes, left: int) -> bool:
    """Whether a frame whose first bytes are `head` is longer than the bytes that are left."""
    if head[0] == MAVLINK_2 and len(head) == 3 and head[2] & ~SIGNED:
        return False
    return len(head) < 3 or left < frame_length(head, 0)


def _is_good(data: bytes, frame: Frame, due: bool) -> bool:
    kind = KINDS.get(frame.message_id)
    if kind is None:
        return due and (frame.end == len(data) or data[frame.end] in MARKERS)
    received, right = checksums(data, frame, kind.seed)
    return received == right


def _letter(data: bytes, frame: Frame) -> Letter:
    _, system_at, component_at = KINDS.get(frame.message_id, (b"", -1, -1))
    payload = data[frame.payload : frame.checksum]
    target = (
        payload[system_at] if 0 <= system_at < len(payload) else 0
    )  # MAVLink 2 omits zeros at the payload's end
    part = payload[component_at] if 0 <= component_at < len(payload) else 0
    autopilot = (
        frame.message_id == HEARTBEAT
        and len(payload) > AUTOPILOT_AT
        and payload[AUTOPILOT_AT] != mavlink.MAV_AUTOPILOT_INVALID
        and payload[TYPE_AT] not in NO_VEHICLES
    )
    return Letter(
        data[frame.start : frame.end],
        frame.system,
        frame.component,
        target,
        part if target else 0,
        autopilot,
        frame.message_id,
    )
