"""The geofence: polygons and circles seen from above, and the exact time at which a path leaves them."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from aircraft.state import Ned
from sitl.autopilot.motion import Phase, Trajectory, first_exit_s, real_roots, stretches

NorthEast = tuple[float, float]  # (north, east) in m from home

EDGE_M = 1e-9  # a place this close to the edge of a shape lies on it, and the edge is always allowed
SHORTEST_S = 1e-6  # a stay inside or outside that is shorter than this comes from rounding at an edge


class Circle(NamedTuple):
    """A circle that the vehicle has to stay in, or out of."""

    inclusion: bool
    centre: NorthEast
    radius_m: float

    def allows(self, place: NorthEast) -> bool:
        """True on the edge and on its allowed side."""
        away = math.dist(place, self.centre) - self.radius_m
        return away <= EDGE_M if self.inclusion else away >= -EDGE_M

    def crossings(self, phase: Phase) -> Iterator[float]:
        """Yield the times, of a phase or beyond it, at which the edge may be crossed."""
        (north, east, _), (v_north, v_east, _), (a_north, a_east, _) = phase.known
        curves = [
            np.array([a / 2.0, v, at - c])
            for at, v, a, c in (
                (north, v_north, a_north, self.centre[0]),
                (east, v_east, a_east, self.centre[1]),
            )
        ]
        distance = sum(np.convolve(curve, curve) for curve in curves) - np.array(
            [0.0, 0.0, 0.0, 0.0, self.radius_m**2]
        )
        yield from (phase.known_s + root for root in real_roots(distance))


class Polygon(NamedTuple):
    """A polygon that the vehicle has to stay in, or out of. Its last vertex is joined to the first."""

    inclusion: bool
    vertices: tuple[NorthEast, ...]

    def allows(self, place: NorthEast) -> bool:
        """True on the edge and on its allowed side.

        A ray from a place inside crosses an odd number of edges.
        """
        north, east = place
        inside = False
        for a, b in self._edges():
            if _off(place, a, b) <= EDGE_M:
                return True
            if (a[1] > east) != (b[1] > east) and north < a[0] + (b[0] - a[0]) * (east - a[1]) / (
                b[1] - a[1]
            ):
                inside = not inside
        return inside == self.inclusion

    def crossings(self, phase: Phase) -> Iterator[float]:
        """Yield the times, of a phase or beyond it, at which the line through an edge is crossed."""
        (north, east, _), (v_north, v_east, _), (a_north, a_east, _) = phase.known
        for a, b in self._edges():
            across = (a[1] - b[1], b[0] - a[0])  # a vector at a right angle to the edge
            away = (
                (a_north * across[0] + a_east * across[1]) / 2.0,
                v_north * across[0] + v_east * across[1],
                (north - a[0]) * across[0] + (east - a[1]) * across[1],
            )
            yield from (phase.known_s + root for root in real_roots(away))

    def _edges(self) -> Iterator[tuple[NorthEast, NorthEast]]:
        return zip(self.vertices, (*self.vertices[1:], self.vertices[0]), strict=True)


class Fence(NamedTuple):
    """Shapes to keep to: inside all inclusions and outside all exclusions, as in PX4."""

    shapes: tuple[Circle | Polygon, ...] = ()
    number: int = 0  # the checksum of the items that it was made of; 0 without a fence

    def allows(self, position: Ned) -> bool:
        """True if a position is inside the fence or on its edge."""
        return all(shape.allows(position[:2]) for shape in self.shapes)

    def left_s(self, path: Trajectory, since_s: float, outside: bool) -> float:
        """Return when a path leaves the fence after a time; infinity if it does not.

        A path that begins outside has to come in first. The path crosses an edge at roots of polynomials;
        the time returned is the last float at which the fence allows the place.
        """
        return first_exit_s(
            lambda t_s: self.allows(path.at(t_s).position), self._stretches(path, since_s), since_s, outside
        )

    def _stretches(self, path: Trajectory, since_s: float) -> Iterator[tuple[float, float]]:
        """Yield the stretches of a path, beginning and end, between which it may cross an edge."""
        for phase in path.phases if self.shapes else ():
            start_s = max(phase.start_s, since_s)
            if phase.end_s <= start_s:
                continue
            crossings = (at for shape in self.shapes for at in shape.crossings(phase))
            for begin_s, end_s in stretches(start_s, phase.end_s, crossings):
                if end_s - begin_s >= SHORTEST_S:
                    yield begin_s, end_s


class Rally(NamedTuple):
    """Places other than home where a return may end."""

    places: tuple[NorthEast, ...] = ()
    number: int = 0  # the checksum of the items that they were made of; 0 without rally points

    def nearest(self, position: Ned, home: NorthEast) -> NorthEast:
        """Return the nearest of home and the rally points, as PX4's RTL_TYPE 0 does; home if equally near."""
        return min((home, *self.places), key=lambda place: math.dist(place, position[:2]))


NO_FENCE, NO_RALLY = Fence(), Rally()


def _off(place: NorthEast, a: NorthEast, b: NorthEast) -> float:
    """The distance of a place from the edge between a and b, m."""
    along = (b[0] - a[0], b[1] - a[1])
    length2 = along[0] ** 2 + along[1] ** 2
    share = ((place[0] - a[0]) * along[0] + (place[1] - a[1]) * along[1]) / length2 if length2 else 0.0
    share = min(max(share, 0.0), 1.0)
    return math.dist(place, (a[0] + share * along[0], a[1] + share * along[1]))
