"""The trace of a mission as the launcher hears it: a point of each belief, and of lost beliefs what their
readings tell.
"""

import math
from bisect import bisect_left, bisect_right

from link.bus.mavlink import BadFrame, nearest, unpack_reading
from link.bus.messages import Belief
from plume.outcome import TracePoint

MOST_READINGS = 100_000
"""Readings that wait for their beliefs; a stranger could publish without end."""


class HeardTrace:
    """Beliefs by step, and the readings since the last of them before which none is missing.

    Beliefs are dropped where a link cannot carry them; readings never are.
    """

    def __init__(self) -> None:
        """Begin with nothing heard."""
        self._points: dict[int, TracePoint] = {}
        self._times: dict[int, float] = {-1: -math.inf}
        self._near_ms: int | None = None
        """The time of the newest belief, ms, which goes on where time_boot_ms wraps; before any, that of
        the first reading.
        """
        self.kept: dict[int, tuple[tuple[float, float], float]] = {}
        """The readings whose beliefs are not all known, by time."""
        self._whole_to = -1

    def reading(self, payload: bytes, system: int | None) -> None:
        """Take a reading of a system, or with None of any; one that cannot be read is left to the
        estimator, which refuses it.
        """
        try:
            said = unpack_reading(payload, system)
        except BadFrame:
            return
        time_ms = self._time_ms(said.time_boot_ms)
        if time_ms > self._times[self._whole_to] and len(self.kept) < MOST_READINGS:
            self.kept.setdefault(time_ms, (said.position, said.gas))

    def _time_ms(self, time_boot_ms: int) -> int:
        if self._near_ms is None:
            self._near_ms = time_boot_ms
        return nearest(self._near_ms, time_boot_ms)

    def belief(self, belief: Belief) -> bool:
        """Take a belief; returns whether it is a new one."""
        if belief.step in self._points:
            return False
        self._points[belief.step] = TracePoint(belief.position, belief.gas, belief.mean, belief.spread)
        self._times[belief.step] = self._near_ms = self._time_ms(belief.time_boot_ms)
        if belief.step == self._whole_to + 1:
            while self._whole_to + 1 in self._points:
                self._whole_to += 1
            now = self._times[self._whole_to]
            self.kept = {time: said for time, said in self.kept.items() if time > now}
        return True

    def time_s(self, step: int) -> float:
        """Return the simulation time of a belief that has come, s."""
        return self._times[step] / 1000

    @property
    def missing(self) -> int:
        """How many beliefs before the last one have not come."""
        return max(self._points, default=-1) + 1 - len(self._points)

    def points(self) -> list[TracePoint] | None:
        """Return the trace; None if it cannot be told.

        Of a belief that has not come the position and gas are those of its reading, mean and spread are
        NaN.
        The readings between two beliefs tell of those between if they are as many: the estimator may have
        refused some.
        """
        trace: list[TracePoint] = []
        times = sorted(self.kept)
        for step in sorted(self._points):
            if lost := step - len(trace):
                between = times[
                    bisect_right(times, self._times[len(trace) - 1]) : bisect_left(times, self._times[step])
                ]
                if len(between) != lost:
                    return None
                trace += [
                    TracePoint(*self.kept[time], mean=(math.nan, math.nan), spread=math.nan)
                    for time in between
                ]
            trace.append(self._points[step])
        return trace
