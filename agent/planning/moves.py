"""The moves that a planner may choose from, and the meaning of a learned policy's actions."""

from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np

from link.bus.messages import Belief
from plume.elementary import Array, direction
from plume.problem import AREA, Area
from plume.scenario import STEP_M

# The step of Table 1 as a part of its area's side, short enough for any search, and the shortest move.
FINE, FINEST = 1 / 30, 1 / 300


@dataclass(frozen=True)
class Reach:
    """The moves that a planner may choose from, and its number of hypothetical readings."""

    headings: int = 4  # number of headings, evenly spaced; the first is east
    step: float = STEP_M  # length of a move, m; `fitted` shortens it
    measurements: int = 25  # hypothetical readings for each move
    area: Area = AREA  # where it may fly
    fits: bool = False  # whether moves may be shorter than a step: `fitted`

    def fitted(self, belief: Belief) -> "Reach":
        """Return it with moves that are not long against the belief, if it `fits` its moves.

        A move is at most a quarter of the spread: a longer one passes readings that would tell it where to
        turn. Where the spread is small, it is at most a FINE part of the area's side instead, and 4 spreads,
        or it hops to and fro across the source. It is never below the FINEST part, or it would stay where it
        is. If the place is known, moves are as long as they were.
        """
        shortest, fine = self.area.side_m * FINEST, self.area.side_m * FINE
        longest = max(belief.spread / 4, min(max(4 * belief.spread, shortest), fine))
        is_long = self.fits and belief.spread > 0 and longest < self.step
        return replace(self, step=longest) if is_long else self

    @cached_property
    def wire(self) -> Area:
        """The part of the area that waypoints may lie in: the wire carries float32."""
        return self.area.on_the_wire()

    def moves(self, position: tuple[float, float]) -> Array:
        """Return the waypoints (A, 2) m that one step reaches in the area; float32 values, as on the wire."""
        places = (np.asarray(position) + self.step * self.directions).astype(np.float32).astype(np.float64)
        return np.asarray(places[self.area.held(places)])

    def foreseen(self, _steps: float = 1.0) -> Array:
        """Return where other vehicles take readings before this one, (F, 2) m: there are none."""
        return np.empty((0, 2))

    @cached_property
    def directions(self) -> Array:
        """Unit vectors (A, 2) of the headings."""
        return np.stack(direction(np.arange(self.headings) / self.headings), axis=1)


class Headings(msgspec.Struct, frozen=True, tag_field="kind", tag="headings", forbid_unknown_fields=True):
    """Discrete actions: a step in one of `count` evenly spaced directions of the observation's frame.

    The first is along its x axis.
    """

    count: int
    step_m: float = STEP_M

    @property
    def outputs(self) -> int:
        """Number of network outputs: one score per heading."""
        return self.count

    def action(self, said: Array) -> Array:
        """Return the action with the highest score (B,), given the network's output `said` (B, count)."""
        return np.asarray(said.argmax(axis=1))

    def waypoints(self, positions: Array, frames: Array, actions: Array, area: Area) -> Array:
        """Return the waypoints (B, 2) m of actions (B,) from positions (B, 2) m. frames: (B, 3)."""
        return _moved(positions, frames, actions / self.count, np.full(len(actions), self.step_m), area)


class HeadingAndStep(
    msgspec.Struct, frozen=True, tag_field="kind", tag="heading and step", forbid_unknown_fields=True
):
    """Continuous actions in [−1, 1]²: heading and step.

    Heading 0 is along the frame's x axis, ±1 opposite to it. Step −1 is no move, 1 a move of `step_m`.
    """

    step_m: float = STEP_M

    @property
    def outputs(self) -> int:
        """Number of network outputs: the two numbers of the action."""
        return 2

    def action(self, said: Array) -> Array:
        """Return the network's output `said` (B, 2): it is the action."""
        return said

    def waypoints(self, positions: Array, frames: Array, actions: Array, area: Area) -> Array:
        """Return the waypoints (B, 2) m of actions (B, 2), clipped to [−1, 1], from positions (B, 2) m.

        frames: (B, 3).
        """
        heading, share = np.clip(np.asarray(actions, np.float64).T, -1.0, 1.0)
        return _moved(positions, frames, heading / 2, self.step_m * (share + 1) / 2, area)


Move = Headings | HeadingAndStep


def _moved(positions: Array, frames: Array, turns: Array, lengths: Array, area: Area) -> Array:
    """Return the waypoints (B, 2) of moves at angles in turns, clipped to the area; float32 values."""
    from agent.planning.kernels import displacements  # compiled: naming a policy does not need it

    return (
        area.clipped(positions + displacements(frames, turns, lengths)).astype(np.float32).astype(np.float64)
    )
