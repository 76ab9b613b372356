"""Infotaxis: go where the next reading is expected to be most informative about the source."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine
from link.bus.messages import Belief, Particles


def plan(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the greatest expected information gain (Vergassola 2007; Hutchinson 2018, eq. 14)."""
    moves = reach.moves(belief.position)
    return int(
        np.argmax(
            imagine(belief, cloud(belief, particles), moves, reach.measurements, rng).gains.mean(axis=1)
        )
    )
