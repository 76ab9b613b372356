"""Values and places in order of time, of which those of any moment can be asked for."""

import math
import sys
from bisect import bisect_right
from typing import Generic, TypeVar

import numpy as np

from scene.scene import Floats, Point

MOST = 100_000  # where not all is kept: most readings, points and happenings; then the older half goes

T = TypeVar("T")


class Timed(Generic[T]):
    """Values in order of time; a time before the last one counts as the last one."""

    def __init__(self, whole: bool = True, most: int = 1) -> None:
        """Keep all values, or the newest: `most`, and at least half of it."""
        self.times_s: list[float] = []
        self.values: list[T] = []
        self._most = sys.maxsize if whole else most

    def add(self, time_s: float, value: T) -> None:
        """Add the newest."""
        self.times_s.append(max([time_s, *self.times_s[-1:]]))
        self.values.append(value)
        if len(self.values) > self._most:
            old = len(self.values) - (self._most + 1) // 2
            del self.times_s[:old], self.values[:old]

    def restart(self, time_s: float) -> None:
        """Keep only the newest value, if there is any, and take it as of another time."""
        self.values = self.values[-1:]
        self.times_s = [time_s] * len(self.values)

    def until(self, time_s: float) -> list[T]:
        """All values until a time, it included."""
        return self.values[: bisect_right(self.times_s, time_s)]

    def at(self, time_s: float = math.inf) -> T | None:
        """The newest value, by default of all."""
        count = bisect_right(self.times_s, time_s)
        return self.values[count - 1] if count else None


class Trail:
    """Where the vehicle was, in order of time.

    What was once taken stays as it is, so that no scene needs a copy of it.
    """

    def __init__(self, whole: bool) -> None:
        """Keep all places, or the newest: `MOST`, and at least half of it."""
        self.last: Point | None = None
        self._times_s: list[float] = []
        self._places: Floats = np.empty((64, 2), np.float32)
        self._most = sys.maxsize if whole else MOST

    def add(self, time_s: float, place: Point) -> None:
        """Add the newest."""
        count = len(self._times_s)
        if count >= min(len(self._places), self._most):
            kept = self._places[count - self._most // 2 if count >= self._most else 0 : count]
            del self._times_s[: count - len(kept)]
            count = len(kept)
            self._places = np.concatenate([kept, np.empty_like(kept)])  # scenes have the former ones
        self._times_s.append(max([time_s, *self._times_s[-1:]]))
        self._places[count] = self.last = place

    def until(self, time_s: float) -> Floats:
        """All places until a time, it included: (N, 2) m."""
        return self._places[: bisect_right(self._times_s, time_s)]
