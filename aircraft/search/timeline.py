"""When the events of a mission happen: an event with a step at that step's reading, an event with a time
at exactly that time.
"""

import heapq
import itertools
from collections import defaultdict
from collections.abc import Callable, Sequence

from aircraft.search.events import Hold, Land, OnBoard, Return
from aircraft.state import Arrived

Item = OnBoard | Arrived
"""A script event, or a place at which to measure again after a sensor dropout."""
BY_OPERATOR = (Hold, Return, Land)
"""Operator events: they happen after the reading of their step, all others before it."""


class Timeline:
    """The events that are still to come. Times are simulation time in s."""

    def __init__(self, events: Sequence[OnBoard] = ()) -> None:
        """Take the events; simultaneous ones happen in this order. An event with neither step nor time
        waits for `schedule`.
        """
        self._order = itertools.count()
        self._timed: list[tuple[float, int, Item]] = []
        self._stepped: dict[int, list[OnBoard]] = defaultdict(list)
        for event in events:
            if event.step is not None:
                self._stepped[event.step].append(event)
            elif event.time_s is not None:
                self.schedule(event.time_s, event)

    def schedule(self, time_s: float, item: Item) -> None:
        """Schedule an item for a time."""
        heapq.heappush(self._timed, (time_s, next(self._order), item))

    def next_s(self) -> float | None:
        """Return the time of the next scheduled item; None if there is none."""
        return self._timed[0][0] if self._timed else None

    def pop(self) -> Item:
        """Remove and return the next scheduled item."""
        return heapq.heappop(self._timed)[2]

    def before(self, step: int) -> list[OnBoard]:
        """Remove and return the events of a step that precede its reading."""
        return self._take(step, lambda event: not isinstance(event, BY_OPERATOR))

    def after(self, step: int) -> list[OnBoard]:
        """Remove and return the events of a step that follow its reading."""
        return self._take(step, lambda event: isinstance(event, BY_OPERATOR))

    def _take(self, step: int, wanted: Callable[[OnBoard], bool]) -> list[OnBoard]:
        taken = [event for event in self._stepped[step] if wanted(event)]
        self._stepped[step] = [event for event in self._stepped[step] if not wanted(event)]
        return taken
