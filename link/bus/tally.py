"""The counts and state of a service, which it publishes as its health."""

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

RATE_OVER_S = 10.0
LATELY_S = 60.0
# Kind of messages that are refused only because they came before; this is normal in a healthy mission.
REPEATED = "repeated"
OVERFLOW = "overflow"  # kind of messages that are dropped because too many wait
STRANGER = "stranger"  # kind of messages from services whose names are not admitted
FAULT = "fault"  # kind of messages that could not be handled for a fault of ours
# Recent merges events closer than this share of its window. It thus stores about a thousand at most.
GRAIN = 0.001


class Recent:
    """Counts events in a sliding time window."""

    def __init__(self, within_s: float) -> None:
        self._within_s = within_s
        self._events: deque[tuple[float, int]] = deque()
        self._total = 0

    def add(self, now_s: float, count: int) -> None:
        """Count `count` events now."""
        is_near = self._events and now_s - self._events[-1][0] < GRAIN * self._within_s
        since_s, before = self._events.pop() if is_near else (now_s, 0)
        self._events.append((since_s, before + count))
        self._total += count
        self.total(now_s)

    def total(self, now_s: float) -> int:
        """Return the number of events in the window that ends at now_s."""
        while self._events and self._events[0][0] <= now_s - self._within_s:
            self._total -= self._events.popleft()[1]
        return self._total


@dataclass
class Tally:
    """The counts and state of one service."""

    now_s: Callable[[], float] = time.monotonic
    state: str = "ready"
    about: str = ""  # its configuration, in a few words
    step: int = -1
    compute_s: float = 0.0
    latency_s: float = 0.0
    warnings: tuple[str, ...] = ()
    last_error: str = ""
    last_refused: str = ""  # the message that was dropped last, and why, in words
    ceased: bool = False  # true once it knows of the stop
    system: int = 0  # a vehicle's MAVLink system id
    refused: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self._began_s = self.now_s()
        self._done = Recent(RATE_OVER_S)
        self._refused = Recent(LATELY_S)

    def did(self, step: int, count: int = 1) -> None:
        """Count finished work, and take the step it has reached."""
        self.step = step
        self._done.add(self.now_s(), count)

    def refuse(self, kind: str, count: int = 1) -> None:
        """Count dropped messages under their kind."""
        self.refused[kind] += count
        if kind != REPEATED:
            self._refused.add(self.now_s(), count)

    @property
    def uptime_s(self) -> float:
        """Seconds since the start."""
        return self.now_s() - self._began_s

    @property
    def rate_hz(self) -> float:
        """Finished work per second, over the last RATE_OVER_S or since the start."""
        return self._done.total(self.now_s()) / max(min(self.uptime_s, RATE_OVER_S), 1.0)

    @property
    def refused_lately(self) -> int:
        """Messages dropped within the last LATELY_S."""
        return self._refused.total(self.now_s())
