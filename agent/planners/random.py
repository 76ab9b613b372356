"""Random walk: the baseline that every search must beat."""

import numpy as np
from numpy.typing import NDArray

from link.messages import Belief, Particles


def plan(_belief: Belief, _particles: Particles, moves: NDArray[np.float64], rng: np.random.Generator) -> int:
    """Any move, each as likely as the others."""
    return int(rng.integers(len(moves)))
