"""MAVLink 1 and 2 frames: found in bytes, checked, and read.

Only this file knows the wire format. The layout of each message type comes from pymavlink's dialects and
`px4.py`; pymavlink's own parser is not used: it takes 10 µs a frame, and a vehicle at --speedup 0 sends
thousands a second.
"""

import itertools
import re
import struct
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.bus.px4 import ADDED, CODES

MAVLINK_1, MAVLINK_2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
# Behind magic, length, flags and sequence number: system, component, and message id (MAVLink 2: low, high).
HEADER_1, HEADER_2 = struct.Struct("<3xBBB"), struct.Struct("<5xBBHB")
CHECKSUM, SIGNATURE = 2, mavlink.MAVLINK_SIGNATURE_BLOCK_LEN
SIGNED = mavlink.MAVLINK_IFLAG_SIGNED
SHORTEST = HEADER_1.size + CHECKSUM  # bytes of the shortest frame: MAVLink 1 without payload
LONGEST = HEADER_2.size + 255 + CHECKSUM + SIGNATURE
MARKER = re.compile(rb"[\xfd\xfe]")  # the first byte of a frame
# Of HEARTBEAT: its number, and where type and autopilot are in its payload.
HEARTBEAT, TYPE_AT, AUTOPILOT_AT = mavlink.MAVLINK_MSG_ID_HEARTBEAT, 4, 5
# Types in a HEARTBEAT that are no vehicle's, even if the sender forgot to say that it has no autopilot.
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

crc16 = mavlink.mcrf4xx or (lambda data: mavlink.x25crc(data).crc)


# ---- one frame ----


class Frame(NamedTuple):
    """A whole frame: its bytes, and the fields of its header."""

    data: bytes  # all of it, from its marker to its checksum or signature
    message_id: int
    system: int
    component: int

    @property
    def payload(self) -> bytes:
        """Its payload. MAVLink 2 omits zeros at the end."""
        begin = HEADER_2.size if self.data[0] == MAVLINK_2 else HEADER_1.size
        return self.data[begin : begin + self.data[1]]

    @property
    def target(self) -> tuple[int, int]:
        """The system and component that it is for; 0, for all, if its type is unknown or has no target."""
        layout = layouts().get(self.message_id)
        system, component = (self._byte(at) for at in layout.target_at) if layout else (0, 0)
        return system, component if system else 0

    @property
    def is_autopilot(self) -> bool:
        """Whether it is the HEARTBEAT of a vehicle's autopilot."""
        return (
            self.message_id == HEARTBEAT
            and self._byte(AUTOPILOT_AT) != mavlink.MAV_AUTOPILOT_INVALID
            and self._byte(TYPE_AT) not in NO_VEHICLES
        )

    def _byte(self, at: int) -> int:
        """Return a byte of the payload; 0 where it is omitted, or if `at` is negative."""
        payload = self.payload
        return payload[at] if 0 <= at < len(payload) else 0


def frame_at(data: bytes, start: int = 0) -> Frame | None:
    """Return the frame that begins at `start`, judged by its header.

    None if no whole frame begins there, or if its flags are unknown: receivers must drop those. It does
    not verify the checksum (see `checksums`).
    """
    left = len(data) - start
    length = frame_length(data, start) if left >= SHORTEST else 0
    if not 0 < length <= left:
        return None
    if data[start] == MAVLINK_1:
        system, component, message_id = HEADER_1.unpack_from(data, start)
    else:
        system, component, low, high = HEADER_2.unpack_from(data, start)
        message_id = low | high << 16
    return Frame(data[start : start + length], message_id, system, component)


def frame_length(data: bytes, start: int) -> int:
    """Return the length of the frame whose first three bytes are at `start`; 0 if they begin no frame."""
    magic, length, flags = data[start : start + 3]
    if magic == MAVLINK_1:
        return HEADER_1.size + length + CHECKSUM
    if magic != MAVLINK_2 or flags not in (0, SIGNED):
        return 0
    return HEADER_2.size + length + CHECKSUM + (SIGNATURE if flags else 0)


def checksums(frame: Frame, seed: bytes) -> tuple[int, int]:
    """Return a frame's checksum as received and as computed.

    seed: the extra byte (CRC_EXTRA) of its message type.
    """
    data = frame.data
    at = data[1] + (HEADER_2.size if data[0] == MAVLINK_2 else HEADER_1.size)
    return data[at] | data[at + 1] << 8, crc16(data[1:at] + seed)


def frames_in(payload: bytes) -> Iterator[Frame]:
    """Yield the frames of a payload, judged by their headers alone, until something else comes."""
    at = 0
    while frame := frame_at(payload, at):
        yield frame
        at += len(frame.data)


# ---- the fields of a frame ----


class Layout(NamedTuple):
    """How a message type is laid out in its payload."""

    kind: str
    size: int
    seed: bytes  # CRC_EXTRA: the checksum covers this byte after the frame's own
    unpack: Callable[[bytes], tuple[Any, ...]]
    counts: dict[str, int]  # array length of each field, in wire order; 1 for a single value or a text
    plain: bool  # true if no field is an array or text
    target_at: tuple[int, int]  # offsets of target_system and target_component; -1 if it has none


def _layout(message: Any) -> Layout:
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    lengths = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))  # 0: no array
    counts = {name: 1 if types[name] == "char" else max(length, 1) for name, length in lengths.items()}
    sizes = [struct.calcsize(f"={CODES[types[name]]}") * max(length, 1) for name, length in lengths.items()]
    offsets = dict(zip(lengths, itertools.accumulate([0, *sizes]), strict=False))
    return Layout(
        message.msgname,
        message.unpacker.size,
        bytes([message.crc_extra]),
        message.unpacker.unpack,
        counts,
        set(counts.values()) == {1} and "char" not in types.values(),
        (offsets.get("target_system", -1), offsets.get("target_component", -1)),
    )


# The message types that the vehicle speaks, by number.
DIALECT: dict[int, Any] = {**mavlink.mavlink_map, **ADDED}
LAYOUTS = {message_id: _layout(message) for message_id, message in DIALECT.items()}


@cache
def layouts() -> dict[int, Layout]:
    """Return the layouts of the message types of all of pymavlink's dialects, by number.

    Only what routes frames of strangers needs them: they take 0.1 s to load.
    """
    from pymavlink.dialects.v20 import all as every

    return {number: _layout(message) for number, message in every.mavlink_map.items()} | LAYOUTS


def fields_of(frame: Frame) -> dict[str, Any]:
    """Return the fields of a frame of a type in LAYOUTS, with the values that pymavlink gives them."""
    layout = LAYOUTS[frame.message_id]
    values = layout.unpack(frame.payload[: layout.size].ljust(layout.size, b"\0"))
    return dict(zip(layout.counts, values, strict=True)) if layout.plain else _grouped(values, layout.counts)


def messages_in(frames: Iterable[Frame]) -> dict[str, dict[str, Any]]:
    """Return the fields of frames by message type; types that LAYOUTS lacks are left out."""
    known = (frame for frame in frames if frame.message_id in LAYOUTS)
    return {LAYOUTS[frame.message_id].kind: fields_of(frame) for frame in known}


def _grouped(values: tuple[Any, ...], counts: dict[str, int]) -> dict[str, Any]:
    rest = iter(
        value.partition(b"\0")[0].decode("ascii", errors="replace") if isinstance(value, bytes) else value
        for value in values
    )
    return {
        name: next(rest) if count == 1 else list(itertools.islice(rest, count))
        for name, count in counts.items()
    }


# ---- frames among other bytes ----

# Bytes in a delivery that look like the start of a frame and are none. Of noise one byte in 128 does; only
# a flood comes this far.
MOST_FALSE_STARTS = 500
# What a console prints, its escape sequences included.
TEXT = bytes({*range(0x20, 0x7F), *b"\0\a\b\t\n\r\x1b"})


class FrameStream:
    """Cuts what one sender delivers into frames of MAVLink 1 and 2. Frames may be split over deliveries.

    A frame of an unknown type has no checksum that could be verified. It is believed where a frame must
    begin: at the start of a datagram or a connection, or right behind a good frame, and only if another
    frame or nothing follows it.
    """

    def __init__(self) -> None:
        self.garbage = 0  # bytes so far that belong to no frame
        # How many of them came before the first frame and are text, or noise that is no longer than
        # a frame.
        self.opening = 0
        self.rest = b""  # what came last and is no whole frame yet
        self._layouts = layouts()
        self._noise_left = LONGEST
        self._heard = False
        self._in_step = True  # whether a frame must begin where the rest begins

    def take(self, data: bytes, *, datagram: bool = False) -> list[Frame]:
        """Return the frames that are now complete.

        After MOST_FALSE_STARTS the rest of the delivery is garbage.

        Garbage cannot swallow a good frame that follows it, also not a frame's beginning whose end never
        comes.
        """
        boundary = len(self.rest) if datagram else -1
        data = self.rest + data
        frames: list[Frame] = []
        end = rest_at = len(data)
        at, used, first, false_starts, in_step, rest_in_step = 0, 0, 0, 0, self._in_step, False
        while (found := MARKER.search(data, at)) and false_starts < MOST_FALSE_STARTS:
            start = found.start()
            due = (in_step and start == at) or start == boundary
            frame = frame_at(data, start)
            behind = start + len(frame.data) if frame else start
            if frame and self._is_good(frame, data[behind : behind + 1], due):
                first = first if frames else start
                frames.append(frame)
                at, in_step = behind, True
                used, rest_at = used + behind - start, end
            else:
                false_starts += 1
                left = end - start  # may begin a frame whose end is still to come
                if frame is None and rest_at == end and (left < 3 or left < frame_length(data, start)):
                    rest_at, rest_in_step = start, due
                at, in_step = start + 1, False
        if false_starts >= MOST_FALSE_STARTS:
            rest_at = end
        self._in_step = rest_in_step if rest_at < end else in_step and at == end
        self.rest = data[rest_at:]
        self.garbage += end - used - len(self.rest)
        if not self._heard:
            self._open(data[: first if frames else rest_at])
            self._heard = bool(frames)
        return frames

    def _is_good(self, frame: Frame, behind: bytes, due: bool) -> bool:
        """Whether a frame is to be believed. behind: the byte that follows it, if any."""
        layout = self._layouts.get(frame.message_id)
        if layout is None:
            return due and (not behind or bool(MARKER.match(behind)))
        received, right = checksums(frame, layout.seed)
        return received == right

    def _open(self, data: bytes) -> None:
        """Take what came before the first frame.

        It may be a console's text, or the end of a frame during which the line was opened.
        """
        noise = len(data.translate(None, TEXT))
        excused = min(noise, self._noise_left)
        self._noise_left -= excused
        self.opening += len(data) - noise + excused
