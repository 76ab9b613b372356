"""Timestamps that only go forward: a process's own, and those of each stream that it has accepted. A file keeps them across restarts."""

import fcntl
import os
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

UNITS_A_S = 100_000
"""A timestamp counts units of 10 µs since 2015-01-01, UTC."""
BEGIN_S = 1_420_070_400
"""That day, in seconds since 1970."""
LAST = 2**48 - 1
"""The last timestamp there is; in the year 2104."""
MINUTE = 60 * UNITS_A_S
"""A stream that is new may be so far behind."""
MOST_STREAMS = 64
Stream = tuple[int, int, int]
"""System id, component id, link id."""
LINE = re.compile(rb"(sent *|( *\d+) +(\d+) +(\d+)) +(\d+)\n")
EMPTY = b" " * 27 + b"\n"


def clock() -> int:
    """The time of this machine as a timestamp."""
    return min(max(time.time_ns() // 10_000 - BEGIN_S * UNITS_A_S, 0), LAST)


class Timestamps:
    """What a process has sent and accepted, for all its links. Safe in several threads.

    Each timestamp is in the file before it is used, in a line of its own that is written at once, so a process may be killed at any time.
    The file belongs to one process at a time.
    """

    def __init__(self, path: Path, now: Callable[[], int] = clock) -> None:
        """Open the file, or begin it; raises ValueError if it cannot be used. now: the clock; it may step back."""
        self._path = path
        self._now = now
        self._lock = threading.Lock()
        self._slots: dict[Stream, int] = {}
        """The line of each stream in the file."""
        self._accepted: dict[Stream, int] = {}
        self._sent = 0
        self.failure = ""
        """Why the file can no longer be written, until somebody has taken notice."""
        self._failed = False
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise ValueError(f"{str(path)!r} keeps the last timestamps, but cannot be written: {error.strerror}") from None
        try:
            self._load()
        except BaseException:
            os.close(self._file)
            raise
        self._last = max(self._sent, *self._accepted.values(), 0)
        self.ahead_s = (self._last - now()) / UNITS_A_S
        """By how much the last timestamp was later than the clock at the start; negative if it was earlier."""

    def _load(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            content = os.pread(self._file, len(EMPTY) * (MOST_STREAMS + 1) + 1, 0)
            if not content:  # room for all, so that a full disk does no harm later
                os.pwrite(self._file, EMPTY * (MOST_STREAMS + 1), 0)
        except BlockingIOError:
            raise ValueError(f"{str(self._path)!r} is in use by another process; wanted one process for each vehicle or bus") from None
        except OSError as error:
            raise ValueError(f"{str(self._path)!r} keeps the last timestamps, but cannot be used: {error.strerror}") from None
        for number, start in enumerate(range(0, len(content), len(EMPTY))):
            line = content[start : start + len(EMPTY)]
            found = LINE.fullmatch(line)
            if found and found[2] is None and number == 0:
                self._sent = int(found[5])
            elif found and found[2] is not None and 0 < number <= MOST_STREAMS:
                stream = int(found[2]), int(found[3]), int(found[4])
                self._slots[stream], self._accepted[stream] = number, int(found[5])
            elif line != EMPTY[: len(line)]:
                raise ValueError(
                    f"{str(self._path)!r}: line {number + 1} is damaged; remove the file, at the earliest a minute after its last use"
                )

    def next(self) -> int:
        """Return the timestamp of the next frame to send: the clock's, or one more than the last one where the clock is behind."""
        with self._lock:
            self._last = self._sent = min(max(self._now(), self._last + 1), LAST)
            self._write(0, b"%-11s %15d\n" % (b"sent", self._sent))
            return self._sent

    def accept(self, stream: Stream, timestamp: int) -> bool:
        """Whether a frame that is rightly signed is new. If so, it is remembered, and own timestamps will be later.

        It must be later than the last one of its stream. A new stream may be a minute behind, not more.
        """
        with self._lock:
            before = self._accepted.get(stream)
            if before is None:
                ours = max(self._now(), self._last)
                slot = self._room(ours)
                if timestamp < ours - MINUTE or slot is None:
                    return False
                self._slots[stream] = slot
            elif timestamp <= before:
                return False
            self._accepted[stream] = timestamp
            self._last = max(self._last, timestamp)
            self._write(self._slots[stream], b"%3d %3d %3d %15d\n" % (*stream, timestamp))
            return True

    def _room(self, ours: int) -> int | None:
        """Return a line for one more stream, of one that is more than a minute behind if need be; None if there is none."""
        if len(self._slots) < MOST_STREAMS:
            return min(set(range(1, MOST_STREAMS + 1)) - set(self._slots.values()))
        oldest = min(self._accepted, key=self._accepted.__getitem__)
        if self._accepted[oldest] >= ours - MINUTE:
            return None
        del self._accepted[oldest]
        return self._slots.pop(oldest)

    def _write(self, number: int, line: bytes) -> None:
        try:
            os.pwrite(self._file, line, number * len(EMPTY))
        except OSError as error:
            if not self._failed:
                self._failed = True
                self.failure = f"{str(self._path)!r} cannot be written: {error.strerror}; after a restart old frames may pass"

    def close(self) -> None:
        """Free the file; a second call has no effect."""
        with suppress(OSError), self._lock:
            os.close(self._file)
            self._file = -1
