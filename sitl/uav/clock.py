"""Simulation time: real time, a multiple of it, or (speed-up 0) as fast as the loop can."""

import time


class Clock:
    """Tells the simulation time of one process.

    At speed-up 0 it stands still while the vehicle waits and jumps to the end of each leg that the vehicle flies, so that the
    times of a mission do not depend on how fast the computer is.
    """

    def __init__(self, speedup: float) -> None:
        """Begin at zero."""
        self.speedup = speedup
        self._began = time.monotonic()
        self._jumped_s = 0.0
        self._idle_since = self._began

    def now_s(self) -> float:
        """Simulation time."""
        return (time.monotonic() - self._began) * self.speedup if self.speedup else self._jumped_s

    def stream_s(self) -> float:
        """Time that telemetry rates are counted in; it goes on while the simulation stands still."""
        return self.now_s() if self.speedup else self._jumped_s + time.monotonic() - self._began

    def heard(self) -> None:
        """Begin anew to count how long a client has been silent."""
        self._idle_since = time.monotonic()

    def jump(self, moving: bool, next_event_s: float | None) -> None:
        """At speed-up 0: go to the next event at once when the vehicle moves, else when as much real time has passed in silence."""
        if self.speedup or next_event_s is None:
            return
        if moving or time.monotonic() - self._idle_since >= next_event_s - self._jumped_s:
            self._jumped_s = next_event_s
            self._idle_since = time.monotonic()

    def wait_s(self, next_event_s: float | None, next_stream_s: float) -> float:
        """Real time until the next event or the next telemetry is due."""
        waits = [(next_stream_s - self.stream_s()) / (self.speedup or 1.0)]
        if next_event_s is not None and self.speedup:
            waits.append((next_event_s - self.now_s()) / self.speedup)
        elif next_event_s is not None:
            waits.append(next_event_s - self._jumped_s - (time.monotonic() - self._idle_since))
        return max(min(waits), 0.0)
