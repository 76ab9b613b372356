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
MOST_STREAMS = 512
Stream = tuple[int, int, int]
"""System id, component id, link id."""
LINE = re.compile(rb"( *\d+) +(\d+) +(\d+) +(\d+)\n")
EMPTY = b" " * 27 + b"\n"


def clock() -> int:
    """The time of this machine as a timestamp."""
    return min(max(time.time_ns() // 10_000 - BEGIN_S * UNITS_A_S, 0), LAST)


class Timestamps:
    """The last timestamp of each stream that a process has sent or accepted, for all its links. Safe in several threads.

    Each timestamp is in the file before it is used, in a line of its own that is written at once, so a process may be killed at any time.
    The file belongs to one process at a time.
    """

    def __init__(self, path: Path, now: Callable[[], int] = clock) -> None:
        """Open the file, or begin it; raises ValueError if it cannot be used. now: the clock; it may step back."""
        self._path = path
        self._now = now
        self._lock = threading.Lock()
        self._lines: dict[Stream, int] = {}
        """The line of each stream in the file."""
        self._latest: dict[Stream, int] = {}
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
        self._last = max(self._latest.values(), default=0)
        self.ahead_s = (self._last - now()) / UNITS_A_S
        """By how much the last timestamp was later than the clock at the start; negative if it was earlier."""

    def _load(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            content = os.pread(self._file, len(EMPTY) * MOST_STREAMS + 1, 0)
            if not content:  # room for all, so that a full disk does no harm later
                os.pwrite(self._file, EMPTY * MOST_STREAMS, 0)
        except BlockingIOError:
            raise ValueError(f"{str(self._path)!r} is in use by another process; wanted one process for each vehicle or bus") from None
        except OSError as error:
            raise ValueError(f"{str(self._path)!r} keeps the last timestamps, but cannot be used: {error.strerror}") from None
        for number, start in enumerate(range(0, len(content), len(EMPTY))):
            line = content[start : start + len(EMPTY)]
            if (found := LINE.fullmatch(line)) and number < MOST_STREAMS:
                stream = int(found[1]), int(found[2]), int(found[3])
                self._lines[stream], self._latest[stream] = number, int(found[4])
            elif line != EMPTY[: len(line)]:
                raise ValueError(
                    f"{str(self._path)!r}: line {number + 1} is damaged; remove the file, at the earliest a minute after its last use"
                )

    def next(self, stream: Stream) -> int:
        """Return the timestamp of the next frame to send: the clock's, or one more than the last one where the clock is behind.

        What is sent is remembered as what is accepted: nobody can play it back.
        """
        with self._lock:
            self._last = min(max(self._now(), self._last + 1), LAST)
            self._remember(stream, self._last)
            return self._last

    def accept(self, stream: Stream, timestamp: int) -> bool:
        """Whether a frame that is rightly signed is new. If so, it is remembered, and own timestamps will be later.

        It must be later than the last one of its stream. A new stream may be a minute behind, not more.
        """
        with self._lock:
            if (before := self._latest.get(stream)) is not None:
                new = timestamp > before
            else:
                ours = max(self._now(), self._last)
                full = len(self._lines) >= MOST_STREAMS and min(self._latest.values()) >= ours - MINUTE
                new = timestamp >= ours - MINUTE and not full
            if new:
                self._last = max(self._last, timestamp)
                self._remember(stream, timestamp)
            return new

    def _remember(self, stream: Stream, timestamp: int) -> None:
        """Write a timestamp down; where there is no room for one more stream, the oldest is forgotten."""
        if stream not in self._lines:
            if len(self._lines) < MOST_STREAMS:
                self._lines[stream] = min(set(range(MOST_STREAMS)) - set(self._lines.values()))
            else:
                oldest = min(self._latest, key=self._latest.__getitem__)
                del self._latest[oldest]
                self._lines[stream] = self._lines.pop(oldest)
        self._latest[stream] = timestamp
        self._write(self._lines[stream], b"%3d %3d %3d %15d\n" % (*stream, timestamp))

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
