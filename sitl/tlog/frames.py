"""Telemetry logs (.tlog): the MAVLink frames in one, each found whole and checked, however much of the file around it is damaged.

A record of such a log is 8 bytes, µs since 1970, most significant byte first, and one MAVLink 1 or 2 frame. Nothing marks where a
record begins, so where one is damaged the next is searched for, byte by byte.
"""

import math
import re
import struct
from array import array
from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

Integers = NDArray[np.int64]

STAMP = 8
"""Bytes of a record before its frame."""
NO_STAMP = -1
LATEST_US = 4_102_444_800_000_000
"""The year 2100: later times are damaged ones. Early ones are not: a computer without a clock of its own begins in 1970."""
SHORTEST = 8
"""Bytes of a MAVLink 1 frame without payload."""
HEADER_V1, HEADER_V2, CHECKSUM, SIGNATURE = 6, 10, 2, 13
MAGIC = re.compile(b"[\xfd\xfe]")
CHECKSUM_SEEDS = {message_id: bytes([kind.crc_extra]) for message_id, kind in mavlink.mavlink_map.items()}
SURE_US = 1_000_000
"""From one record to the next the clock may go back by so much, where two links are logged at once, or ahead, without a second look."""


class Records(NamedTuple):
    """The frames of a log, in the order of the file: arrays of one length."""

    logged_us: Integers
    """When each was logged, µs since 1970; NO_STAMP where those bytes are damaged or missing."""
    starts: Integers
    """Where each frame begins in the file, behind its time."""
    ends: Integers
    message_ids: Integers
    systems: Integers
    components: Integers
    garbage: list[tuple[int, int]]
    """Runs of bytes that belong to no record: how many records lie before one, and its length."""
    refused: Counter[int]
    """Of the garbage, what is whole but for its checksum, by message id: frames damaged in place, or of another revision of the dialect."""
    unknown: Counter[int]
    """How many there are of each message that the dialect does not know: their checksums cannot be verified."""
    cut_off: int
    """Bytes of a last record that has no end."""


def scan(data: bytes) -> Records:
    """Find all records. It never fails: what is no record is counted."""
    logged, starts, ends, message_ids, systems, components = (array("q") for _ in range(6))
    unknown: Counter[int] = Counter()
    refused: Counter[int] = Counter()
    garbage: list[tuple[int, int]] = []
    at = cut_off = 0
    while at < len(data):
        found = _record(data, at)
        if found is None:
            if len(data) - at < STAMP + SHORTEST or _ends_beyond(data, at):
                cut_off = len(data) - at
            else:
                garbage.append((len(starts), len(data) - at))
                refused.update(_refused(data, at, len(data)))
            break
        start, end, message_id = found
        logged_us = _stamp(data, start - STAMP) if start - STAMP >= at else NO_STAMP
        if skipped := start - at - (STAMP if logged_us != NO_STAMP else 0):
            garbage.append((len(starts), skipped))
            refused.update(_refused(data, at, at + skipped))
        if message_id not in CHECKSUM_SEEDS:
            unknown[message_id] += 1
        sender = start + (3 if data[start] == mavlink.PROTOCOL_MARKER_V1 else 5)
        logged.append(logged_us)
        starts.append(start)
        ends.append(end)
        message_ids.append(message_id)
        systems.append(data[sender])
        components.append(data[sender + 1])
        at = end
    columns = [np.frombuffer(column, np.int64) for column in (logged, starts, ends, message_ids, systems, components)]
    return Records(columns[0], columns[1], columns[2], columns[3], columns[4], columns[5], garbage, refused, unknown, cut_off)


def payload(data: bytes, start: int) -> bytes:
    """The payload of the frame that starts there; MAVLink 2 leaves zeros at its end away."""
    begin = start + (HEADER_V1 if data[start] == mavlink.PROTOCOL_MARKER_V1 else HEADER_V2)
    return data[begin : begin + data[start + 1]]


class LogClock(NamedTuple):
    """When each record was logged, as a clock that never goes back, and what was wrong with it."""

    times_us: Integers
    damaged: int
    """Records whose time is missing, or fits no neighbour's; they have the time of the record before."""
    jumps: list[tuple[int, int]]
    """Where the clock was set back: the record, and by how many µs. After it the times go on from before."""


def log_clock(logged_us: Integers) -> LogClock:
    """Mend the times of a log."""
    stamps = logged_us.tolist()
    times, jumps, damaged, offset = array("q", bytes(8 * len(stamps))), [], 0, 0
    newest = next((stamp for stamp in stamps if stamp != NO_STAMP), 0)
    for index, stamp in enumerate(stamps):
        now = stamp + offset
        if stamp == NO_STAMP:
            damaged += 1
        elif not abs(now - newest) <= SURE_US:
            following = next((later + offset for later in stamps[index + 1 : index + 3] if later != NO_STAMP), newest)
            if newest - SURE_US <= following < (now - SURE_US if now > newest else math.inf):
                damaged += 1
            elif now < newest:
                jumps.append((index, newest - now))
                offset += newest - now
            else:
                newest = now
        elif now > newest:
            newest = now
        times[index] = newest
    return LogClock(np.frombuffer(times, np.int64), damaged, jumps)


def _record(data: bytes, at: int) -> tuple[int, int, int] | None:
    """The next frame from there on, in step with the records before it if it can be: (start, end, message id)."""
    seen = _frame(data, at + STAMP)
    if seen is not None and _is_good(data, at, at + STAMP, *seen):
        return at + STAMP, seen[0], seen[1]
    for match in MAGIC.finditer(data, at):
        start = match.start()
        seen = _frame(data, start)
        if seen is not None and _is_good(data, at, start, *seen):
            return start, seen[0], seen[1]
    return None


def _is_good(data: bytes, at: int, start: int, end: int, message_id: int, checked: bool | None) -> bool:
    """Whether a frame is one: by its checksum; where that cannot be verified, by what is before, behind and inside it."""
    if checked is not None:
        return checked
    if start - STAMP < at or _stamp(data, start - STAMP) == NO_STAMP or not (end == len(data) or _may_begin(data, end)):
        return False
    inside = (_frame(data, match.start()) for match in MAGIC.finditer(data, start + 1, end))
    return not any(seen is not None and seen[2] for seen in inside)


def _refused(data: bytes, at: int, end: int) -> list[int]:
    """The message ids of a run of garbage that is nothing but records with a wrong checksum."""
    message_ids = []
    while at < end:
        seen = _frame(data, at + STAMP)
        if seen is None or _stamp(data, at) == NO_STAMP:
            return []
        at = seen[0]
        message_ids.append(seen[1])
    return message_ids if at == end else []


def _frame(data: bytes, start: int) -> tuple[int, int, bool | None] | None:
    """What may be a frame: its end, its message id, and whether its checksum is right (None: the dialect does not know it)."""
    if len(data) - start < SHORTEST:
        return None
    magic, length, flags = data[start : start + 3]
    if magic == mavlink.PROTOCOL_MARKER_V2:
        checksum = start + HEADER_V2 + length
        end = checksum + CHECKSUM + (SIGNATURE if flags else 0)
        if flags not in (0, mavlink.MAVLINK_IFLAG_SIGNED) or end > len(data):
            return None
        message_id = data[start + 7] | data[start + 8] << 8 | data[start + 9] << 16
    elif magic == mavlink.PROTOCOL_MARKER_V1:
        checksum = start + HEADER_V1 + length
        end = checksum + CHECKSUM
        if end > len(data):
            return None
        message_id = data[start + 5]
    else:
        return None
    seed = CHECKSUM_SEEDS.get(message_id)
    if seed is None:
        return end, message_id, None
    right: int = mavlink.x25crc(data[start + 1 : checksum] + seed).crc
    return end, message_id, right == data[checksum] | data[checksum + 1] << 8


def _stamp(data: bytes, at: int) -> int:
    (stamp,) = struct.unpack_from(">Q", data, at)
    return int(stamp) if stamp < LATEST_US else NO_STAMP


def _may_begin(data: bytes, at: int) -> bool:
    """Whether a record may begin there, or all that is left of one."""
    if len(data) - at < STAMP + SHORTEST:
        return True
    return _stamp(data, at) != NO_STAMP and data[at + STAMP] in (mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2)


def _ends_beyond(data: bytes, at: int) -> bool:
    """Whether a record that begins there would end behind the file."""
    magic, length, flags = data[at + STAMP : at + STAMP + 3]
    rest = HEADER_V1 if magic == mavlink.PROTOCOL_MARKER_V1 else HEADER_V2 + (SIGNATURE if flags else 0)
    return _may_begin(data, at) and at + STAMP + rest + length + CHECKSUM > len(data)
