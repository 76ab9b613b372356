"""What a service counts about itself, and publishes as its health."""

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

RATE_OVER_S = 10.0
LATELY_S = 60.0
REPEATED = "repeated"
"""What is refused only because it was taken before: that happens in sound missions, too."""
OVERFLOW = "overflow"
"""What is dropped because too much waits to be taken."""
GRAIN = 0.001
"""Share of its time within which Recent takes events as one: however many there are, it remembers a thousand."""


class Recent:
    """How much happened within the last seconds."""

    def __init__(self, within_s: float) -> None:
        """Take the seconds."""
        self._within_s = within_s
        self._events: deque[tuple[float, int]] = deque()
        self._total = 0

    def add(self, now_s: float, count: int) -> None:
        """Count so many now."""
        self._total += count
        if self._events and now_s - self._events[-1][0] < GRAIN * self._within_s:
            since_s, before = self._events.pop()
            self._events.append((since_s, before + count))
        else:
            self._events.append((now_s, count))
        self.total(now_s)

    def total(self, now_s: float) -> int:
        """Return how many there were."""
        while self._events and self._events[0][0] <= now_s - self._within_s:
            self._total -= self._events.popleft()[1]
        return self._total


@dataclass
class Tally:
    """What a service counts about itself."""

    now_s: Callable[[], float] = time.monotonic
    state: str = "ready"
    about: str = ""
    """What it runs with, in a few words."""
    step: int = -1
    compute_s: float = 0.0
    latency_s: float = 0.0
    warnings: tuple[str, ...] = ()
    last_error: str = ""
    refused: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        """Begin to count."""
        self._began_s = self.now_s()
        self._done = Recent(RATE_OVER_S)
        self._refused = Recent(LATELY_S)

    def did(self, step: int, count: int = 1) -> None:
        """Count what was done, and the step that it brought."""
        self.step = step
        self._done.add(self.now_s(), count)

    def refuse(self, kind: str, count: int = 1) -> None:
        """Count messages that are dropped."""
        self.refused[kind] += count
        if kind != REPEATED:
            self._refused.add(self.now_s(), count)

    @property
    def uptime_s(self) -> float:
        """Since it began."""
        return self.now_s() - self._began_s

    @property
    def rate_hz(self) -> float:
        """What was done, by second, over the last RATE_OVER_S or since the beginning."""
        return self._done.total(self.now_s()) / max(min(self.uptime_s, RATE_OVER_S), 1.0)

    @property
    def refused_lately(self) -> int:
        """Messages dropped within the last LATELY_S."""
        return self._refused.total(self.now_s())
