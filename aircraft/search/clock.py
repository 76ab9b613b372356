"""Simulation time: real time, a multiple of it, or (speed-up 0) as fast as possible."""

import time


class Clock:
    """The simulation time of one process, in s.

    At speed-up 0 the clock stands still while the vehicle waits, and jumps to the end of each leg that it
    flies. The times of a mission therefore do not depend on the speed of the computer.
    """

    def __init__(self, speedup: float) -> None:
        self.speedup = speedup
        self._began = time.monotonic()
        self._jumped_s = 0.0
        self._idle_since = self._began

    def now_s(self) -> float:
        """Return the simulation time."""
        return (time.monotonic() - self._began) * self.speedup if self.speedup else self._jumped_s

    def stream_s(self) -> float:
        """Return the time that telemetry rates refer to; it continues while the simulation stands still."""
        return self.now_s() if self.speedup else self._jumped_s + time.monotonic() - self._began

    def heard(self) -> None:
        """Restart the count of a client's silence."""
        self._idle_since = time.monotonic()

    def jump(self, moving: bool, next_event_s: float | None) -> None:
        """At speed-up 0, jump to the next event.

        At once if the vehicle moves, else after an equal real time without a setpoint.
        """
        if next_event_s is None:
            return
        if moving or time.monotonic() - self._idle_since >= next_event_s - self._jumped_s:
            self._jumped_s = next_event_s
            self._idle_since = time.monotonic()

    def wait_s(self, next_event_s: float | None, next_stream_s: float) -> float:
        """Return the real time in s until the next event or the next telemetry is due."""
        waits = [(next_stream_s - self.stream_s()) / (self.speedup or 1.0)]
        if next_event_s is not None and self.speedup:
            waits.append((next_event_s - self.now_s()) / self.speedup)
        elif next_event_s is not None:
            waits.append(next_event_s - self._jumped_s - (time.monotonic() - self._idle_since))
        return max(min(waits), 0.0)
