"""Greedy: head for the estimate."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import lengths
from link.bus.messages import Belief, Particles


def plan(belief: Belief, _particles: Particles, reach: Reach, _rng: np.random.Generator) -> int:
    """The move that ends closest to the estimate."""
    return int(np.argmin(lengths(reach.moves(belief.position) - belief.mean)))
