"""Thompson sampling: head for a place drawn from the belief."""

import numpy as np

from agent.planning.around import distances_to
from agent.planning.moves import Reach
from agent.planning.predict import Cloud, cloud
from link.bus.messages import Belief, Particles
from plume.elementary import Array
from plume.problem import AREA, Area


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move that ends closest to a source position drawn from the belief at each step (Thompson 1933)."""
    return towards(cloud(belief, particles), moves, rng, reach.area)


def towards(hypotheses: Cloud, moves: Array, rng: np.random.Generator, area: Area = AREA) -> int:
    """Of moves (A, 2), the one that ends closest to a place drawn from the belief."""
    target = hypotheses.places[:, rng.choice(len(hypotheses.weights), p=hypotheses.weights)]
    return int(np.argmin(distances_to(target, moves, area)))
