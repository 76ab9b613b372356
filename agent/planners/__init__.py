"""Planners by name: each a pure function from a belief to the next move, one small file each."""

from collections.abc import Callable
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from link.messages import Belief, Particles

Planner = Callable[[Belief, Particles, NDArray[np.float64], np.random.Generator], int]
"""(belief, particles, moves (A, 2), keyed randomness) -> index of the chosen move."""

PLANNERS = {
    "infotaxis": "agent.planners.infotaxis",
    "random": "agent.planners.random",
}
"""The module of each planner; it is imported when the planner is asked for."""


def planner(name: str) -> Planner:
    """Find a planner by its name."""
    plan: Planner = import_module(PLANNERS[name]).plan
    return plan
