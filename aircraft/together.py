"""A search by several vehicles as one of them knows it: its own berth, who takes part, how it joins late."""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from msgspec import UNSET

from link.bus.keys import OF_VEHICLE, SEARCHERS
from link.bus.messages import Belief, Join, Latecomer
from plume.problem import Area

Place = tuple[float, float]  # (x, y) m


AT_START_M = 1.0  # how far from its start a vehicle that joins late may stand
# What our estimator says of itself; with the number of vehicles, if they are several.
ESTIMATOR_ABOUT = re.compile(
    r"^\d+ particles, assume [^,]*, stop [^ ]*?(?:, (\d) vehicles)?(?:, without (.*))?$"
)


def searching(about: str) -> int:
    """Return how many vehicles an estimator is for, by what its health says of it; 0 if it does not say."""
    ours = ESTIMATOR_ABOUT.search(about)
    return int(ours[1] or 1) if ours else 0


def searchers(about: str) -> set[str]:
    """Return the parts that search together, `uav/1` and so on, by what their estimator's health says of it.

    Empty if one searches alone, or if it does not say for how many it is.
    """
    ours, vehicles = ESTIMATOR_ABOUT.search(about), searching(about)
    every = {f"{OF_VEHICLE}{number}" for number in range(1, vehicles + 1)} if vehicles > 1 else set()
    return every - {*(ours[2] or "").split(", ")} if ours else set()


def misfit(about: str, vehicles: int) -> str:
    """Return why so many vehicles cannot search with an estimator, by what its health says of it.

    Empty if they can, or if it does not say for how many it is.
    """
    wanted = searching(about)
    if wanted in (0, vehicles):
        return ""
    flags = f"with --vehicles {vehicles}" if vehicles > 1 else "without --vehicles"
    plural = "s" * (wanted > 1)
    return f"is for {wanted} vehicle{plural}, and {vehicles} would fly: start it {flags}"


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
    """The vehicles of a search by several, and in which rounds each takes part."""

    def __init__(self, vehicles: int = 1, number: int = 1, berth: Berth | None = None) -> None:
        """Take how many there are, and which of them this is, with its place; with one it searches alone."""
        self.among, self.berth = max(vehicles, 1), berth
        self._number = number
        # The first round with each vehicle, inf where it comes late and has none yet; and the first without.
        numbers = range(1, vehicles + 1) if vehicles > 1 else ()
        self._begins = dict.fromkeys(numbers, 0.0)
        self._ends = dict.fromkeys(numbers, math.inf)

    @property
    def services(self) -> frozenset[str]:
        """The services without which the search does not begin: none waits in the air for one that never
        comes.
        """
        there = [each for each, end in self._ends.items() if end == math.inf and not self._begins[each]]
        return SEARCHERS | {f"{OF_VEHICLE}{number}" for number in there}

    @property
    def begin(self) -> float:
        """The first round that this vehicle takes part in; inf: it comes late and has none yet."""
        return self._begins.get(self._number, 0.0)

    def here(self, step: int) -> list[int]:
        """Return the numbers of the vehicles that take part in a round; none of one that searches alone."""
        return [number for number, end in self._ends.items() if self._begins[number] <= step < end]

    def leaves(self, vehicle: int, step: int) -> None:
        """Take a vehicle out of the rounds from `step` on. It is not waited for."""
        if self._ends.get(vehicle) == math.inf:
            self._ends[vehicle] = step

    def comes_late(self, said: Latecomer) -> None:
        """Take that a vehicle comes late. Without a round it is not waited for."""
        if said.step is not UNSET:
            self._begins[said.vehicle] = said.step
        elif not self._begins[said.vehicle]:
            self._begins[said.vehicle] = math.inf


class Joining:
    """How a vehicle that comes late gets its part in a search.

    It asks for it. The others then keep clear of where it takes off. Once they are, it says so, and is told
    the round from which on they wait for it: then it takes off.
    """

    def __init__(self, number: int, berth: Berth) -> None:
        """Take its number, and its place among the others."""
        self.asks = Join(berth.start)
        self._number, self._separation_m = number, berth.separation_m

    def hear(self, belief: Belief) -> None:
        """Take where the others are, and whether they keep clear.

        Those that have left may hover where they read last, and stand where they read first.
        """
        here, apart_m = self.asks.place, self._separation_m
        away = {each.vehicle: each for each in belief.left_at or ()}
        keep_clear = away.pop(self._number, None) is not None
        flying = *(each.position for each in belief.readings or ()), *(each.last for each in away.values())
        clear = all(math.dist(place, here) >= apart_m + AT_START_M for place in flying)
        clear &= all(math.dist(each.first, here) >= apart_m for each in away.values())
        self.asks = Join(here, keep_clear and clear)
