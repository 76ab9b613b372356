"""Entrotaxis: go where the next reading is the least certain."""

import numpy as np

from agent.moves import Reach
from agent.predict import cloud, imagine
from link.messages import Belief, Particles


def plan(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """The move where the predictive distribution of the reading has the greatest entropy (Hutchinson et al. 2018)."""
    moves = reach.moves(belief.position)
    imagined = imagine(belief, cloud(belief, particles), moves, reach.measurements, rng)
    return int(np.argmin(imagined.log_predictive.mean(axis=1)))
