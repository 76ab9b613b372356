"""How a planner may move, and how much it may imagine before it does; and what the actions of a learned policy mean."""

from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np
from numpy.typing import NDArray

from plume.scenario import AREA_M, STEP_M

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reach:
    """What a planner may choose from."""

    headings: int = 4
    """Evenly spaced, the first one east."""
    step: float = STEP_M
    """Length of a move, m."""
    measurements: int = 25
    """Hypothetical readings for each move."""
    area_m: float = AREA_M
    """Side of the search area."""

    @cached_property
    def edge(self) -> float:
        """The greatest coordinate in the area that the wire can carry, a float32 value, m."""
        edge = np.float32(self.area_m)
        return float(edge if float(edge) <= self.area_m else np.nextafter(edge, np.float32(0)))

    def moves(self, position: tuple[float, float]) -> Array:
        """Return the waypoints (A, 2) m that one step reaches without leaving the area; float32 values, as the wire carries them."""
        places = (np.asarray(position) + self.step * self.directions).astype(np.float32).astype(np.float64)
        return places[((places >= 0) & (places <= self.area_m)).all(axis=1)]

    @cached_property
    def directions(self) -> Array:
        """Unit vectors (A, 2) of the headings."""
        angles = 2 * np.pi * np.arange(self.headings) / self.headings
        return np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 15)  # east is east, not east and 6e-17 north


class Headings(msgspec.Struct, frozen=True, tag_field="kind", tag="headings", forbid_unknown_fields=True):
    """Discrete actions: a step in one of evenly spaced directions of the observation's frame, the first one along its x axis."""

    count: int
    step_m: float = STEP_M

    @property
    def outputs(self) -> int:
        """A network says so many numbers: how good each heading is."""
        return self.count

    def action(self, said: Array) -> Array:
        """Return the best action (B,) by what a network says (B, count)."""
        return np.asarray(said.argmax(axis=1))

    def waypoints(self, positions: Array, frames: Array, actions: Array, area_m: float) -> Array:
        """Return where actions (B,) lead from positions (B, 2): (B, 2) m."""
        return _moved(positions, frames, 2 * np.pi * actions / self.count, np.full(len(actions), self.step_m), area_m)


class HeadingAndStep(msgspec.Struct, frozen=True, tag_field="kind", tag="heading and step", forbid_unknown_fields=True):
    """Continuous actions in [−1, 1]²: a heading, 0 along the frame's x axis and ±1 against it, and a step, from none at −1 to all at 1."""

    step_m: float = STEP_M

    @property
    def outputs(self) -> int:
        """A network says so many numbers: the action itself."""
        return 2

    def action(self, said: Array) -> Array:
        """Return the action (B, 2) that a network says."""
        return said

    def waypoints(self, positions: Array, frames: Array, actions: Array, area_m: float) -> Array:
        """Return where actions (B, 2) lead from positions (B, 2): (B, 2) m."""
        heading, share = np.clip(np.asarray(actions, np.float64).T, -1.0, 1.0)
        return _moved(positions, frames, np.pi * heading, self.step_m * (share + 1) / 2, area_m)


Move = Headings | HeadingAndStep


def _moved(positions: Array, frames: Array, angles: Array, lengths: Array, area_m: float) -> Array:
    """Positions after moves at angles in their frames (`agent.observation.Frame`), kept in the area; float32 values, as on the wire."""
    cosine, sine, mirror = frames.T
    along, across = lengths * np.cos(angles), mirror * lengths * np.sin(angles)
    moves = np.stack([cosine * along - sine * across, sine * along + cosine * across], axis=1)
    places: Array = np.clip(positions + moves, 0.0, area_m).astype(np.float32).astype(np.float64)
    return places
