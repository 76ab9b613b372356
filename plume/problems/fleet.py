"""A fleet that searches together: how many vehicles, where they start, how far apart."""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from plume.elementary import Array
from plume.polygons.obstacles import Obstacles
from plume.problem import AREA, Area, Problem
from plume.problems.values import number, whole
from plume.randomness import keyed, seed_of, uniform
from plume.scenario import SEPARATION_M

Place = tuple[float, float]  # (x, y) m

MOST_VEHICLES = 8
FARTHEST_APART_M = 100.0  # greatest separation, m
FORMATIONS = {
    "point": "beside each other where one vehicle starts",
    "edge": "spread evenly along the southern edge",
    "corners": "in different corners, then at the middles of the edges",
}
START_SIDE = 1 / 6  # of the rectangle in which a start is drawn, as a part of the area's sides: Table 1
# Distance of pads beside each other, in separations: one can pass between two of them as far from both.
PADS = 2.2
MOST_PADS = 20  # a start that is not free is moved by so many of them at most, along x and y
# Where vehicles start from different corners, as shares of the way across; the first is Table 1's.
CORNERS = ((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5))


@dataclass(frozen=True)
class Fleet:
    """Vehicles that search together. Raises ValueError, which begins with the field."""

    vehicles: int = 1
    formation: str = "point"  # of FORMATIONS
    separation_m: float = SEPARATION_M  # least distance between the ways of two vehicles, m

    def __post_init__(self) -> None:
        whole("vehicles", self.vehicles, 1, MOST_VEHICLES)
        if not isinstance(self.formation, str) or self.formation not in FORMATIONS:
            raise ValueError(f"formation {self.formation!r} is not allowed; wanted {', '.join(FORMATIONS)}")
        number("separation_m", self.separation_m, 0, FARTHEST_APART_M)

    def within(self, problem: Problem) -> "Fleet":
        """Return it. Raises ValueError if a problem does not let it start so."""
        if problem.start is not None and self.formation != "point":
            raise ValueError(
                f"formation {self.formation!r} is not allowed; the problem has a start: wanted point"
            )
        room_m = self._room_m(problem)
        if self.separation_m > room_m:
            raise ValueError(
                f"separation_m {self.separation_m:g} is not allowed; {self.vehicles} vehicles from "
                f"{self.formation} have room for 0 to {math.floor(100 * room_m) / 100:g} m"
            )
        return self

    def _room_m(self, problem: Problem) -> float:
        """Return the greatest separation for which there always is a place for each vehicle to start, m."""
        width_m, shorter_m = problem.area.size_m[0], min(problem.area.size_m)
        side_m = START_SIDE * shorter_m
        if self.vehicles == 1:
            return math.inf
        if self.formation == "edge":
            return width_m / self.vehicles
        if self.formation == "corners":
            return shorter_m - 2 * side_m if self.vehicles <= 4 else (shorter_m - side_m) / 2 - side_m
        beside = math.ceil(math.sqrt(self.vehicles))  # of a square grid, on each side
        if problem.start is not None:
            return shorter_m / (PADS * beside)
        return (shorter_m - side_m) / (PADS * (beside - 1))  # they start near a corner

    def starts(self, start: Place, seed: int, area: Area = AREA) -> list[Place]:
        """Return where each vehicle starts, float32 pairs.

        start: where a vehicle alone would. One alone starts there from a point and from corners.
        """
        places = np.array(_drawn(self, start, seed, area), np.float32).astype(np.float64)
        if self.vehicles > 1 and area.obstacles:
            places = _moved_off(places, self.separation_m, area, area.obstacles)
        return [(x, y) for x, y in places.tolist()]


ALONE = Fleet()


def _drawn(fleet: Fleet, start: Place, seed: int, area: Area) -> list[Place]:
    if fleet.formation == "point":
        return _beside(start, PADS * fleet.separation_m, fleet.vehicles, area)
    low, size_m = np.array(area.low), np.array(area.size_m)
    drawn = [(np.array(start) - low) / size_m]  # shares of the way across
    for vehicle in range(2, fleet.vehicles + 1):
        drawn.append(uniform(keyed(seed_of(seed, vehicle), "start"), np.zeros(2), START_SIDE))
    if fleet.formation == "edge":
        shares = [np.array([(k + 0.5) / fleet.vehicles, share[1]]) for k, share in enumerate(drawn)]
    else:
        shares = [_in_corner(share, np.array(corner)) for share, corner in zip(drawn, CORNERS, strict=False)]
    return [(x, y) for x, y in (low + np.array(shares) * size_m).tolist()]


def _beside(start: Place, pad_m: float, count: int, area: Area) -> list[Place]:
    """Return `count` places of the square grid through a start that are nearest to it, inside the area."""
    reach = range(-count, count + 1)
    nearest = sorted(product(reach, reach), key=lambda pads: pads[0] * pads[0] + pads[1] * pads[1])
    grid = [(start[0] + pad_m * i, start[1] + pad_m * j) for i, j in nearest]
    return [place for place in grid if area.holds(place)][:count]


def _moved_off(places: Array, separation_m: float, area: Area, obstacles: Obstacles) -> Array:
    """Return starts (V, 2) m, those in the way of obstacles or of one before moved to the nearest place that
    is free.

    Raises ValueError if there is none within MOST_PADS separations.
    """
    pads = np.arange(-MOST_PADS, MOST_PADS + 1) * max(PADS * separation_m, 1.0)
    grid = np.stack(np.meshgrid(pads, pads, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[np.argsort(np.square(grid).sum(axis=1), kind="stable")]
    moved: list[Array] = []
    for place in places:
        near = (place + grid).astype(np.float32).astype(np.float64)
        free = area.held(near) & obstacles.are_clear(near)
        for other in moved:
            free &= np.square(near - other).sum(axis=1) >= separation_m * separation_m
        if not free.any():
            raise ValueError(f"keep_out: it leaves no room for {len(places)} vehicles to start")
        moved.append(near[free.argmax()])
    return np.array(moved)


def _in_corner(share: Array, corner: Array) -> Array:
    """Move a place of the south-western corner into another; on the far side it is mirrored."""
    return np.where(corner == 1.0, 1.0 - share, corner * (1.0 - START_SIDE) + share)
