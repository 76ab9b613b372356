"""How a planner may move, and how much it may imagine before it does."""

from dataclasses import dataclass
from functools import cached_property

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

    def moves(self, position: tuple[float, float]) -> Array:
        """Return the waypoints (A, 2) m that one step reaches without leaving the area; float32 values, as the wire carries them."""
        places = (np.asarray(position) + self.step * self.directions).astype(np.float32).astype(np.float64)
        return places[((places >= 0) & (places <= self.area_m)).all(axis=1)]

    @cached_property
    def directions(self) -> Array:
        """Unit vectors (A, 2) of the headings."""
        angles = 2 * np.pi * np.arange(self.headings) / self.headings
        return np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 15)  # east is east, not east and 6e-17 north
