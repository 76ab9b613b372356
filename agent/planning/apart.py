"""Vehicles that keep apart: the moves that are free for one of a fleet, and where the others go."""

import math
from dataclasses import dataclass, field, fields

import numpy as np

from agent.planning.moves import Reach
from plume.elementary import Array, direction

SEPARATION_M = 3.0  # least distance between the ways of two vehicles, m
# A policy's way that is not free is turned by these parts of a full turn, one after the other.
TURNS = tuple(sign * k / 16 for k in range(1, 8) for sign in (1, -1))


@dataclass(frozen=True)
class Shared(Reach):
    """The moves of one vehicle of a fleet.

    A way is the straight line from a place to the next one. Ways keep their distance as lines, whenever each
    vehicle flies its own: a late vehicle is as safe as one on time. The ways of vehicles that have not chosen
    yet end where they begin, so everyone can always stay where it is.
    """

    chosen: Array = field(
        default_factory=lambda: np.empty((0, 2, 2)), compare=False
    )  # (F, 2, 2): from, to, m
    waiting: Array = field(default_factory=lambda: np.empty((0, 2)), compare=False)  # (W, 2) m, yet to choose
    separation_m: float = SEPARATION_M

    @classmethod
    def of(cls, reach: Reach, chosen: Array, waiting: Array, separation_m: float) -> "Shared":
        """Return `reach` for a vehicle whose turn it is."""
        given = {each.name: getattr(reach, each.name) for each in fields(Reach)}
        return cls(**given, chosen=chosen, waiting=waiting, separation_m=separation_m)

    def moves(self, position: tuple[float, float]) -> Array:
        """Return the waypoints (A, 2) m that one step reaches by free ways; if none, the place itself."""
        places = super().moves(position)
        free = places[self.are_free(position, places)]
        return free if len(free) else np.array([position], np.float64)

    def are_free(
        self, position: tuple[float, float], places: Array
    ) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Whether the ways from a position to places (A, 2) m keep the separation: (A,)."""
        ways = np.stack(np.broadcast_arrays(np.asarray(position, np.float64), places), axis=-2)
        others = np.concatenate([self.chosen, np.repeat(self.waiting[:, None], 2, axis=1)])
        return np.asarray((gaps(ways[:, None], others) >= self.separation_m).all(axis=1))

    def freed(self, position: tuple[float, float], place: tuple[float, float]) -> tuple[float, float]:
        """Return the place if the way there is free, else one as far to the side, else the position."""
        east, north = place[0] - position[0], place[1] - position[1]
        cosines, sines = direction(np.array([0.0, *TURNS]))
        turned = np.stack([cosines * east - sines * north, sines * east + cosines * north], axis=1)
        places = self.wire.clipped(position + turned).astype(np.float32).astype(np.float64)
        places[0] = place
        free = places[self.are_free(position, places)]
        x, y = free[0].tolist() if len(free) else position
        return x, y

    def foreseen(self, steps: float = 1.0) -> Array:
        """Return where those who have chosen will be so many steps on, if they go straight on: (F, 2) m."""
        start, end = self.chosen[:, 0], self.chosen[:, 1]
        return self.area.clipped(start + steps * (end - start))

    @property
    def others(self) -> Array:
        """The other vehicles' places, next ones where they are chosen: (F + W, 2) m."""
        return np.concatenate([self.chosen[:, 1], self.waiting])


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
