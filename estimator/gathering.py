"""Gathering: which readings of a search by several vehicles belong together, in a defined order.

Round k has reading k of each vehicle, in the order of the vehicles. It is whole when the last of them has
come, however they come: late, twice, or all those of one vehicle before those of another.
"""

from collections import deque

from link.bus.mavlink import Reading


class Gathering:
    """The readings that wait for their round, and the newest of each vehicle."""

    def __init__(self, vehicles: int) -> None:
        self.newest: list[Reading | None] = [None] * vehicles
        self._waiting: list[deque[Reading]] = [deque() for _ in range(vehicles)]

    def take(self, reading: Reading) -> None:
        """Take an admitted reading: it is later than those of its vehicle before."""
        self.newest[reading.vehicle - 1] = reading
        self._waiting[reading.vehicle - 1].append(reading)

    def whole(self) -> tuple[Reading, ...]:
        """Return the next round, and forget it; empty if a reading is missing."""
        if not all(self._waiting):
            return ()
        return tuple(waiting.popleft() for waiting in self._waiting)

    def waits(self, vehicle: int) -> bool:
        """Whether the newest reading of a vehicle still waits for its round."""
        return bool(self._waiting[vehicle - 1])
