"""MAVLink frames in bytes: their extent, sender, checksum and fields.

Only this file knows the wire format of MAVLink 1 and 2 frames. The layout of each message type comes from
pymavlink's dialect and `px4.py`.
"""

import itertools
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.bus.px4 import ADDED

MAVLINK_1, MAVLINK_2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
HEADER_1, HEADER_2 = struct.Struct("<BBxBBB"), struct.Struct("<BBBxxBBHB")
"""MAVLink 1: magic, length, system, component, message id. MAVLink 2: magic, length, flags, system,
component, message id (low, high).
"""
CHECKSUM, SIGNATURE = 2, mavlink.MAVLINK_SIGNATURE_BLOCK_LEN
SIGNED = mavlink.MAVLINK_IFLAG_SIGNED
SHORTEST = HEADER_1.size + CHECKSUM
"""Bytes of the shortest frame: MAVLink 1 without payload."""

crc16 = mavlink.mcrf4xx or (lambda data: mavlink.x25crc(data).crc)


class Frame(NamedTuple):
    """A frame's offsets in its bytes, and the fields of its header."""

    start: int
    payload: int
    """Offset of the payload, which ends at `checksum`. MAVLink 2 omits zeros at the payload's end."""
    checksum: int
    end: int
    message_id: int
    system: int
    component: int


def frame_at(data: bytes, start: int) -> Frame | None:
    """Return the frame that begins at `start`, judged by its header.

    None if no whole frame begins there, or if its flags are unknown: receivers must drop those. It does
    not verify the checksum (see `checksums`).
    """
    left = len(data) - start
    if left < SHORTEST:
        return None
    magic = data[start]
    if magic == MAVLINK_2:
        if left < HEADER_2.size + CHECKSUM:
            return None
        _, length, flags, system, component, low, high = HEADER_2.unpack_from(data, start)
        payload, message_id = start + HEADER_2.size, low | high << 16
        checksum = payload + length
        end = checksum + CHECKSUM
        if flags:
            if flags != SIGNED:
                return None
            end += SIGNATURE
    elif magic == MAVLINK_1:
        _, length, system, component, message_id = HEADER_1.unpack_from(data, start)
        payload = start + HEADER_1.size
        checksum = payload + length
        end = checksum + CHECKSUM
    else:
        return None
    return Frame(start, payload, checksum, end, message_id, system, component) if end <= len(data) else None


def frame_length(data: bytes, start: int) -> int:
    """Return the length of the frame whose first three bytes are at `start`; 0 if they begin no frame."""
    magic, length, flags = data[start : start + 3]
    if magic == MAVLINK_1:
        return HEADER_1.size + length + CHECKSUM
    return HEADER_2.size + length + CHECKSUM + (SIGNATURE if flags else 0) if magic == MAVLINK_2 else 0


def checksums(data: bytes, frame: Frame, seed: bytes) -> tuple[int, int]:
    """Return a frame's checksum as received and as computed; `seed` is the extra byte (CRC_EXTRA) of its
    message type.
    """
    at = frame.checksum
    return data[at] | data[at + 1] << 8, crc16(data[frame.start + 1 : at] + seed)


# ---- the fields of a frame ----


class Layout(NamedTuple):
    """How a message type is laid out in its payload."""

    kind: str
    size: int
    seed: bytes
    """CRC_EXTRA: the checksum covers this byte after the frame's own."""
    unpack: Callable[[bytes], tuple[Any, ...]]
    counts: dict[str, int]
    """Array length of each field, in wire order; 1 for a single value or a text."""
    plain: bool
    """True if no field is an array or text."""


def _layout(message: Any) -> Layout:
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    lengths = zip(message.ordered_fieldnames, message.array_lengths, strict=True)
    counts = {name: 1 if types[name] == "char" else max(length, 1) for name, length in lengths}
    plain = set(counts.values()) == {1} and "char" not in types.values()
    return Layout(
        message.msgname,
        message.unpacker.size,
        bytes([message.crc_extra]),
        message.unpacker.unpack,
        counts,
        plain,
    )


DIALECT: dict[int, Any] = {**mavlink.mavlink_map, **ADDED}
"""The message types that the vehicle speaks, by number."""
LAYOUTS = {message_id: _layout(message) for message_id, message in DIALECT.items()}


def fields_of(data: bytes, frame: Frame, layout: Layout) -> dict[str, Any]:
    """Return the fields of a frame, with the values that pymavlink gives them."""
    values = layout.unpack(data[frame.payload : frame.checksum][: layout.size].ljust(layout.size, b"\0"))
    return dict(zip(layout.counts, values, strict=True)) if layout.plain else _grouped(values, layout.counts)


def _grouped(values: tuple[Any, ...], counts: dict[str, int]) -> dict[str, Any]:
    rest = iter(values)
    grouped = {
        name: next(rest) if count == 1 else list(itertools.islice(rest, count))
        for name, count in counts.items()
    }
    return {name: _text(value) if isinstance(value, bytes) else value for name, value in grouped.items()}


def _text(value: bytes) -> str:
    return value.partition(b"\0")[0].decode("ascii", errors="replace")
