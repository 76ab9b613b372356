"""Infotaxis: go where the next reading is expected to tell most about the source."""

import numpy as np
from numpy.typing import NDArray

from agent import kernels
from link.messages import Belief, Particles
from plume.dispersion import concentration
from plume.sensor import noise_std

MEASUREMENTS = 25
"""Hypothetical readings per move."""


def plan(belief: Belief, particles: Particles, moves: NDArray[np.float64], rng: np.random.Generator) -> int:
    """The move with the greatest expected information gain (Vergassola 2007; Hutchinson 2018, eq. 14).

    The expectation is over the predictive density of the reading there, by stratified draws from the belief; all moves
    share the same draws, so that chance does not decide between them.
    """
    return int(np.argmax(information_gain(belief, particles, moves, rng)))


def information_gain(
    belief: Belief, particles: Particles, moves: NDArray[np.float64], rng: np.random.Generator, measurements: int = MEASUREMENTS
) -> NDArray[np.float64]:
    """Expected Kullback–Leibler divergence, nats, from the belief to the belief after a reading at each move (A,)."""
    sources, weights = particles[:, :2].astype(np.float64), particles[:, 2].astype(np.float64)
    mean = concentration(
        moves[:, None], sources, belief.wind, rate=belief.rate, diffusivity=belief.diffusivity, lifetime=belief.lifetime
    )  # (A, N)
    cumulative = np.cumsum(weights)
    strata = (np.arange(measurements) + rng.random()) / measurements * cumulative[-1]
    imagined_sources = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(weights) - 1)
    return kernels.expected_divergence(mean, noise_std(mean), weights / cumulative[-1], imagined_sources, rng.standard_normal(measurements))
