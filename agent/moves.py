"""The moves that a planner chooses from: steps of equal length that stay inside the area."""

import numpy as np
from numpy.typing import NDArray

from plume.scenario import AREA_M, STEP_M

HEADINGS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""East, north, west, south."""


def moves(position: tuple[float, float], area_m: float = AREA_M) -> NDArray[np.float64]:
    """Return the waypoints (A, 2) m that one step reaches; float32 values, as the wire carries them."""
    waypoints = (np.asarray(position) + STEP_M * HEADINGS).astype(np.float32).astype(np.float64)
    inside = ((waypoints >= 0) & (waypoints <= area_m)).all(axis=1)
    return waypoints[inside]
