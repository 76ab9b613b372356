"""When the events of a mission happen: those of a step as its reading is taken, those of a time at that time exactly."""

import heapq
import itertools
from collections import defaultdict
from collections.abc import Callable, Sequence

from sitl.autopilot.state import Arrived
from sitl.script.script import Abort, OnBoard, Pause

Item = OnBoard | Arrived
"""An event; or a place where the sensor was silent, to be tried again."""
BY_OPERATOR = (Pause, Abort)
"""The operator of a script sees a reading before doing something."""


class Timeline:
    """What is still to come."""

    def __init__(self, events: Sequence[OnBoard] = ()) -> None:
        """Take the events in the order in which those of one moment happen. What has neither step nor time comes by `schedule`."""
        self._order = itertools.count()
        self._timed: list[tuple[float, int, Item]] = []
        self._stepped: dict[int, list[OnBoard]] = defaultdict(list)
        for event in events:
            if event.step is not None:
                self._stepped[event.step].append(event)
            elif event.time_s is not None:
                self.schedule(event.time_s, event)

    def schedule(self, time_s: float, item: Item) -> None:
        """Have something happen at a time."""
        heapq.heappush(self._timed, (time_s, next(self._order), item))

    def next_s(self) -> float | None:
        """When the next thing of a time happens."""
        return self._timed[0][0] if self._timed else None

    def pop(self) -> Item:
        """Take the next thing of a time."""
        return heapq.heappop(self._timed)[2]

    def before(self, step: int) -> list[OnBoard]:
        """Take the events of a step that bear on its reading."""
        return self._take(step, lambda event: not isinstance(event, BY_OPERATOR))

    def after(self, step: int) -> list[OnBoard]:
        """Take the events of a step that come once its reading is there."""
        return self._take(step, lambda event: isinstance(event, BY_OPERATOR))

    def _take(self, step: int, wanted: Callable[[OnBoard], bool]) -> list[OnBoard]:
        taken = [event for event in self._stepped[step] if wanted(event)]
        self._stepped[step] = [event for event in self._stepped[step] if not wanted(event)]
        return taken
