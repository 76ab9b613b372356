"""The moves that a planner may choose from, and the meaning of a learned policy's actions."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import ClassVar, Protocol, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from link.bus.messages import Belief
from plume.elementary import Array, direction
from plume.polygons.obstacles import HAIR_M
from plume.problem import AREA, Area
from plume.scenario import STEP_M

# A way that is not free is turned by these parts of a full turn, one after the other.
TURNS = tuple(sign * k / 16 for k in range(1, 8) for sign in (1, -1))
PARTS = (1.0, 0.5, 0.25, 0.125)  # of a way that meets an obstacle: the longest that is free is flown
FINEST = 1 / 300  # the shortest move, as a part of the area's side

T = TypeVar("T")


@dataclass(frozen=True)
class Reach:
    """The moves that a planner may choose from, and its number of hypothetical readings."""

    headings: int = 4  # number of headings, evenly spaced; the first is east
    step: float = STEP_M  # length of a move, m; `fitted` shortens it
    measurements: int = 25  # hypothetical readings for each move
    area: Area = AREA  # where it may fly
    # Whether moves may be shorter than a step, and a search that repeats itself turns away: `fitted`.
    fits: bool = False
    avoided: tuple[float, float] | None = None  # (x, y) m: no move goes there while there is another
    # Part of the area's side that a move is at most where the belief is narrow: half of Table 1's step.
    FINE: ClassVar[float] = 1 / 60

    def fitted(self, belief: Belief) -> "Reach":
        """Return it with moves of at most `longest_m`, and not back, if it `fits` its moves.

        A search that repeats itself (`Belief.back`) goes elsewhere.
        """
        if not self.fits:
            return self
        step = min(self.step, self.once("longest", lambda: self.longest_m(belief.spread)))
        avoided = None if isinstance(belief.back, msgspec.UnsetType) else belief.back
        return replace(self, step=step, avoided=avoided) if (step, avoided) != (self.step, None) else self

    def longest_m(self, spread_m: float) -> float:
        """Return how long a move may be at this spread: see `longest_m`."""
        return float(longest_m(spread_m, self.area.side_m, self.FINE))

    @cached_property
    def wire(self) -> Area:
        """The part of the area that waypoints may lie in: the wire carries float32."""
        return self.area.on_the_wire()

    def moves(self, position: tuple[float, float]) -> Array:
        """Return the waypoints (A, 2) m that one step reaches in the area; float32 values, as on the wire.

        Where an obstacle is in the way, a step is as short as of PARTS; without any free way, the waypoint is
        the place itself. Among obstacles, moves towards the corners in sight follow those of the headings:
        the shortest way to any place begins with one of them, or is straight.
        """
        if self.area.obstacles:
            places = self._moves_between(position)
        else:
            places = np.asarray(position) + self.step * self.directions
            places = places.astype(np.float32).astype(np.float64)
            places = places[self.area.held(places)]
        if self.avoided is None:
            return places
        near = np.square(places - np.array(self.avoided)).sum(axis=1)
        onwards = places[near > np.square(places - np.array(position)).sum(axis=1) / 4]
        return onwards if len(onwards) else places

    def _moves_between(self, position: tuple[float, float]) -> Array:
        steps = self.step * np.array(PARTS)[:, None, None] * self.directions  # (P, A, 2)
        places = (np.asarray(position) + steps).astype(np.float32).astype(np.float64)
        free = self.area.held(places) & self._are_clear(position, places)
        longest = free.argmax(axis=0), np.arange(self.headings)
        moves = np.concatenate([places[longest][free[longest]], self._towards_corners(position)])
        return moves if len(moves) else np.array([position], np.float64)

    def _towards_corners(self, position: tuple[float, float]) -> Array:
        """Moves (C, 2) m towards the corners in sight, of those at which a way around can turn."""
        assert self.area.obstacles
        corners = self.area.obstacles.past(np.array(position))
        corners = corners[lengths(corners - position) > HAIR_M]
        ways = corners - position
        shares = np.minimum(self.step / lengths(ways), 1.0)[:, None]
        places = (position + shares * ways).astype(np.float32).astype(np.float64)
        seen = self._are_clear(position, corners) & self.area.held(places)
        return np.asarray(places[seen & self._are_clear(position, places)])

    def _are_clear(self, position: tuple[float, float], places: Array) -> NDArray[np.bool_]:
        """Whether no obstacle is in the ways from a position to places (..., 2) m: (...)."""
        if not (obstacles := self.area.obstacles):
            return np.ones(places.shape[:-1], bool)
        return obstacles.are_free(ways_from(position, places))

    def are_free(self, position: tuple[float, float], places: Array) -> NDArray[np.bool_]:
        """Whether the ways from a position to places (A, 2) m may be flown: (A,)."""
        return self._are_clear(position, places)

    def freed(self, position: tuple[float, float], place: tuple[float, float]) -> tuple[float, float]:
        """Return the place if the way there is free, else one as far to the side, else the position.

        Between obstacles, ways of PARTS of the length are tried, too.
        """
        if self.are_free(position, np.array([place], np.float64)).all():
            return place
        east, north = place[0] - position[0], place[1] - position[1]
        cosines, sines = direction(np.array([0.0, *TURNS]))
        turned = np.stack([cosines * east - sines * north, sines * east + cosines * north], axis=1)
        ways = np.concatenate([part * turned for part in (PARTS if self.area.obstacles else PARTS[:1])])
        places = self.wire.clipped(position + ways).astype(np.float32).astype(np.float64)
        free = places[self.are_free(position, places)]
        x, y = free[0].tolist() if len(free) else position
        return x, y

    def ahead(self, position: tuple[float, float], moves: Array, steps: Array | float) -> Array:
        """Return the places that moves (A, 2) m would reach if they were so many times as long: (A, …, 2).

        They are in the area; where an obstacle is in the way, they are the moves' ends.
        """
        on = (moves - position).reshape(-1, *[1] * np.ndim(steps), 2)
        places = self.area.clipped(position + np.asarray(steps)[..., None] * on)
        if self.area.obstacles:
            ends = np.broadcast_to(np.asarray(position) + on, places.shape)
            places = np.where(self._are_clear(position, places)[..., None], places, ends)
        return places

    def fewer(self, number: int) -> int:
        """Return how many of a number of draws this vehicle has: alone all."""
        return number

    def once(self, _name: str, compute: Callable[[], T]) -> T:
        """Return what is computed from the belief alone: in a fleet, once for all vehicles of a round."""
        return compute()

    def foreseen(self, _steps: float = 1.0) -> Array:
        """Return where other vehicles take readings before this one, (F, 2) m: there are none."""
        return np.empty((0, 2))

    @property
    def directions(self) -> Array:
        """Unit vectors (A, 2) of the headings."""
        return _directions(self.headings)


def longest_m(spreads_m: ArrayLike, sides_m: ArrayLike, fine: float = Reach.FINE) -> Array:
    """Return how long moves (…) may be where they have to fit beliefs, in areas of these sides.

    A move is at most a quarter of the spread: a longer one passes readings that would tell it where to turn.
    Where the spread is small, it is at most a `fine` part of the area's side instead, and 4 spreads, or it
    hops to and fro across the source. It is never below the FINEST part, or it would stay where it is. If the
    place is known, moves may be of any length.
    """
    spreads, sides = np.asarray(spreads_m), np.asarray(sides_m)
    shorter = np.minimum(np.maximum(4 * spreads, FINEST * sides), fine * sides)
    longest = np.maximum(spreads / 4, shorter)
    return np.asarray(np.where(spreads > 0, longest, np.inf))


@lru_cache(8)
def _directions(headings: int) -> Array:
    """Return the unit vectors of so many headings; nobody may write to them."""
    found = np.stack(direction(np.arange(headings) / headings), axis=1)
    found.flags.writeable = False
    return found


def lengths(vectors: Array) -> Array:
    """Return the lengths (...) of vectors (..., 2)."""
    return np.asarray(np.sqrt(np.square(vectors).sum(axis=-1)))


def ways_from(position: tuple[float, float], places: Array) -> Array:
    """Return the straight ways from a position to places (..., 2) m: (..., 2, 2)."""
    return np.stack(np.broadcast_arrays(np.asarray(position, np.float64), places), axis=-2)


class Clips(Protocol):
    """An area, or the areas of places side by side."""

    def clipped(self, places: ArrayLike) -> Array:
        """Return the places inside that are nearest to these (..., 2) m: (..., 2)."""


class Headings(msgspec.Struct, frozen=True, tag_field="kind", tag="headings", forbid_unknown_fields=True):
    """Discrete actions: a step in one of `count` evenly spaced directions of the observation's frame.

    The first is along its x axis.
    """

    count: int
    step_m: float = STEP_M
    fits: bool = False  # whether moves are shorter where the belief is narrow, as a planner's (`Reach`)

    @property
    def outputs(self) -> int:
        """Number of network outputs: one score per heading."""
        return self.count

    def action(self, said: Array) -> Array:
        """Return the action with the highest score (B,), given the network's output `said` (B, count)."""
        return np.asarray(said.argmax(axis=1))

    def waypoints(
        self, positions: Array, frames: Array, actions: Array, area: Clips, longest: ArrayLike = math.inf
    ) -> Array:
        """Return the waypoints (B, 2) m of actions (B,) from positions (B, 2) m.

        frames: (B, 3).  longest: how long a move that fits may be, m, of each: `longest_m`.
        """
        return _moved(positions, frames, actions / self.count, steps_of(self, frames, longest), area)


class HeadingAndStep(
    msgspec.Struct, frozen=True, tag_field="kind", tag="heading and step", forbid_unknown_fields=True
):
    """Continuous actions in [−1, 1]²: heading and step.

    Heading 0 is along the frame's x axis, ±1 opposite to it. Step −1 is no move, 1 a move of `step_m`.
    """

    step_m: float = STEP_M
    fits: bool = False  # as of `Headings`

    @property
    def outputs(self) -> int:
        """Number of network outputs: the two numbers of the action."""
        return 2

    def action(self, said: Array) -> Array:
        """Return the network's output `said` (B, 2): it is the action."""
        return said

    def waypoints(
        self, positions: Array, frames: Array, actions: Array, area: Clips, longest: ArrayLike = math.inf
    ) -> Array:
        """Return the waypoints (B, 2) m of actions (B, 2), clipped to [−1, 1], from positions (B, 2) m.

        frames: (B, 3).  longest: as of `Headings`.
        """
        heading, share = np.clip(np.asarray(actions, np.float64).T, -1.0, 1.0)
        steps = steps_of(self, frames, longest) * (share + 1) / 2
        return _moved(positions, frames, heading / 2, steps, area)


Move = Headings | HeadingAndStep


def steps_of(move: Move, frames: Array, longest: ArrayLike) -> Array:
    """Return the lengths (B,) of whole steps in the units of frames (B, 3).  longest: m, as of `Headings`."""
    steps = np.full(len(frames), move.step_m)
    return np.minimum(steps, np.divide(longest, units_m(frames))) if move.fits else steps


def units_m(frames: Array) -> Array:
    """Return how long the units of frames (B, 3) are, m: (B,)."""
    return np.asarray(np.sqrt(np.square(frames[:, :2]).sum(axis=1)))


def _moved(positions: Array, frames: Array, turns: Array, lengths: Array, area: Clips) -> Array:
    """Return the waypoints (B, 2) of moves at angles in turns, clipped to the area; float32 values."""
    from agent.planning.kernels import displacements  # compiled: naming a policy does not need it

    return (
        area.clipped(positions + displacements(frames, turns, lengths)).astype(np.float32).astype(np.float64)
    )
