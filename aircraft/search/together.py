"""A search by several vehicles as one of them knows it: its own berth, and who takes part in the rounds."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from link.bus.keys import OF_VEHICLE, SEARCHERS
from link.cli import numbers
from plume.problem import Area

Place = tuple[float, float]  # (x, y) m


class Berth(NamedTuple):
    """The place of one of several vehicles in their search."""

    start: Place
    others: Sequence[Place] = ()  # where the others start
    separation_m: float = 0.0
    origin: tuple[float, float] | None = None  # of the plane, latitude and longitude, degrees; None: its home

    def misplaced(self, home: Place, area: Area) -> str:
        """Return why a home, (x, y) m, is not one to search from; empty if it is."""
        nearest = [min(max(at, low), high) for at, low, high in zip(home, area.low, area.high, strict=True)]
        beyond_m, most_m, (x, y) = math.dist(home, nearest), math.hypot(*area.size_m), home
        if beyond_m > most_m:
            return (
                f"home is {beyond_m:.0f} m from the area, ({x:.0f}, {y:.0f}) m from its origin; wanted at "
                f"most {most_m:.0f} m: is --home right?"
            )
        if other := self.crowded(home):
            own, others = (f"({each[0]:.1f}, {each[1]:.1f})" for each in (self.start, other))
            return (
                f"home, ({x:.1f}, {y:.1f}) m from the area's origin, is not nearer by "
                f"{self.separation_m:g} m (--separation) to its start {own} than to another's {others}: "
                "their ways could meet; move it, or choose another --from"
            )
        return ""

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
