"""MAVLink frames in bytes: where one begins and ends, who sent it, whether its checksum is right, and what it says.

How MAVLink 1 and 2 lie on the wire is known here only; how each type of message does, pymavlink's dialect says.
"""

import itertools
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

MAVLINK_1, MAVLINK_2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
HEADER_1, HEADER_2 = struct.Struct("<BBxBBB"), struct.Struct("<BBBxxBBHB")
"""Magic, length, (of MAVLink 2: flags,) the sender's system and component, message id (of MAVLink 2: its low and its high part)."""
CHECKSUM, SIGNATURE = 2, mavlink.MAVLINK_SIGNATURE_BLOCK_LEN
SIGNED = mavlink.MAVLINK_IFLAG_SIGNED
SHORTEST = HEADER_1.size + CHECKSUM
"""Bytes of a MAVLink 1 frame without payload."""

crc16 = mavlink.mcrf4xx or (lambda data: mavlink.x25crc(data).crc)


class Frame(NamedTuple):
    """Where a frame lies in its bytes, and what its header says."""

    start: int
    payload: int
    """Where its payload begins. It ends where the checksum begins; MAVLink 2 leaves zeros at its end away."""
    checksum: int
    end: int
    message_id: int
    system: int
    component: int


def frame_at(data: bytes, start: int) -> Frame | None:
    """Return the frame that begins there by its header, whole; None where none does, or one of a kind that a receiver must drop.

    Its checksum is not looked at: see `checksums`.
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
                return None  # incompatible in a way that is not known
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
    """Return how long what may be a frame has to be, by its first three bytes; 0 where no frame begins so."""
    magic, length, flags = data[start : start + 3]
    if magic == MAVLINK_1:
        return HEADER_1.size + length + CHECKSUM
    return HEADER_2.size + length + CHECKSUM + (SIGNATURE if flags else 0) if magic == MAVLINK_2 else 0


def checksums(data: bytes, frame: Frame, seed: bytes) -> tuple[int, int]:
    """Return the checksum that a frame has, and that which it should have; `seed` is the byte that its type of message adds."""
    at = frame.checksum
    return data[at] | data[at + 1] << 8, crc16(data[frame.start + 1 : at] + seed)


# ---- what a frame says ----


class Layout(NamedTuple):
    """How a type of message lies in its payload."""

    kind: str
    size: int
    seed: bytes
    """What the checksum takes in beside the frame's own bytes."""
    unpack: Callable[[bytes], tuple[Any, ...]]
    counts: dict[str, int]
    """Of each field, in the frame's order, the length of its array; 1 where it is none."""
    plain: bool
    """It has neither arrays nor text."""


def _layout(message: Any) -> Layout:
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    lengths = zip(message.ordered_fieldnames, message.array_lengths, strict=True)
    counts = {name: 1 if types[name] == "char" else max(length, 1) for name, length in lengths}
    plain = set(counts.values()) == {1} and "char" not in types.values()
    return Layout(message.msgname, message.unpacker.size, bytes([message.crc_extra]), message.unpacker.unpack, counts, plain)


LAYOUTS = {message_id: _layout(message) for message_id, message in mavlink.mavlink_map.items()}


def fields_of(data: bytes, frame: Frame, layout: Layout) -> dict[str, Any]:
    """Return the fields of a frame of a known type, as pymavlink gives them."""
    values = layout.unpack(data[frame.payload : frame.checksum][: layout.size].ljust(layout.size, b"\0"))
    return dict(zip(layout.counts, values, strict=True)) if layout.plain else _grouped(values, layout.counts)


def _grouped(values: tuple[Any, ...], counts: dict[str, int]) -> dict[str, Any]:
    rest = iter(values)
    grouped = {name: next(rest) if count == 1 else list(itertools.islice(rest, count)) for name, count in counts.items()}
    return {name: _text(value) if isinstance(value, bytes) else value for name, value in grouped.items()}


def _text(value: bytes) -> str:
    return value.partition(b"\0")[0].decode("ascii", errors="replace")
