"""Random walk: the baseline that every search must beat."""

import numpy as np

from agent.planning.moves import Reach
from link.bus.messages import Belief, Particles
from plume.elementary import Array


def plan(
    _belief: Belief, _particles: Particles, moves: Array, _reach: Reach, rng: np.random.Generator
) -> int:
    """A move drawn uniformly."""
    return int(rng.integers(len(moves)))
