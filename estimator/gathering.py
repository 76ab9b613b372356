"""Gathering: which readings of a search by several vehicles belong together, in a defined order.

Round k has reading k of each vehicle that takes part in it, in the order of the vehicles. It is whole when
the last of them has come, however they come: late, twice, or all those of one vehicle before those of
another. A vehicle that leaves takes part in the rounds before the one in which it left, and one that comes
late in those from its first on: its reading k belongs to the k-th of them.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import takewhile

from link.bus.mavlink import Reading


class Gathering:
    """The readings that wait for their round, and the newest of each vehicle."""

    def __init__(self, vehicles: int) -> None:
        self.newest: list[Reading | None] = [None] * vehicles
        self.counts = [0] * vehicles  # how many of each have been taken
        self._waiting: list[deque[Reading]] = [deque() for _ in range(vehicles)]
        self._begins = [0.0] * vehicles  # the first round that it takes part in; inf: not known yet
        self._ends = [math.inf] * vehicles  # the first round that it takes no part in any more
        self._next = 0  # the number of the next round

    @property
    def number(self) -> int:
        """The number of the next round."""
        return self._next

    @property
    def has_begun(self) -> bool:
        """Whether any vehicle has read."""
        return any(self.counts)

    def take(self, reading: Reading) -> None:
        """Take an admitted reading: it is later than those of its vehicle before."""
        own = reading.vehicle - 1
        self.newest[own] = reading
        self.counts[own] += 1
        self._waiting[own].append(reading)

    def begun(self) -> tuple[Reading, ...]:
        """Return the readings of the next round, in their order, up to the first that is missing."""
        here = takewhile(bool, (self._waiting[number - 1] for number in self._taking_part()))
        return tuple(waiting[0] for waiting in here)

    def whole(self) -> tuple[Reading, ...]:
        """Return the next round, and forget it; empty if a reading is missing."""
        here = self.begun()
        if not here or len(here) < len(self._taking_part()):
            return ()
        self._next += 1
        for each in here:
            self._waiting[each.vehicle - 1].popleft()
        return here

    def waits(self, vehicle: int) -> bool:
        """Whether the newest reading of a vehicle still waits for its round."""
        return bool(self._waiting[vehicle - 1])

    def missing(self) -> Sequence[int]:
        """Return the vehicles for which the others of the next round wait; empty if none has read yet."""
        here = {number: bool(self._waiting[number - 1]) for number in self._taking_part()}
        return [number for number, has_read in here.items() if not has_read] if any(here.values()) else []

    def step_of(self, vehicle: int) -> int:
        """Return the round to which the next reading of a vehicle belongs."""
        return int(self._begins[vehicle - 1]) + self.counts[vehicle - 1]

    def comes_late(self, vehicle: int, step: float = math.inf) -> None:
        """Let a vehicle take part from round `step` on; by default from one that is not known yet.

        Raises ValueError if it has read already, or if the round has been taken without it.
        """
        if self.counts[vehicle - 1]:
            raise ValueError(f"vehicle {vehicle} has read already")
        if step < self._next:
            raise ValueError(f"round {step:g} has been taken without vehicle {vehicle}")
        self._begins[vehicle - 1] = step

    def is_late(self, vehicle: int) -> bool:
        """Whether a vehicle comes late, and has no round yet."""
        return self._begins[vehicle - 1] == math.inf

    def leave(self, vehicle: int, step: int) -> None:
        """Let a vehicle leave: round `step` is the first that it takes no part in.

        Raises ValueError if it has left already, or has been in that round.
        """
        if self.has_ended(vehicle):
            raise ValueError(f"vehicle {vehicle} has left already")
        if step < self._next:
            raise ValueError(f"round {step} has been taken with vehicle {vehicle}")
        self._ends[vehicle - 1] = step

    def left(self) -> Sequence[int]:
        """Return the vehicles that have not left, but for those that have no round yet."""
        return [
            number for number, end in enumerate(self._ends, 1) if end == math.inf and not self.is_late(number)
        ]

    def has_ended(self, vehicle: int) -> bool:
        """Whether a vehicle has left, whatever of its readings is still to come."""
        return self._ends[vehicle - 1] < math.inf

    def is_over(self, vehicle: int) -> bool:
        """Whether no further reading of a vehicle counts."""
        return not self.is_late(vehicle) and self.step_of(vehicle) >= self._ends[vehicle - 1]

    def _taking_part(self) -> Sequence[int]:
        """Return the vehicles that take part in the next round."""
        windows = zip(self._begins, self._ends, strict=True)
        return [number for number, (begin, end) in enumerate(windows, 1) if begin <= self._next < end]
