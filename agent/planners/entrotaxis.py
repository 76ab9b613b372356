"""Entrotaxis: go where the next reading is the least certain."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine
from link.bus.messages import Belief, Particles
from plume.sensor import parse


def plan(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """The move where the predictive distribution of the reading has the greatest entropy (Hutchinson et al. 2018).

    H(z) = I(z; source) + E[H(z | source)]: the second term is the sensor's own, so that only the first one is left to be imagined.
    The mean of −log p(z) is the same and scatters much more.
    """
    moves, hypotheses = reach.moves(belief.position), cloud(belief, particles)
    imagined = imagine(belief, hypotheses, moves, reach.measurements, rng)
    of_noise = parse(belief.sensor).entropy(imagined.means) @ hypotheses.weights
    return int(np.argmax(imagined.gains.mean(axis=1) + of_noise))
