"""Thompson sampling: head for a place drawn from the belief."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud
from link.bus.messages import Belief, Particles


def plan(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """The move that ends nearest to a source drawn from the belief (Thompson 1933), anew at each step."""
    hypotheses = cloud(belief, particles)
    target = hypotheses.places[:, rng.choice(len(hypotheses.weights), p=hypotheses.weights)]
    return int(np.argmin(np.linalg.norm(reach.moves(belief.position) - target, axis=1)))
