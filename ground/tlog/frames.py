"""Finds the intact MAVLink frames of a telemetry log (.tlog), however damaged the file around them is.

A record is a time (µs since 1970, 8 bytes, big-endian) followed by one MAVLink 1 or 2 frame. Nothing marks
the start of a record: after damage, the next one is searched for byte by byte. pymavlink's `mavlogfile` does
not: it drops each sound frame that a damaged one seems to reach into.
"""

import itertools
import math
import struct
from array import array
from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from link.bus.frames import MARKER, MAVLINK_1, MAVLINK_2, SHORTEST, Frame, checksums, frame_at, frame_length

Integers = NDArray[np.int64]

STAMP = 8  # bytes of the time before each frame
NO_STAMP = -1
# The year 2100: a later time is damaged. An early one is valid: a computer without a clock starts in 1970.
LATEST_US = 4_102_444_800_000_000
SURE_US = 1_000_000  # a larger step between two records is checked against the records that follow
SEEDS = {message_id: bytes([kind.crc_extra]) for message_id, kind in mavlink.mavlink_map.items()}


class Records(NamedTuple):
    """The frames of a log, in the order of the file: arrays of one length, and what is beside them."""

    logged_us: Integers  # when each was logged, µs since 1970; NO_STAMP if those bytes are damaged or missing
    starts: Integers  # offset of each frame in the file, after its time
    ends: Integers
    message_ids: Integers
    systems: Integers
    components: Integers
    garbage: list[tuple[int, int]]  # runs of bytes outside records: (records before the run, its length)
    refused: Counter[int]  # records among the garbage with a wrong checksum, by message id
    unknown: Counter[int]  # records of messages outside the dialect, whose checksums cannot be verified
    cut_off: int  # bytes of an incomplete last record


def scan(data: bytes) -> Records:
    """Find all records. Never raises: bytes outside records are counted."""
    rows = array("q")
    garbage: list[tuple[int, int]] = []
    refused: dict[int, int] = {}  # message ids by offset
    at = cut_off = 0
    while (found := _next(data, at, refused)) is not None:
        start, frame = found
        end = start + len(frame.data)
        stamp = _stamp(data, start - STAMP) if start - STAMP >= at else NO_STAMP
        if skipped := start - at - (STAMP if stamp != NO_STAMP else 0):
            garbage.append((len(rows) // 6, skipped))
        rows.extend((stamp, start, end, frame.message_id, frame.system, frame.component))
        at = end
    is_short = len(data) - at < STAMP + SHORTEST
    if is_short or (_may_begin(data, at) and at + STAMP + frame_length(data, at + STAMP) > len(data)):
        cut_off = len(data) - at
    else:
        garbage.append((len(rows) // 6, len(data) - at))
    logged_us, starts, ends, message_ids, systems, components = (
        np.frombuffer(rows, np.int64).reshape(-1, 6).T.copy()
    )
    return Records(
        logged_us,
        starts,
        ends,
        message_ids,
        systems,
        components,
        garbage,
        refused=Counter(refused.values()),
        unknown=Counter(message_id for message_id in message_ids.tolist() if message_id not in SEEDS),
        cut_off=cut_off,
    )


def once(data: bytes, records: Records) -> tuple[Records, int]:
    """Return the records without those that the file holds again, and how many these were.

    They are the same to the last bit, times and sequence numbers included: a log that was joined with itself,
    or with a part of it. Where times only go on there are none.
    """
    stamps = records.logged_us
    if not (np.diff(stamps[stamps != NO_STAMP]) < 0).any():
        return records, 0
    seen: set[bytes] = set()
    first = np.ones(len(stamps), np.bool_)
    spans = zip(stamps.tolist(), records.starts.tolist(), records.ends.tolist(), strict=True)
    for index, (stamp, start, end) in enumerate(spans):
        if stamp != NO_STAMP:
            whole = data[start - STAMP : end]
            first[index] = whole not in seen
            seen.add(whole)
    kept = records._replace(
        logged_us=stamps[first],
        starts=records.starts[first],
        ends=records.ends[first],
        message_ids=records.message_ids[first],
        systems=records.systems[first],
        components=records.components[first],
    )
    return kept, int(np.count_nonzero(~first))


class LogClock(NamedTuple):
    """The log's times made monotonic, and what was corrected."""

    times_us: Integers
    damaged: int  # records without a time, or with one that fits no neighbour: they take the one before it
    jumps: list[tuple[int, int]]  # where the clock was set back: (record, µs added to all later times)


def log_clock(logged_us: Integers) -> LogClock:
    """Correct the times of a log."""
    stamps = logged_us.tolist()
    times, jumps, damaged, offset = array("q", bytes(8 * len(stamps))), [], 0, 0
    newest = next((stamp for stamp in stamps if stamp != NO_STAMP), 0)
    for index, stamp in enumerate(stamps):
        now = stamp + offset
        if stamp == NO_STAMP or now > LATEST_US:
            damaged += 1
        elif abs(now - newest) <= SURE_US:
            newest = max(newest, now)
        else:
            after = (later + offset for later in stamps[index + 1 : index + 3] if later != NO_STAMP)
            if newest - SURE_US <= next(after, newest) < (now - SURE_US if now > newest else math.inf):
                damaged += 1
            elif now > newest:
                newest = now
            else:
                jumps.append((index, newest - now))
                offset += newest - now
        times[index] = newest
    return LogClock(np.frombuffer(times, np.int64), damaged, jumps)


def _next(data: bytes, at: int, refused: dict[int, int]) -> tuple[int, Frame] | None:
    """Return the next real frame from offset `at` on, and where it begins.

    A record that starts exactly there is tried first.
    """
    for start in itertools.chain((at + STAMP,), (match.start() for match in MARKER.finditer(data, at))):
        frame = frame_at(data, start)
        if frame and _is_real(data, at, start, frame):
            return start, frame
        if frame and frame.message_id in SEEDS and _is_between_records(data, at, start, frame):
            refused[start] = frame.message_id
    return None


def _is_real(data: bytes, at: int, start: int, frame: Frame) -> bool:
    """Judge a frame by its checksum or, for an unknown message, by the bytes before, after and inside it."""
    if frame.message_id in SEEDS:
        return _is_right(frame)
    if not _is_between_records(data, at, start, frame):
        return False
    inside = (
        frame_at(data, match.start()) for match in MARKER.finditer(data, start + 1, start + len(frame.data))
    )
    return not any(seen and seen.message_id in SEEDS and _is_right(seen) for seen in inside)


def _is_right(frame: Frame) -> bool:
    told, right = checksums(frame, SEEDS[frame.message_id])
    return told == right


def _is_between_records(data: bytes, at: int, start: int, frame: Frame) -> bool:
    """True if a time comes before the frame, and the file's end or another record after it."""
    if start - STAMP < at or _stamp(data, start - STAMP) == NO_STAMP:
        return False
    end = start + len(frame.data)
    return end == len(data) or _may_begin(data, end)


def _stamp(data: bytes, at: int) -> int:
    (stamp,) = struct.unpack_from(">Q", data, at)
    return int(stamp) if stamp < LATEST_US else NO_STAMP


def _may_begin(data: bytes, at: int) -> bool:
    """True if a record, or the beginning of an incomplete last one, may start at this offset."""
    if len(data) - at < STAMP + SHORTEST:
        return True
    return _stamp(data, at) != NO_STAMP and data[at + STAMP] in (MAVLINK_1, MAVLINK_2)
