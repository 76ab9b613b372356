"""Waits that double: when something that has not worked is tried again."""

import math


class Backoff:
    """When the next try is due. Each wait is twice the one before, up to a longest one."""

    def __init__(self, first_s: float, last_s: float) -> None:
        """Take the first and the longest wait, s. The first try is due at once."""
        self.due_s = -math.inf  # infinity: nothing is to be tried
        self._first_s, self._last_s = first_s, last_s
        self._wait_s = first_s

    def due(self, now_s: float) -> bool:
        """Whether a try is due. If so, it is taken to be made now."""
        if now_s < self.due_s:
            return False
        self.due_s = now_s + self._wait_s
        self._wait_s = min(2 * self._wait_s, self._last_s)
        return True

    def tried(self, now_s: float) -> None:
        """Take that a first try is made now: the waits begin anew."""
        self._wait_s = self._first_s
        self.due_s = -math.inf
        self.due(now_s)

    def relax(self, now_s: float) -> None:
        """Let the waits begin anew, without a try: the next one is due after the first wait at the latest."""
        self._wait_s = self._first_s
        self.due_s = min(self.due_s, now_s + self._first_s)
