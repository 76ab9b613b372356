"""DCEE (dual control): go where the source is expected to be after the next reading."""

import numpy as np

from agent.planning.around import distances
from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine
from link.bus.messages import Belief, Particles
from plume.elementary import Array


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move p' with the least E[‖p' − ŝ'‖² + tr Cov'] (Chen, Rhodes, Liu 2021).

    ŝ' and Cov' belong to the belief after a reading at p'. The sum of both terms is the expected squared
    distance from p' to the source under that belief.
    """
    hypotheses = cloud(belief, particles)
    east, north = (moves[:, axis, None] - hypotheses.places[axis] for axis in (0, 1))  # (A, N)
    squared = east * east + north * north
    if reach.area.obstacles:
        squared = np.square(distances(hypotheses, moves, reach.area))
    imagined = imagine(hypotheses, moves, reach.measurements, rng, squared[:, None], before=reach.foreseen())
    return int(np.argmin(imagined.expectations.mean(axis=(1, 2))))
