"""Which readings were taken, and whether the newest has been answered by a waypoint."""


class Answers:
    """The readings of one vehicle, by their MAVLink time."""

    def __init__(self) -> None:
        """Begin without a reading: nothing awaits an answer."""
        self._readings: set[int] = set()
        self.newest: int | None = None
        """The time of the newest reading."""
        self.awaited = False
        """True while the newest reading is unanswered."""

    def sampled(self, time_boot_ms: int) -> None:
        """Note that a reading was taken. Raises ValueError unless times increase."""
        if self.newest is not None and time_boot_ms <= self.newest:
            raise ValueError(f"reading at {time_boot_ms} ms after one at {self.newest} ms: reading times must increase")
        self._readings.add(time_boot_ms)
        self.newest, self.awaited = time_boot_ms, True

    def has(self, time_boot_ms: int | None) -> bool:
        """True if a reading was taken at this time."""
        return time_boot_ms in self._readings

    def wants(self, time_boot_ms: int | None) -> bool:
        """True if a waypoint with this time is the awaited answer."""
        return self.awaited and time_boot_ms == self.newest

    def superfluous(self, time_boot_ms: int | None) -> str:
        """Name what a waypoint is that answers an older reading or one that has been answered: late or duplicate; else nothing."""
        if not self.has(time_boot_ms) or self.wants(time_boot_ms):
            return ""
        return "duplicate" if time_boot_ms == self.newest else "late"
