"""Infotaxis: go where the next reading is expected to be most informative about the source."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine
from link.bus.messages import Belief, Particles
from plume.elementary import Array


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the greatest expected information gain (Vergassola 2007; Hutchinson 2018, eq. 14)."""
    hypotheses = cloud(belief, particles)
    imagined = imagine(hypotheses, moves, reach.measurements, rng, before=reach.foreseen())
    return int(np.argmax(imagined.gains.mean(axis=1)))
