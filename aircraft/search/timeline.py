"""When the events of a mission happen: an event with a step at that step's reading, an event with a time
at exactly that time.
"""

import heapq
import itertools
from collections.abc import Callable, Sequence
from functools import partial

from aircraft.search.events import Hold, Land, OnBoard, Resume, Return

# Operator events: they happen after the reading of their step, all others before it
BY_OPERATOR = (Hold, Return, Land)


class Timeline:
    """What is still to happen. Times are simulation time in s."""

    def __init__(self, events: Sequence[OnBoard], perform: Callable[[OnBoard], object]) -> None:
        """Take the events, and what carries one out. Simultaneous ones happen in this order."""
        self._perform = perform
        self._order = itertools.count()
        self._timed: list[tuple[float, int, Callable[[], object]]] = []
        self._stepped = [event for event in events if event.step is not None]
        self._after_hold_s = [
            event.after_s for event in events if isinstance(event, Resume) and event.after_s is not None
        ]
        for event in events:
            if event.time_s is not None:
                self.at(event.time_s, partial(perform, event))

    def at(self, time_s: float, action: Callable[[], object]) -> None:
        """Let something happen at a time."""
        heapq.heappush(self._timed, (time_s, next(self._order), action))

    def next_s(self) -> float | None:
        """Return the time of what happens next; None if nothing has a time."""
        return self._timed[0][0] if self._timed else None

    def go_on(self, now_s: float) -> None:
        """Let the next thing happen, if its time has come."""
        if self._timed and self._timed[0][0] <= now_s:
            heapq.heappop(self._timed)[2]()

    def reach(self, step: int, *, by_operator: bool) -> None:
        """Perform the events of a step, once: the operator's follow its reading, all others precede it."""
        due = [e for e in self._stepped if e.step == step and isinstance(e, BY_OPERATOR) is by_operator]
        for event in due:
            self._stepped.remove(event)
            self._perform(event)

    def held(self, now_s: float) -> None:
        """The operator has held the vehicle: the next resume with `after_s` counts from now."""
        if self._after_hold_s:
            due_s = now_s + self._after_hold_s.pop(0)
            self.at(due_s, partial(self._perform, Resume(time_s=due_s)))
