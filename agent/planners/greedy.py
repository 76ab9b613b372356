"""Greedy: head for the estimate."""

import numpy as np

from agent.planning.around import distances_to
from agent.planning.moves import Reach
from link.bus.messages import Belief, Particles
from plume.elementary import Array


def plan(belief: Belief, _particles: Particles, moves: Array, reach: Reach, _rng: np.random.Generator) -> int:
    """The move that ends closest to the estimate."""
    return int(np.argmin(distances_to(np.array(belief.mean), moves, reach.area)))
