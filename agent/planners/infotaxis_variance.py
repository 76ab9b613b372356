"""Infotaxis by the paper's appendix: go where the next reading should leave the least variance."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, variances
from link.bus.messages import Belief, Particles
from plume.elementary import Array


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the least expected trace of the location's covariance."""
    hypotheses, before = cloud(belief, particles), reach.foreseen()
    return int(np.argmin(variances(hypotheses, moves, reach.measurements, rng, before).mean(axis=1)))
