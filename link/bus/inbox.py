"""The bounds of what a service holds: messages that wait for its loop, and names of other services.

A flood drops messages, but never fills memory or blocks a sender.
"""

import math
import queue
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from link.access.roles import SERVICES
from link.bus.log import Log
from link.bus.tally import OVERFLOW, STRANGER

# Most messages that wait per key, in addition to the key's kept ones. Beyond that the oldest are dropped,
# so that the flight goes on.
WAITING_MESSAGES = 4096
WAITING_BYTES = 256 * 2**20  # most bytes that wait per key; a belief of a million particles has up to 36 MB
BURST_S = 10.0  # drops less than this apart belong to one burst
# The names of our own services; all of them are admitted.
OURS = frozenset(name for names in SERVICES.values() for name in names)
# Most services of other names that a process admits. Without --secure anybody may join, under any number
# of names.
MOST_OTHERS = 16
NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")  # what the name of another service may be
# Why messages are dropped.
TOO_FAST = "messages arrive faster than they are processed; some of the waiting ones are dropped"
TOO_STRANGE = (
    f"there are services of too many or of strange names; wanted ours and at most {MOST_OTHERS} others, of 1 "
    "to 64 letters, digits and . _ -"
)


class Drops:
    """Counts the messages of a key that were dropped, and logs each burst of them once."""

    def __init__(self, name: str, kind: str = OVERFLOW, why: str = TOO_FAST) -> None:
        self._kind = kind
        self._line = f"refused {name}: {why}"
        self._reported = 0
        self._reported_at = -math.inf

    def tell(self, dropped: int, log: Log) -> None:
        """Take the total dropped so far; count and log those since the last call."""
        if count := dropped - self._reported:
            self._reported = dropped
            log.tally.refuse(self._kind, count)
            now_s = log.tally.now_s()
            if now_s - self._reported_at >= BURST_S:
                log.warning(self._line)
            self._reported_at = now_s


class ServiceNames:
    """The names of the services that a process admits: OURS, and the first MOST_OTHERS others.

    Safe in several threads.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._others: set[str] = set()
        self._refused = 0
        self._drops = Drops("health/<service>", STRANGER, TOO_STRANGE)

    def admits(self, name: str) -> bool:
        """Whether a service of this name is admitted. If not, it is counted."""
        if name in OURS:
            return True
        with self._lock:
            if name not in self._others and (len(self._others) >= MOST_OTHERS or not NAME.fullmatch(name)):
                self._refused += 1
                return False
            self._others.add(name)
            return True

    def tell(self, log: Log) -> None:
        """Count and log what has been refused since the last call."""
        self._drops.tell(self._refused, log)


class _Lane:
    """The waiting items of one kind, oldest first, each with its number and its size in bytes."""

    def __init__(self, name: str, most: float, newest: bool = False, urgent: bool = False) -> None:
        self.waiting: deque[tuple[int, Any, int]] = deque()
        self.urgent = urgent
        self.dropped = 0
        self.drops = Drops(name)
        self._most = most
        self._newest = newest
        self._bytes = 0

    def append(self, number: int, item: Any, size: int) -> None:
        """Add an item and drop the oldest beyond the limits.

        With `newest`, replacing an older item does not count as a drop.
        """
        self.waiting.append((number, item, size))
        self._bytes += size
        while len(self.waiting) > self._most or self._bytes > WAITING_BYTES:
            self.popleft()
            self.dropped += not (self._newest and self.waiting)

    def popleft(self) -> Any:
        _, item, size = self.waiting.popleft()
        self._bytes -= size
        return item


class Inbox:
    """A queue of items in order of arrival, for one thread that takes them.

    Each kind has its own lane: a flood on one lane drops no items of another.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Released when something comes. Not a SimpleQueue: its `get(timeout)` never returns if a
        # signal's handler runs across the deadline (CPython 3.11 and 3.12).
        self._came = threading.Lock()
        self._came.acquire()
        self._lanes = {"": _Lane("", math.inf)}
        self._count = 0

    def put(self, item: Any) -> None:
        """Add an item of the service's own; it is never dropped."""
        self._add(self._lanes[""], item, 0)

    def lane(
        self, name: str, most: int = WAITING_MESSAGES, *, newest: bool = False, urgent: bool = False
    ) -> Callable[[Any, int], None]:
        """Return a function (item, size in bytes) that adds items of one kind, from any thread.

        If more than `most` items or WAITING_BYTES wait, the oldest are dropped. With `newest` only the
        newest waits; those it replaces are not counted as dropped. With `urgent` they overtake all others
        that wait.
        """
        with self._lock:
            lane = self._lanes.setdefault(name, _Lane(name, 1 if newest else most, newest, urgent))
        return partial(self._add, lane)

    def _add(self, lane: _Lane, item: Any, size: int) -> None:
        with self._lock:
            self._count += 1
            lane.append(self._count, item, size)
            if self._came.locked():
                self._came.release()

    def get(self, timeout: float | None = None) -> Any:
        """Return the next item; raises queue.Empty if none comes within `timeout` seconds."""
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        while True:
            with self._lock:
                if full := [lane for lane in self._lanes.values() if lane.waiting]:
                    # Urgent lanes first, then the one with the oldest item.
                    return min(full, key=lambda lane: (not lane.urgent, lane.waiting[0][0])).popleft()
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                raise queue.Empty
            self._came.acquire(timeout=min(left_s, threading.TIMEOUT_MAX))

    def waiting(self) -> int:
        """Return the number of waiting items."""
        with self._lock:
            return sum(len(lane.waiting) for lane in self._lanes.values())

    def tell_dropped(self, log: Log) -> None:
        """Count and log the items dropped since the last call."""
        with self._lock:
            lanes = [*self._lanes.values()]
        for lane in lanes:
            lane.drops.tell(lane.dropped, log)
