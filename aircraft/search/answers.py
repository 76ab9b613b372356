"""The readings of a search, and which waypoint answers the newest."""

from aircraft.state import Result, denied, not_now
from link.bus.mavlink import WRAP_MS, elapsed_ms


class Answers:
    """The readings of one search, by their MAVLink time, and which waypoint answers them."""

    def __init__(self) -> None:
        self._readings: set[int] = set()
        self._last_ms = -1
        self.newest: int | None = None  # the time of the newest reading
        self.awaited = False  # True while the newest reading is unanswered

    def time_of(self, now_ms: float) -> int:
        """Return the time_boot_ms of a reading that is about to be taken, later than that of any before."""
        self._last_ms = max(round(now_ms), self._last_ms + 1)
        return self._last_ms % WRAP_MS

    def sampled(self, time_boot_ms: int) -> None:
        """Note that a reading was taken. Raises ValueError unless times increase."""
        if self.newest is not None and elapsed_ms(self.newest, time_boot_ms) <= 0:
            raise ValueError(
                f"reading at {time_boot_ms} ms after one at {self.newest} ms: reading times must increase"
            )
        self._readings.add(time_boot_ms)
        self.newest, self.awaited = time_boot_ms, True

    def refusal(self, time_boot_ms: int) -> Result | None:
        """Return why a waypoint with this time is not the awaited answer, if so.

        One that comes late or twice is only ignored.
        """
        if time_boot_ms not in self._readings:
            return denied(f"Waypoint refused: no reading was taken at {time_boot_ms} ms", "no reading")
        if time_boot_ms != self.newest or not self.awaited:
            kind = "duplicate" if time_boot_ms == self.newest else "late"
            return not_now(f"Waypoint ignored: {kind} answer to the reading at {time_boot_ms} ms")
        return None
