"""A fleet that searches together, as trials fly it: how many vehicles, where they start, how far apart."""

import argparse
import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from agent.planning.apart import SEPARATION_M
from agent.together import Place, seed_of
from link import cli
from plume.randomness import keyed, uniform
from plume.scenario import AREA_M

MOST_VEHICLES = 8
FORMATIONS = {
    "point": "beside each other where one vehicle starts",
    "edge": "spread evenly along the southern edge",
    "corners": "in different corners, then at the middles of the edges",
}
START_SIDE = 1 / 6  # of the square in which a start is drawn, as a part of the area's side: Table 1
PADS = 1.1  # distance of pads beside each other, in separations
# Squares in which vehicles start from different corners, as shares of the way across; the first is Table 1's.
SQUARES = ((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5))


@dataclass(frozen=True)
class Fleet:
    """Vehicles that search together. Raises ValueError on what is not allowed."""

    vehicles: int = 1
    formation: str = "point"  # of FORMATIONS
    separation_m: float = SEPARATION_M  # least distance between the ways of two vehicles, m

    def __post_init__(self) -> None:
        if not 1 <= self.vehicles <= MOST_VEHICLES:
            raise ValueError(f"--vehicles: {self.vehicles} is not allowed; wanted 1 to {MOST_VEHICLES}")
        if self.formation not in FORMATIONS:
            raise ValueError(f"--from: {self.formation!r} is not allowed; wanted {', '.join(FORMATIONS)}")
        if not 0 <= self.separation_m <= self.room_m(AREA_M):
            raise ValueError(
                f"--separation: {self.separation_m:g} is not allowed; {self.vehicles} vehicles from "
                f"{self.formation} have room for 0 to {math.floor(100 * self.room_m(AREA_M)) / 100:g} m"
            )

    def room_m(self, area_m: float) -> float:
        """Return the greatest separation for which there always is a place for each vehicle to start, m."""
        side = START_SIDE * area_m
        if self.vehicles == 1:
            return area_m
        if self.formation == "edge":
            return area_m / self.vehicles
        if self.formation == "corners":
            return area_m - 2 * side if self.vehicles <= 4 else (area_m - side) / 2 - side
        beside = math.ceil(math.sqrt(self.vehicles)) - 1  # of a square grid, on each side of the start
        return (area_m - side) / (PADS * beside)

    def starts(self, start: Place, seed: int, area_m: float = AREA_M) -> list[Place]:
        """Return where each vehicle starts, float32 pairs.

        start: where a vehicle alone would. One alone starts there from a point and from corners.
        """
        places = np.array(_drawn(self, start, seed, area_m), np.float32).astype(np.float64)
        return [(x, y) for x, y in places.tolist()]


ALONE = Fleet()


def add_fleet_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of vehicles that search together."""
    parser.add_argument(
        "--vehicles",
        type=cli.whole(1, MOST_VEHICLES),
        default=ALONE.vehicles,
        metavar="N",
        help=f"vehicles that search together with one belief, 1 to {MOST_VEHICLES} (default: %(default)s)",
    )
    starts = "; ".join(f"{name}: {text}" for name, text in FORMATIONS.items())
    parser.add_argument(
        "--from",
        dest="formation",
        choices=tuple(FORMATIONS),
        default=ALONE.formation,
        help=f"where they start ({starts}; default: %(default)s)",
    )
    parser.add_argument(
        "--separation",
        type=cli.number(0, 100),
        default=ALONE.separation_m,
        metavar="M",
        help="least distance between the ways of two vehicles, m (default: %(default)g)",
    )


def fleet_given(args: argparse.Namespace) -> Fleet:
    """Return what the flags of `add_fleet_arguments` say. Raises ValueError."""
    return Fleet(args.vehicles, args.formation, args.separation)


def _drawn(fleet: Fleet, start: Place, seed: int, area_m: float) -> list[Place]:
    if fleet.formation == "point":
        return _beside(start, PADS * fleet.separation_m, fleet.vehicles, area_m)
    side, drawn = area_m * START_SIDE, [start]
    for vehicle in range(2, fleet.vehicles + 1):
        x, y = uniform(keyed(seed_of(seed, vehicle), "start"), np.zeros(2), side).tolist()
        drawn.append((x, y))
    if fleet.formation == "edge":
        return [((k + 0.5) / fleet.vehicles * area_m, y) for k, (_, y) in enumerate(drawn)]
    return [_in_square(place, *square, side, area_m) for place, square in zip(drawn, SQUARES, strict=False)]


def _beside(start: Place, pad_m: float, count: int, area_m: float) -> list[Place]:
    """Return `count` places of the square grid through a start that are nearest to it, inside the area."""
    reach = range(-count, count + 1)
    nearest = sorted(product(reach, reach), key=lambda pads: pads[0] * pads[0] + pads[1] * pads[1])
    grid = [(start[0] + pad_m * i, start[1] + pad_m * j) for i, j in nearest]
    return [place for place in grid if all(0.0 <= value <= area_m for value in place)][:count]


def _in_square(place: Place, east: float, north: float, side: float, area_m: float) -> Place:
    """Move a place in the south-western square into another; on the far side it is mirrored."""
    x, y = (
        value if across == 0 else area_m - value if across == 1 else across * (area_m - side) + value
        for value, across in zip(place, (east, north), strict=True)
    )
    return x, y
