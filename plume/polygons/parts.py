"""Where a source is expected, part by part: polygons and places, each with a weight."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from plume.polygons.polygons import Array, Place, enclosed, outline, sides_of

_HALF = math.sqrt(0.5)
# Corners of an octagon around (0, 0), counter-clockwise, each 1 from there.
OCTAGON: tuple[Place, ...] = (
    *((1.0, 0.0), (_HALF, _HALF), (0.0, 1.0), (-_HALF, _HALF)),
    *((-1.0, 0.0), (-_HALF, -_HALF), (0.0, -1.0), (_HALF, -_HALF)),
)


def octagon(middle: Place, radius_m: float) -> tuple[Place, ...]:
    """Return the corners of the octagon whose corners are radius_m from its middle."""
    (x, y), r = middle, radius_m
    return tuple((x + r * east, y + r * north) for east, north in OCTAGON)


def area_of(corners: Sequence[Place]) -> float:
    """Return the area of a polygon, m²."""
    ends = sides_of(corners) - outline(corners)[0]
    (x_1, y_1), (x_2, y_2) = ends[:, 0].T, ends[:, 1].T
    return float((x_1 * y_2 - x_2 * y_1).sum() / 2)


def numbered_sides(polygons: Sequence[Sequence[Place]]) -> Array:
    """Return the sides of polygons, (S, 5): x and y of both ends, and the number of their polygon, from 1."""
    sides = [
        np.column_stack([sides.reshape(-1, 4), np.full(len(sides), number)])
        for number, sides in enumerate(map(sides_of, polygons), 1)
    ]
    return np.concatenate(sides)


def held(
    places: Array, polygons: Sequence[Sequence[Place]]
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Whether places (..., 2) m are in any of the polygons, which may overlap: (...)."""
    return np.asarray(np.any([enclosed(places, sides_of(polygon)) for polygon in polygons], axis=0))


def counts(shares: Sequence[float], total: int) -> list[int]:
    """Split a number by shares of a sum of 1, each to within one of its part."""
    ends: list[int] = np.rint(np.cumsum(shares) * total).astype(int).tolist()
    return [end - start for start, end in pairwise([0, *ends])]
