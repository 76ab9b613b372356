"""Entrotaxis: go where the next reading is least certain."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine
from link.bus.messages import Belief, Particles
from plume.elementary import Array


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move where the reading's predictive distribution has the greatest entropy (Hutchinson 2018).

    H(z) = I(z; source) + E[H(z | source)]. The second term follows from the sensor, so only the first is
    estimated from hypothetical readings. The mean of −log p(z) estimates the same, with much more scatter.
    """
    hypotheses = cloud(belief, particles)
    imagined = imagine(hypotheses, moves, reach.measurements, rng, before=reach.foreseen())
    of_noise = hypotheses.mean(hypotheses.sensor.entropy(imagined.means, *imagined.noises))
    return int(np.argmax(imagined.gains.mean(axis=1) + of_noise))
