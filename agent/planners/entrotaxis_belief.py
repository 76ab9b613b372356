"""Entrotaxis as defined in the paper's appendix: go where the belief is expected to stay least certain."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine
from link.bus.messages import Belief, Particles
from plume.elementary import Array
from plume.numerics import log_each


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the greatest expected entropy of the particles' weights, −Σ w' log w'."""
    hypotheses = cloud(belief, particles)
    log_weights = log_each(np.maximum(hypotheses.weights, 1e-300))
    imagined = imagine(hypotheses, moves, reach.measurements, rng, log_weights[None], before=reach.foreseen())
    # w' = w · likelihood / predictive density. The entropy is −Σ w' log w'.
    entropies = imagined.log_predictive - imagined.log_likelihood - imagined.expectations[:, :, 0]
    return int(np.argmax(entropies.mean(axis=1)))
