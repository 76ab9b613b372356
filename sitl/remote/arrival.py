"""When a real vehicle counts as having arrived: near enough and slow enough, for long enough."""

import math
from typing import NamedTuple

from sitl.autopilot.motion import Ned


class ArrivalRule(NamedTuple):
    """It arrives once it has stayed within `radius_m` of its target, no faster than `speed_mps`, for `settle_s`."""

    radius_m: float = 0.3
    speed_mps: float = 0.25
    settle_s: float = 0.3
    slowest_mps: float = 1.0
    """A leg that takes longer than at this speed, and `grace_s` more, has failed."""
    grace_s: float = 30.0

    def deadline_s(self, now_s: float, position: Ned, target: Ned) -> float:
        """Return when a leg that begins now has failed."""
        return now_s + math.dist(position, target) / self.slowest_mps + self.grace_s


class Approach:
    """The way to one target, judged by telemetry. Positions NED in m, times in s."""

    def __init__(self, arrival: ArrivalRule, target: Ned, deadline_s: float) -> None:
        """Begin: not yet near."""
        self.target, self.deadline_s = target, deadline_s
        self._arrival = arrival
        self._near_since_s = math.inf

    def arrived(self, now_s: float, position: Ned, velocity: Ned, known: bool) -> bool:
        """Take where the vehicle is now; returns whether it has arrived; while the position is not `known`, it has not."""
        near = math.dist(position, self.target) <= self._arrival.radius_m and math.hypot(*velocity) <= self._arrival.speed_mps
        self._near_since_s = min(self._near_since_s, now_s) if near and known else math.inf
        return now_s - self._near_since_s >= self._arrival.settle_s
