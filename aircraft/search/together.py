"""Who takes part in the rounds of a search by several vehicles, as one of them knows it."""

import math

from link.bus.keys import OF_VEHICLE, SEARCHERS
from link.cli import numbers


class Together:
    """The vehicles of a search by several, and from which round on each no longer takes part."""

    def __init__(self, vehicles: int) -> None:
        """Take how many begin; with one, or none given, it searches alone."""
        self.among = vehicles
        self._ends = dict.fromkeys(numbers(vehicles), math.inf)  # the first round without each vehicle

    @property
    def services(self) -> frozenset[str]:
        """The services without which the search does not begin: none waits in the air for one that never
        comes.
        """
        there = [number for number, end in self._ends.items() if end == math.inf]
        return SEARCHERS | {f"{OF_VEHICLE}{number}" for number in there}

    def here(self, step: int) -> list[int]:
        """Return the numbers of the vehicles that take part in a round."""
        return [number for number, end in self._ends.items() if step < end]

    def leaves(self, vehicle: int, step: int) -> None:
        """Take a vehicle out of the rounds from `step` on. It is not waited for."""
        if self._ends.get(vehicle) == math.inf:
            self._ends[vehicle] = step
