"""A search by several vehicles as one of them knows it: its own berth, and who takes part in the rounds."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from link.bus.keys import OF_VEHICLE, SEARCHERS
from link.cli import numbers

Place = tuple[float, float]  # (x, y) m


class Berth(NamedTuple):
    """The place of one of several vehicles in their search."""

    start: Place
    others: Sequence[Place] = ()  # where the others start
    separation_m: float = 0.0
    origin: tuple[float, float] | None = None  # of the plane, latitude and longitude, degrees; None: its home

    def crowded(self, home: Place) -> Place | None:
        """Return a start of another to which a home is too near; None if there is none.

        Each vehicle's home has to be nearer to its own start than to any other's, by the separation. Then
        the ways of all to their starts are as far apart: with P on one way and Q on another, each nearer to
        its own start by s, the triangle inequality, once for either start, gives 2 |PQ| >= 2 s. All of a
        way is nearer, as its ends are, because a branch of a hyperbola bounds a convex region.
        """
        own_m = math.dist(home, self.start)
        return next((at for at in self.others if math.dist(home, at) - own_m < self.separation_m), None)


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
