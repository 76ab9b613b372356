"""Straight ways, polygons and the distances between them, in plain arithmetic.

A way is a straight line from a place to another, (..., 2, 2) m. A side of a polygon is one, too.
"""

import math
from collections.abc import Sequence
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

Place = tuple[float, float]

# Cosine of 22.5°, the most that a way turns at a corner, less some rounding.
LEAST = math.sqrt(2 + math.sqrt(2)) / 2 - 1e-9


def gaps(ways: Array, others: Array) -> Array:
    """Least distances between straight ways (..., 2, 2) m, each from a place to another: (...).

    It is 0 if they cross.
    """
    (a, b), (c, d) = ((way[..., 0, :], way[..., 1, :]) for way in (ways, others))
    ends = [_from_way(a, c, d), _from_way(b, c, d), _from_way(c, a, b), _from_way(d, a, b)]
    cross = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
    return np.where(cross, 0.0, np.minimum(np.minimum(*ends[:2]), np.minimum(*ends[2:])))


def _from_way(place: Array, start: Array, end: Array) -> Array:
    """Distance of a place from a way."""
    along, off = end - start, place - start
    square = along[..., 0] * along[..., 0] + along[..., 1] * along[..., 1]
    share = (off[..., 0] * along[..., 0] + off[..., 1] * along[..., 1]) / np.maximum(square, math.ulp(0.0))
    left = off - np.clip(share, 0.0, 1.0)[..., None] * along
    return np.asarray(np.sqrt(left[..., 0] * left[..., 0] + left[..., 1] * left[..., 1]))


def _side(start: Array, end: Array, place: Array) -> Array:
    """On which side of the line through a way a place lies: the sign."""
    along, off = end - start, place - start
    return np.asarray(along[..., 0] * off[..., 1] - along[..., 1] * off[..., 0])


def outline(polygon: Sequence[Place]) -> Array:
    """Return the corners (K, 2) of a polygon, without those that are where the next one is, around it."""
    corners = np.array(polygon, np.float64).reshape(-1, 2)
    return np.asarray(corners[(corners != np.roll(corners, -1, axis=0)).any(axis=1)])


def sides_of(polygon: Sequence[Place], clockwise: bool = False) -> Array:
    """Return the sides of a polygon, (K, 2, 2) m, counter-clockwise around it unless told otherwise."""
    corners = outline(polygon)
    x, y = (corners - corners[0]).T
    area = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
    if (area < 0) != clockwise:
        corners = corners[::-1]
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def enclosed(places: Array, sides: Array) -> Flags:
    """Whether places (..., 2) m are inside any of the polygons with these sides (S, 2, 2): (...).

    All polygons run the same way around, so that each adds one to the winding number or leaves it.
    """
    start, end, place = sides[:, 0], sides[:, 1], places[..., None, :]
    left = _side(start, end, place)
    up = (start[:, 1] <= place[..., 1]) & (place[..., 1] < end[:, 1]) & (left > 0)
    down = (end[:, 1] <= place[..., 1]) & (place[..., 1] < start[:, 1]) & (left < 0)
    return np.asarray(up.sum(axis=-1) != down.sum(axis=-1))


def grown_corners(sides: Array, margin_m: float) -> tuple[Array, Array]:
    """Return the convex corners (C, 2) m of one polygon, moved outwards: lines join them a margin away.

    Also returned are the normals (C, 2, 2) of the lines that meet there, outwards.

    sides: (K, 2, 2), counter-clockwise. A corner is cut into halves until none turns by more than
    22.5°, so that ways past it are hardly longer than along the arc, and are as free.
    """
    corners, faces = [], []
    for (before, corner), (_, after) in zip(np.roll(sides, 1, axis=0), sides, strict=True):
        there, on = _unit(corner - before), _unit(after - corner)
        if _cross(there, on) <= 0:
            continue
        normals = [np.array([along[1], -along[0]]) for along in (there, on)]
        if _dot(there, on) < 0:
            normals.insert(1, _unit(there - on))
        while any(_dot(*pair) < LEAST for pair in pairwise(normals)):
            halves = [(one, _unit(one + other)) for one, other in pairwise(normals)]
            normals = [*chain(*halves), normals[-1]]
        for one, other in pairwise(normals):
            corners.append(corner + margin_m * (one + other) / (1 + _dot(one, other)))
            faces.append((one, other))
    return np.array(corners).reshape(-1, 2), np.array(faces).reshape(-1, 2, 2)


def _dot(one: Array, other: Array) -> float:
    return float(one[0] * other[0] + one[1] * other[1])


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.sqrt(vector[0] * vector[0] + vector[1] * vector[1]))


def crosses_itself(corners: Array) -> tuple[int, int] | None:
    """Return the numbers of two sides that meet other than at the corner between them; None if none do.

    corners: (K, 2).  Side k goes from corner k to the next one.
    """
    count = len(corners)
    ends = np.roll(corners, -1, axis=0)
    if count < 3:
        return 0, count - 1
    for k in range(count):
        if (corners[k] == ends[k]).all():
            return k, (k + 1) % count
        for other in range(k + 1, count):
            if other in (k + 1, k + count - 1):  # neighbours: is one folded back over the other?
                first, second = (k, other) if other == k + 1 else (other, k)
                there, back = ends[first] - corners[first], ends[second] - corners[second]
                if _cross(there, back) == 0 and (there * back).sum() < 0:
                    return k, other
            elif _meet(corners[k], ends[k], corners[other], ends[other]):
                return k, other
    return None


def _cross(one: Array, other: Array) -> float:
    return float(one[0] * other[1] - one[1] * other[0])


def _meet(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Return whether the segments a–b and c–d share a point."""
    if (np.maximum(a, b) < np.minimum(c, d)).any() or (np.maximum(c, d) < np.minimum(a, b)).any():
        return False
    ab, cd = b - a, d - c
    return (
        _cross(ab, c - a) * _cross(ab, d - a) <= 0 and _cross(cd, a - c) * _cross(cd, b - c) <= 0
    )  # each segment's ends are not on one side of the other; in one line, the boxes have decided
