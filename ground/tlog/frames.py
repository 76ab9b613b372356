"""Finds the intact MAVLink frames of a telemetry log (.tlog), however damaged the file around them is.

A record is a time (µs since 1970, 8 bytes, big-endian) followed by one MAVLink 1 or 2 frame. Nothing marks
the start of a record: after damage, the next one is searched for byte by byte.
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

from link.bus.frames import MAVLINK_1, MAVLINK_2, SHORTEST, Frame, checksums, frame_at, frame_length

Integers = NDArray[np.int64]

STAMP = 8
"""Bytes of the time before each frame."""
NO_STAMP = -1
LATEST_US = 4_102_444_800_000_000
"""The year 2100: a later time is damaged. An early one is valid: a computer without a battery-backed clock
starts in 1970.
"""
MAGIC = re.compile(b"[\xfd\xfe]")
CHECKSUM_SEEDS = {message_id: bytes([kind.crc_extra]) for message_id, kind in mavlink.mavlink_map.items()}
SURE_US = 1_000_000
"""A larger step of the clock between two records, back or ahead, is checked against the records that
follow.
"""


class Records(NamedTuple):
    """The frames of a log, in the order of the file: arrays of one length."""

    logged_us: Integers
    """When each was logged, µs since 1970; NO_STAMP if those bytes are damaged or missing."""
    starts: Integers
    """Offset of each frame in the file, after its time."""
    ends: Integers
    message_ids: Integers
    systems: Integers
    components: Integers
    garbage: list[tuple[int, int]]
    """Runs of bytes that belong to no record: (records before the run, its length)."""
    refused: Counter[int]
    """Whole frames among the garbage whose checksum is wrong, by message id: damaged, or from another
    revision of the dialect.
    """
    unknown: Counter[int]
    """Frames of messages outside the dialect, by message id; their checksums cannot be verified."""
    cut_off: int
    """Bytes of an incomplete last record."""


def scan(data: bytes) -> Records:
    """Find all records. Never raises: bytes outside records are counted."""
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
        start, frame = found
        end = start + len(frame.data)
        logged_us = _stamp(data, start - STAMP) if start - STAMP >= at else NO_STAMP
        if skipped := start - at - (STAMP if logged_us != NO_STAMP else 0):
            garbage.append((len(starts), skipped))
            refused.update(_refused(data, at, at + skipped))
        if frame.message_id not in CHECKSUM_SEEDS:
            unknown[frame.message_id] += 1
        logged.append(logged_us)
        starts.append(start)
        ends.append(end)
        message_ids.append(frame.message_id)
        systems.append(frame.system)
        components.append(frame.component)
        at = end
    columns = [
        np.frombuffer(column, np.int64) for column in (logged, starts, ends, message_ids, systems, components)
    ]
    return Records(
        columns[0],
        columns[1],
        columns[2],
        columns[3],
        columns[4],
        columns[5],
        garbage,
        refused,
        unknown,
        cut_off,
    )


def payload(data: bytes, start: int) -> bytes:
    """Return the payload of the frame at offset `start`; MAVLink 2 omits trailing zeros."""
    frame = frame_at(data, start)
    assert frame is not None
    return frame.payload


class LogClock(NamedTuple):
    """The log's times made monotonic, and what was corrected."""

    times_us: Integers
    damaged: int
    """Number of records whose time is missing or fits neither neighbour; each takes the time of the record
    before it.
    """
    jumps: list[tuple[int, int]]
    """Where the clock was set back: (record, µs). This amount is added to all later times."""


def log_clock(logged_us: Integers) -> LogClock:
    """Correct the times of a log."""
    stamps = logged_us.tolist()
    times, jumps, damaged, offset = array("q", bytes(8 * len(stamps))), [], 0, 0
    newest = next((stamp for stamp in stamps if stamp != NO_STAMP), 0)
    for index, stamp in enumerate(stamps):
        now = stamp + offset
        if stamp == NO_STAMP or now > LATEST_US:
            damaged += 1
        elif not abs(now - newest) <= SURE_US:
            following = next(
                (later + offset for later in stamps[index + 1 : index + 3] if later != NO_STAMP), newest
            )
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


def _record(data: bytes, at: int) -> tuple[int, Frame] | None:
    """Return where the next frame from offset `at` on begins, and the frame. A record that starts exactly
    there is tried first.
    """
    frame = frame_at(data, at + STAMP)
    if frame is not None and _is_good(data, at, at + STAMP, frame):
        return at + STAMP, frame
    for match in MAGIC.finditer(data, at):
        frame = frame_at(data, match.start())
        if frame is not None and _is_good(data, at, match.start(), frame):
            return match.start(), frame
    return None


def _is_good(data: bytes, at: int, start: int, frame: Frame) -> bool:
    """True for a real frame: by its checksum or, for an unknown message, by the bytes before, after and
    inside it.
    """
    verified = _is_right(frame)
    if verified is not None:
        return verified
    end = start + len(frame.data)
    if (
        start - STAMP < at
        or _stamp(data, start - STAMP) == NO_STAMP
        or not (end == len(data) or _may_begin(data, end))
    ):
        return False
    inside = (frame_at(data, match.start()) for match in MAGIC.finditer(data, start + 1, end))
    return not any(seen is not None and _is_right(seen) for seen in inside)


def _is_right(frame: Frame) -> bool | None:
    """True if the frame's checksum is right; None if the dialect does not know the message."""
    seed = CHECKSUM_SEEDS.get(frame.message_id)
    if seed is None:
        return None
    told, right = checksums(frame, seed)
    return told == right


def _refused(data: bytes, at: int, end: int) -> list[int]:
    """Return the message ids of a run of garbage that consists only of records with a wrong checksum; else
    an empty list.
    """
    message_ids = []
    while at < end:
        frame = frame_at(data, at + STAMP)
        if frame is None or _stamp(data, at) == NO_STAMP:
            return []
        at += STAMP + len(frame.data)
        message_ids.append(frame.message_id)
    return message_ids if at == end else []


def _stamp(data: bytes, at: int) -> int:
    (stamp,) = struct.unpack_from(">Q", data, at)
    return int(stamp) if stamp < LATEST_US else NO_STAMP


def _may_begin(data: bytes, at: int) -> bool:
    """True if a record, or the beginning of an incomplete last one, may start at this offset."""
    if len(data) - at < STAMP + SHORTEST:
        return True
    return _stamp(data, at) != NO_STAMP and data[at + STAMP] in (MAVLINK_1, MAVLINK_2)


def _ends_beyond(data: bytes, at: int) -> bool:
    """True if a record that starts at this offset would extend beyond the end of the file."""
    return _may_begin(data, at) and at + STAMP + frame_length(data, at + STAMP) > len(data)
