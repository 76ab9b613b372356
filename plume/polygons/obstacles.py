"""What is in the way of straight flight: polygons to keep out of and one to keep in, and ways around them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from plume.polygons.polygons import Array, Flags, Place, enclosed, gaps, grown_corners, sides_of

# Corners of ways around stand off by so much more than the clearance, m: ways along them are free.
HAIR_M = 0.01
AT_ONCE = 200_000  # pairs of a way and a side that are compared in one go


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Polygons that ways keep away from, and the rectangle around all."""

    keep_out: Sequence[Sequence[Place]]  # polygons to keep out of
    keep_in: Sequence[Place]  # the polygon to keep in; empty: there is none
    clearance_m: float  # ways stay further than this from all sides
    low: Place  # corners of the rectangle
    high: Place

    @cached_property
    def _polygons(self) -> list[Array]:
        """The sides of each polygon, (K, 2, 2) m: free places are on their right."""
        within = [sides_of(self.keep_in, clockwise=True)] if self.keep_in else []
        return [*map(sides_of, self.keep_out), *within]

    @cached_property
    def sides(self) -> Array:
        """All sides, (S, 2, 2) m; those to keep out of come first."""
        return np.ascontiguousarray(np.concatenate(self._polygons))

    @cached_property
    def _outs(self) -> int:
        return sum(map(len, self._polygons[: len(self.keep_out)]))

    @property
    def walls(self) -> Array:
        """The sides of the polygons to keep out of, (W, 2, 2) m, counter-clockwise around each."""
        return self.sides[: self._outs]

    def enclose(self, places: Array) -> Flags:
        """Whether places (..., 2) m are inside a polygon to keep out of: (...)."""
        return enclosed(places, self.walls)

    def cross(self, ways: Array) -> Flags:
        """Whether straight ways (..., 2, 2) m touch a polygon to keep out of, the clearance aside: (...)."""
        touch = (gaps(ways[..., None, :, :], self.walls) == 0).any(axis=-1)
        return np.asarray(touch | self.enclose(ways[..., 0, :]))

    def may_begin(self, places: Array) -> Flags:
        """Whether searches may begin at places (..., 2) m: they are clear, and so is the line from home."""
        return self.are_clear(places) & ~self.cross(np.stack([np.zeros_like(places), places], axis=-2))

    def are_free(self, ways: Array) -> Flags:
        """Whether straight ways (..., 2, 2) m keep clear of all: (...). A way from a place to itself may."""
        flat = ways.reshape(-1, 2, 2)
        portion = max(AT_ONCE // len(self.sides), 1)
        free = [self._free(flat[first : first + portion]) for first in range(0, len(flat), portion)]
        return np.concatenate([*free, np.empty(0, np.bool_)]).reshape(ways.shape[:-2])

    def _free(self, ways: Array) -> Flags:
        same = (ways[:, 0] == ways[0, 0]).all()  # as a planner's are
        starts = ways[:1, 0] if same else ways[:, 0]
        low, high = ways.min(axis=(0, 1)) - self.clearance_m, ways.max(axis=(0, 1)) + self.clearance_m
        near = ((self.sides.max(axis=1) >= low) & (self.sides.min(axis=1) <= high)).all(axis=1)
        free = (gaps(ways[:, None], self.sides[near]) > self.clearance_m).all(axis=1) & ~self.enclose(starts)
        return np.asarray(free & enclosed(starts, self.sides[self._outs :]) if self.keep_in else free)

    def are_clear(self, places: Array) -> Flags:
        """Whether places (..., 2) m are ones that a vehicle may be at: (...)."""
        return self.are_free(np.stack([places, places], axis=-2))

    @cached_property
    def corners(self) -> Array:
        """Places (C, 2) m at which ways around turn."""
        return self._turns[0]

    @property
    def margin_m(self) -> float:
        """How far ways by corners stand off."""
        return self.clearance_m + HAIR_M

    @cached_property
    def _turns(self) -> tuple[Array, Array]:
        grown = [grown_corners(sides, self.margin_m) for sides in self._polygons]
        corners, faces = (np.concatenate(each) for each in zip(*grown, strict=True))
        there = ((corners >= self.low) & (corners <= self.high)).all(axis=1) & self.are_clear(corners)
        return np.ascontiguousarray(corners[there]), faces[there]

    def past(self, place: Array) -> Array:
        """Return the corners (T, 2) m at which a way from a place (2,) can turn: it grazes what is there.

        At the others the way would meet both of a corner's faces, and a shorter one passes by.
        """
        corners, faces = self._turns
        off = place - corners
        behind = off[:, None, 0] * faces[:, :, 0] + off[:, None, 1] * faces[:, :, 1]
        return np.asarray(corners[behind.min(axis=1) <= 0])

    @cached_property
    def between(self) -> Array:
        """Lengths (C, C) m of the shortest free ways between corners; infinite if there is none."""
        lengths = straight(self.corners, self.corners)
        lengths[~self.are_free(ways_between(self.corners, self.corners))] = np.inf
        for by in range(len(lengths)):  # Floyd and Warshall
            np.minimum(lengths, lengths[:, by, None] + lengths[by], out=lengths)
        return lengths

    def join(self, places: Array, goals: Array) -> Flags:
        """Whether from each of these places (M, 2) m there is a way to any of the goals (N, 2) m: (M,)."""
        seen, ending = (self.are_free(ways_between(each, self.corners)) for each in (places, goals))
        ends = np.isfinite(self.between)[:, ending.any(axis=0)].any(axis=1)
        return np.asarray(self.are_free(ways_between(places, goals)).any(axis=1) | (seen & ends).any(axis=1))


def ways_between(places: Array, others: Array) -> Array:
    """Return the straight ways from places (M, 2) m to others (N, 2) m: (M, N, 2, 2)."""
    return np.stack(np.broadcast_arrays(places[:, None], others), axis=-2)


def straight(places: Array, others: Array) -> Array:
    """Return the distances of places (M, 2) m from others (N, 2) m: (M, N) m."""
    east, north = (places[:, None, axis] - others[:, axis] for axis in (0, 1))
    return np.asarray(np.sqrt(east * east + north * north))
