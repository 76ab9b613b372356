"""Where all that arrives waits for a service's loop: bounded, so that a flood costs messages, but neither memory nor whoever puts."""

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from link.bus.log import Log
from link.bus.tally import OVERFLOW

WAITING_MESSAGES = 4096
"""Of each key, beside those that are kept: where more wait to be taken, the oldest are dropped rather than the flight held up."""
WAITING_BYTES = 256 * 2**20
"""Of each key; a belief of a million particles has up to 36 MB."""
BURST_S = 10.0
"""What is dropped within so long of the last is the same burst."""


class Overflow:
    """How much of something was dropped because too much waited: counted each time, logged once a burst."""

    def __init__(self, name: str) -> None:
        """Take what it is that waits."""
        self._name = name
        self._told = 0
        self._told_at = -math.inf

    def tell(self, dropped: int, log: Log) -> None:
        """Take how much it is altogether; count and log what was dropped since the last time."""
        if (count := dropped - self._told) == 0:
            return
        self._told = dropped
        log.tally.refuse(OVERFLOW, count)
        now_s = log.tally.now_s()
        if now_s - self._told_at >= BURST_S:
            log.warning(f"refused {self._name}: more come than can be taken; of those that wait some are dropped")
        self._told_at = now_s


class _Lane:
    """What waits of one kind, the oldest first, with its size in bytes."""

    def __init__(self, name: str, most: float, newest: bool) -> None:
        self.waiting: deque[tuple[Any, int]] = deque()
        self.turns = 0
        self.dropped = 0
        self.overflow = Overflow(name)
        self._most = most
        self._newest = newest
        self._bytes = 0

    def append(self, item: Any, size: int) -> None:
        """Take one more; what is then too much is dropped. An older one that was to make room for the newest is not missed."""
        self.waiting.append((item, size))
        self._bytes += size
        while len(self.waiting) > self._most or self._bytes > WAITING_BYTES:
            self.popleft()
            self.dropped += not (self._newest and self.waiting)

    def popleft(self) -> Any:
        item, size = self.waiting.popleft()
        self._bytes -= size
        return item


class Inbox:
    """Items in the order in which they came, each kind on a lane of its own, whose floods leave the others' items alone."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._lock = threading.Lock()
        self._turns: queue.SimpleQueue[_Lane] = queue.SimpleQueue()
        """Whose item is taken next: a turn for each item, or more where items were dropped."""
        self._lanes: dict[str, _Lane] = {}
        self._own = _Lane("", math.inf, newest=False)

    def put(self, item: Any) -> None:
        """Add an item of one's own, which is never dropped."""
        self._add(self._own, item, 0)

    def lane(self, name: str, most: int = WAITING_MESSAGES, *, newest: bool = False) -> Callable[[Any, int], None]:
        """Return what adds items of one kind, given their size in bytes, from any thread.

        Where more than `most` of them wait, or WAITING_BYTES, the oldest are dropped; with `newest` all but the newest, uncounted.
        """
        with self._lock:
            lane = self._lanes.setdefault(name, _Lane(name, 1 if newest else most, newest))
        return lambda item, size: self._add(lane, item, size)

    def _add(self, lane: _Lane, item: Any, size: int) -> None:
        with self._lock:
            lane.append(item, size)
            if len(lane.waiting) > lane.turns:
                lane.turns += 1
                self._turns.put(lane)

    def get(self, timeout: float | None = None) -> Any:
        """Return the next item; raises queue.Empty where there is none for so many seconds."""
        until = math.inf if timeout is None else time.monotonic() + timeout
        while True:
            lane = self._turns.get(timeout=timeout)
            with self._lock:
                lane.turns -= 1
                if lane.waiting:
                    return lane.popleft()
            if timeout is not None:
                timeout = max(until - time.monotonic(), 0.0)

    def waiting(self) -> int:
        """Return how many items wait."""
        with self._lock:
            return sum(len(lane.waiting) for lane in (self._own, *self._lanes.values()))

    def tell_dropped(self, log: Log) -> None:
        """Count and log what was dropped since the last time."""
        with self._lock:
            lanes = [*self._lanes.values()]
        for lane in lanes:
            lane.overflow.tell(lane.dropped, log)
