"""Thompson sampling: head for a place drawn from the belief."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, lengths
from link.bus.messages import Belief, Particles


def plan(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """The move that ends closest to a source position drawn from the belief at each step (Thompson 1933)."""
    hypotheses = cloud(belief, particles)
    target = hypotheses.places[:, rng.choice(len(hypotheses.weights), p=hypotheses.weights)]
    return int(np.argmin(lengths(reach.moves(belief.position) - target)))
