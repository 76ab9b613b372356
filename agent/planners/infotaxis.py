"""Infotaxis: go where the next reading is expected to tell most about the source."""

import numpy as np
from numpy.typing import NDArray

from agent import kernels
from agent.predict import mean_concentrations
from link.messages import Belief, Particles
from plume.sensor import Gaussian, Sensor, parse

Array = NDArray[np.float64]

MEASUREMENTS = 25
"""Hypothetical readings per move."""


def plan(belief: Belief, particles: Particles, moves: Array, rng: np.random.Generator) -> int:
    """The move with the greatest expected information gain (Vergassola 2007; Hutchinson 2018, eq. 14).

    The expectation is over the predictive density of the reading there, by stratified draws from the belief; all moves
    share the same draws, so that chance does not decide between them.
    """
    return int(np.argmax(information_gain(belief, particles, moves, rng)))


def information_gain(
    belief: Belief, particles: Particles, moves: Array, rng: np.random.Generator, measurements: int = MEASUREMENTS
) -> Array:
    """Expected Kullback–Leibler divergence, nats, from the belief to the belief after a reading at each move (A,)."""
    weights = particles[:, -1].astype(np.float64)
    means = mean_concentrations(belief, particles, moves)  # (A, N)
    cumulative = np.cumsum(weights)
    strata = (np.arange(measurements) + rng.random()) / measurements * cumulative[-1]
    imagined_sources = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(weights) - 1)
    sensor = parse(belief.sensor)
    weights /= cumulative[-1]
    if isinstance(sensor, Gaussian):
        noise = rng.standard_normal(measurements)
        return kernels.expected_divergence(means, sensor.noise_std(means), weights, imagined_sources, noise)
    return np.array([_divergence(row, row[imagined_sources], weights, sensor, rng) for row in means])


def _divergence(means: Array, imagined_means: Array, weights: Array, sensor: Sensor, rng: np.random.Generator) -> float:
    """Mean over imagined readings of KL(posterior ‖ prior) at one place, for a sensor of any kind."""
    readings = sensor.measure(imagined_means, rng)
    log_likelihoods = sensor.log_likelihood(readings[:, None], means)  # (K, N)
    log_likelihoods -= log_likelihoods.max(axis=1, keepdims=True)
    likelihoods = weights * np.exp(log_likelihoods)
    totals = likelihoods.sum(axis=1)
    return float(np.mean((likelihoods * log_likelihoods).sum(axis=1) / totals - np.log(totals)))
