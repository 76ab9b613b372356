"""Assimilates one reading: reweight; if the weights degenerate, resample and move.

Within a round of several vehicles weights may degenerate further. The sample is renewed after the round.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.kernels.checks import predictive_rank
from estimator.kernels.densities import (
    MODEL,
    ROW,
    STACK,
    TABLE,
    Model,
    derived_of,
    reading_densities,
    tuple_type,
)
from estimator.kernels.moves import move
from estimator.kernels.weights import effective_sample_size, systematic, tempered_share
from plume.compiled import kernel, subroutine
from plume.draws import key_of, uniform
from plume.elementary import Array, Indices
from plume.kernels import derive

# Shares of N. Resample if the effective sample size falls below the first.
# Within a round of several vehicles it is the second, and between rounds the third.
RESAMPLE_BELOW, WITHIN_A_ROUND, BETWEEN_ROUNDS = 0.5, 0.02, 0.8
# Between rounds, while the vehicles fly: with fewer moves the search takes more rounds (docs/fleet.md).
MOVES_OF_A_ROUND = 3
# Most tempered stages per reading. The rest of its likelihood is dropped, so that no admitted reading
# collapses the sample to a point.
MAX_STAGES = 40


class WeightedSample(NamedTuple):
    """Weighted particles; `update` changes the arrays in place."""

    particles: Array  # (D, N), one row per unknown
    log_weights: Array  # (N,) up to a constant
    weights: Array  # (N,) exp(log_weights), scaled so that the greatest is 1
    log_targets: Array  # (N,) log posterior density given all readings so far, up to a constant


SAMPLE, SAMPLES = (
    tuple_type((all_of, each, each, each), WeightedSample) for all_of, each in ((TABLE, ROW), (STACK, TABLE))
)
MODELS = tuple_type((numba.int64[::1], STACK, TABLE, TABLE, STACK, TABLE), Model)


@subroutine
def reweight(
    sample: WeightedSample, log_densities: Array, exponent: float, least: float
) -> tuple[float, float]:
    """Multiply the weights by likelihoods (N,), of which `exponent` has been taken already.

    Returns the exponent taken by now, 1 unless this would reduce the effective sample size too much
    (`tempered_share`), and that size.
    """
    _, log_weights, weights, log_targets = sample
    left = 1.0 - exponent
    share, size = tempered_share(log_weights, log_densities, left, weights, least)
    for i in range(len(weights)):
        log_weights[i] += share * log_densities[i]
        log_targets[i] += share * log_densities[i]
    return 1.0 if share >= left else exponent + share, size


@subroutine
def resample(sample: WeightedSample, offset: float) -> None:
    """Replace the particles by their ancestors, of equal weight, by `systematic` resampling."""
    particles, log_weights, weights, log_targets = sample
    ancestors = systematic(weights, offset)
    old_particles, old_targets = particles.copy(), log_targets.copy()
    for row in range(len(particles)):
        for i in range(len(ancestors)):
            particles[row, i] = old_particles[row, ancestors[i]]
    for i in range(len(ancestors)):
        log_weights[i], weights[i], log_targets[i] = 0.0, 1.0, old_targets[ancestors[i]]


@subroutine
def _assimilate(
    sample: WeightedSample, readings: Array, model: Model, seed: int, sweeps: int, least: float
) -> float:
    """Assimilate the last of the readings (T, 7) in place, setting its share; returns its predictive rank.

    Reweight; if the weights degenerate, resample and move (Gordon 1993; Chopin 2002). A reading that would
    reduce the effective sample size too much is taken in tempered stages (Del Moral 2006).  least: the share
    of N below which they degenerate.
    tests/estimator/test_textbook.py has the same in plain NumPy.
    """
    count, step = sample.particles.shape[1], len(readings) - 1
    reading, derived = readings[step], derived_of(count, model)
    means, fresh, squares, log_densities = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    rank, exponent = 0.5, 0.0
    for stage in range(MAX_STAGES):
        if len(derived):
            derive(sample.particles, count, model.unknowns, model.priors, derived)
        reading_densities(
            sample.particles, derived, count, reading, model, means, fresh, squares, log_densities
        )
        if stage == 0:
            chance = uniform(key_of(seed, step, 0, 1000), 0)
            rank = predictive_rank(means, fresh, squares, derived, sample.weights, reading[5], model, chance)
        exponent, size = reweight(sample, log_densities, exponent, least)
        reading[6] = exponent
        if size < least * count:
            resample(sample, uniform(key_of(seed, step, stage, 0), 0))
            move(sample.particles, sample.log_targets, readings, model, sweeps, seed, stage)
        if exponent == 1.0:
            break
    return rank


@kernel(
    numba.void(
        *(SAMPLES, STACK, TABLE, numba.int64[::1], MODELS, numba.uint64[::1], numba.int64),
        *(numba.float64, numba.int64[::1]),
    ),
    nogil=True,
)
def update_missions(
    samples: WeightedSample,
    readings: Array,
    ranks: Array,
    counts: Indices,
    models: Model,
    seeds: NDArray[np.uint64],
    sweeps: int,
    least: float,
    missions: Indices,
) -> None:
    """Assimilate the last of the first `counts` readings of each of these missions of a batch.

    Arrays are as in `_assimilate`, stacked, but for the unknowns, which all share, as `sweeps` and `least`.
    """
    particles, log_weights, weights, log_targets = samples
    unknowns, priors, sensors, spikes, walls, densities = models
    for b in missions:
        sample = WeightedSample(particles[b], log_weights[b], weights[b], log_targets[b])
        model = Model(unknowns, priors[b], sensors[b], spikes[b], walls[b], densities[b])
        count = counts[b]
        ranks[b, count - 1] = _assimilate(sample, readings[b, :count], model, seeds[b], sweeps, least)


def update(
    sample: WeightedSample, readings: Array, model: Model, seed: int, sweeps: int, least: float
) -> float:
    """Assimilate the last of the readings (T, 7) of one mission, as `_assimilate`: a batch of one."""
    unknowns, *others = model
    stacked = WeightedSample(*(array[None] for array in sample))
    models = Model(unknowns, *(array[None] for array in others))
    count, first = len(readings), np.zeros(1, np.int64)
    ranks, seeds = np.empty((1, count)), np.array([seed], np.uint64)
    update_missions(stacked, readings[None], ranks, np.array([count]), models, seeds, sweeps, least, first)
    return float(ranks[0, -1])


@kernel(numba.void(SAMPLE, TABLE, MODEL, numba.uint64, numba.int64))
def renew(sample: WeightedSample, readings: Array, model: Model, seed: int, sweeps: int) -> None:
    """Resample, and move MOVES_OF_A_ROUND times by the posterior given all readings (T, 7), in place.

    Nothing is done while the weights are nearly equal: a round has told next to nothing.
    """
    if effective_sample_size(sample.weights) >= BETWEEN_ROUNDS * len(sample.weights):
        return
    resample(sample, uniform(key_of(seed, len(readings) - 1, MAX_STAGES, 0), 0))
    for stage in range(MAX_STAGES, MAX_STAGES + MOVES_OF_A_ROUND):
        move(sample.particles, sample.log_targets, readings, model, sweeps, seed, stage)
