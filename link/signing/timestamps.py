"""Timestamps that only go forward: our own and those of accepted streams. A file keeps them over restarts."""

import fcntl
import os
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

UNITS_A_S = 100_000  # a timestamp counts units of 10 µs since 2015-01-01, UTC
BEGIN_S = 1_420_070_400  # 2015-01-01 in seconds since 1970
LAST = 2**48 - 1  # the last timestamp there is; in the year 2104
MINUTE = 60 * UNITS_A_S  # a new stream may begin this far behind the clock
# No frame may be further ahead of our clock: it would take our own timestamps along, and those of all who
# hear us. An autopilot that keeps its timestamp across reboots may be some minutes ahead.
AHEAD = 10 * MINUTE
MOST_STREAMS = 512
KEPT_EVERY_S = 1.0  # interval of fdatasync: what is synced outlasts a power cut
Stream = tuple[int, int, int]  # system id, component id, link id
# The entry of all forgotten streams: it has the latest of their timestamps. An unknown stream must be later.
FORGOTTEN: Stream = (256, 0, 0)
LINE = re.compile(rb"( *\d+) +(\d+) +(\d+) +(\d+)\n")
EMPTY = b" " * 27 + b"\n"


def clock() -> int:
    """The time of this machine as a timestamp."""
    return min(max(time.time_ns() // 10_000 - BEGIN_S * UNITS_A_S, 0), LAST)


class Timestamps:
    """The last timestamp of each stream that a process has sent or accepted, for all its links.

    Safe in several threads.

    Each timestamp is in the file before it is used, in a line of its own that is written at once, so a
    process may be killed at any time.
    A power cut may take those of the last KEPT_EVERY_S: waiting for the disk at each frame would hold up
    the flight. The file belongs to one process at a time.
    """

    def __init__(self, path: Path, now: Callable[[], int] = clock) -> None:
        """Open the file, or begin it.

        Raises ValueError if it cannot be used. now: the clock; it may step back.
        """
        self._path = path
        self._now = now
        self._lock = threading.Lock()
        self._lines: dict[Stream, int] = {}  # the line of each stream in the file
        self._latest: dict[Stream, int] = {}
        # A warning that waits to be logged: the file cannot be written, or a sender is far ahead.
        self.notice = ""
        self._failed = self._ahead = False
        self._unsynced = True  # the file may be new
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise ValueError(
                f"{str(path)!r} keeps the last timestamps, but cannot be written: {error.strerror}"
            ) from None
        try:
            self._load()
        except BaseException:
            os.close(self._file)
            raise
        self._last = max(self._latest.values(), default=0)
        # By how much the last timestamp was later than the clock at the start; negative if it was
        # earlier.
        self.ahead_s = (self._last - now()) / UNITS_A_S
        self._closed = threading.Event()
        self._keeper = threading.Thread(target=self._keep, name="timestamps", daemon=True)
        self._keeper.start()

    def _load(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            content = os.pread(self._file, len(EMPTY) * MOST_STREAMS + 1, 0)
            if not content:  # room for all, so that a full disk does no harm later
                os.pwrite(self._file, EMPTY * MOST_STREAMS, 0)
        except BlockingIOError:
            raise ValueError(
                f"{str(self._path)!r} is in use by another process; wanted one process for each vehicle or "
                "bus"
            ) from None
        except OSError as error:
            raise ValueError(
                f"{str(self._path)!r} keeps the last timestamps, but cannot be used: {error.strerror}"
            ) from None
        for number, start in enumerate(range(0, len(content), len(EMPTY))):
            line = content[start : start + len(EMPTY)]
            if (found := LINE.fullmatch(line)) and number < MOST_STREAMS:
                stream = int(found[1]), int(found[2]), int(found[3])
                self._lines[stream], self._latest[stream] = number, int(found[4])
            elif line != EMPTY[: len(line)]:
                raise ValueError(
                    f"{str(self._path)!r}: line {number + 1} is damaged; remove the file, at the earliest a "
                    "minute after its last use"
                )

    def next(self, stream: Stream) -> int:
        """Return the timestamp of the next frame to send.

        It is the clock's, or one more than the last one where the clock is behind.

        What is sent is remembered as what is accepted: nobody can play it back.
        """
        with self._lock:
            self._last = min(max(self._now(), self._last + 1), LAST)
            self._remember(stream, self._last)
            return self._last

    def accept(self, stream: Stream, timestamp: int) -> bool:
        """Whether a frame that is rightly signed is new, and not far ahead.

        If so, it is remembered, and own timestamps will be later.

        It must be later than the last one of its stream. A new stream may be a minute behind, not more,
        and must be later than all that was forgotten.
        """
        if self.is_far_ahead(timestamp):
            return False
        with self._lock:
            if (before := self._latest.get(stream)) is not None:
                new = timestamp > before
            else:
                ours = max(self._now(), self._last)
                new = timestamp >= ours - MINUTE and timestamp > self._latest.get(FORGOTTEN, -1)
            if new:
                self._last = max(self._last, timestamp)
                self._remember(stream, timestamp)
                self._look_ahead(stream, timestamp)
            return new

    def is_far_ahead(self, timestamp: int) -> bool:
        """Whether a timestamp is ahead of the clock by more than AHEAD.

        Nothing is where the clock stands before 2015: it is not set.
        """
        return 0 < self._now() < timestamp - AHEAD

    def _look_ahead(self, stream: Stream, timestamp: int) -> None:
        """Say once that a timestamp is ahead of the clock.

        It is taken all the same, as the standard has it: clocks may be wrong.
        """
        if (ahead := timestamp - self._now()) > MINUTE and not self._ahead:
            self._ahead = True
            self.notice = (
                f"system {stream[0]}, component {stream[1]} signs {ahead / UNITS_A_S:.0f} s later than the "
                "clock, "
                "and all that hear it follow: senders with a correct clock will be refused"
            )

    def _remember(self, stream: Stream, timestamp: int) -> None:
        if stream not in self._lines:
            while len(self._lines) >= MOST_STREAMS:
                self._forget()
            self._lines[stream] = min(set(range(MOST_STREAMS)) - set(self._lines.values()))
        self._latest[stream] = timestamp
        self._write(self._lines[stream], b"%3d %3d %3d %15d\n" % (*stream, timestamp))

    def _forget(self) -> None:
        """Make room by forgetting the oldest stream.

        What it has said stays refused: FORGOTTEN is written before its line is used again.
        """
        oldest = min(self._latest.keys() - {FORGOTTEN}, key=self._latest.__getitem__)
        timestamp, line = self._latest.pop(oldest), self._lines.pop(oldest)
        self._lines.setdefault(FORGOTTEN, line)
        self._remember(FORGOTTEN, timestamp)

    def _write(self, number: int, line: bytes) -> None:
        self._unsynced = True
        try:
            os.pwrite(self._file, line, number * len(EMPTY))
        except OSError as error:
            if not self._failed:
                self._failed = True
                self.notice = (
                    f"{str(self._path)!r} cannot be written: {error.strerror}; after a restart "
                    "old frames may pass"
                )

    def _keep(self) -> None:
        """Bring what is written to the disk, until the end."""
        while not self._closed.wait(KEPT_EVERY_S):
            if self._unsynced:
                self._unsynced = False
                with suppress(OSError):
                    os.fdatasync(self._file)

    def close(self) -> None:
        """Keep what was written and free the file; a second call has no effect."""
        self._closed.set()
        self._keeper.join()
        with self._lock:
            if self._file < 0:
                return
            with suppress(OSError):
                os.fdatasync(self._file)
            os.close(self._file)
            self._file = -1
