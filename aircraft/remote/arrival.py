"""The targets of a real vehicle: whose it flies to, and when it has arrived."""

import math
from collections import deque

from aircraft.state import Ned

# It arrives once it has stayed this near to its target, no faster than this, for this long.
RADIUS_M, SPEED_MPS, SETTLE_S = 0.3, 0.25, 0.3
SLOWEST_MPS, GRACE_S = 1.0, 30.0  # a leg has failed that takes longer than at this speed, and this much more
SAME_M = 0.1  # targets this near to each other are the same
KEPT = 4  # this many of our latest targets may still be read back: a radio link is slow


def deadline_s(now_s: float, position: Ned, target: Ned) -> float:
    """Return when a leg that begins now has failed."""
    return now_s + math.dist(position, target) / SLOWEST_MPS + GRACE_S


class Approach:
    """The way to one target, judged by telemetry. Positions NED in m, times in s."""

    def __init__(self, target: Ned, deadline_s: float) -> None:
        self.target, self.deadline_s = target, deadline_s
        self._near_since_s = math.inf

    def arrived(self, at_s: float, position: Ned, velocity: Ned, known: bool) -> bool:
        """Take where the vehicle is, at a time of its own clock.

        Returns whether it has arrived; with a position not `known`, it has not.

        By the vehicle's clock, what a slow or halting link takes is no time at rest.
        """
        near = math.dist(position, self.target) <= RADIUS_M and math.hypot(*velocity) <= SPEED_MPS
        self._near_since_s = min(self._near_since_s, at_s) if near and known else math.inf
        return at_s - self._near_since_s >= SETTLE_S


class Targets:
    """Whose target an autopilot flies to, as far as it reads back.

    Positions NED, m from the EKF's origin; None is no position.

    What it reads back is foreign if it is neither one of ours nor what it was before: a target of ours
    that the autopilot does not take leaves the one before, and a take-off reads back whatever was there
    before it.
    """

    def __init__(self) -> None:
        self._ours: deque[Ned] = deque(maxlen=KEPT)
        self._read: Ned | None = None
        self._fresh = True

    def send(self, target: Ned) -> None:
        """Note that this target of ours is sent."""
        if not self._ours or self._ours[-1] != target:
            self._ours.append(target)

    def begin(self) -> None:
        """Take whatever is read back next for what was there before: the mode has changed, or the vehicle
        stands.
        """
        self._fresh = True

    def takes(self, target: Ned | None) -> bool:
        """Take what the autopilot reads back; returns False if it is foreign."""
        before, fresh = self._read, self._fresh
        self._read, self._fresh = target, False
        return fresh or _same(target, before) or any(_same(target, one) for one in self._ours)

    def has(self, target: Ned) -> bool:
        """Whether the autopilot has read back this target last."""
        return not self._fresh and _same(self._read, target)


def _same(one: Ned | None, other: Ned | None) -> bool:
    return one is other if one is None or other is None else math.dist(one, other) <= SAME_M
