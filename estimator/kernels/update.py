"""Assimilates one reading: reweight; if the weights degenerate, resample and move."""

import numpy as np
from numpy.typing import NDArray

from estimator.kernels.checks import predictive_rank
from estimator.kernels.densities import reading_densities
from estimator.kernels.draws import key_of, uniform
from estimator.kernels.moves import resample_move
from estimator.kernels.weights import systematic, tempered_share
from plume.compiled import kernel
from plume.kernels import DERIVED, derive, is_location_only

Array = NDArray[np.float64]

RESAMPLE_BELOW = 0.5
"""Resample if the effective sample size falls below this share of N."""
MAX_STAGES = 40
"""Most tempered stages per reading. The rest of its likelihood is dropped, so that no admitted reading
collapses the cloud to a point.
"""


@kernel(
    "float64(float64[:, ::1], float64[::1], float64[::1], float64[::1], float64[:, ::1], int64[::1], "
    "float64[:, ::1], float64[::1], "
    "uint64, int64)",
    nogil=True,
)
def update(
    particles: Array,
    log_weights: Array,
    weights: Array,
    log_targets: Array,
    readings: Array,
    unknowns: NDArray[np.int64],
    priors: Array,
    sensor: Array,
    seed: int,
    sweeps: int,
) -> float:
    """Assimilate the last of the readings (T, 7) in place, setting its share; returns its predictive rank.

    Reweight; if the weights degenerate, resample and move (Gordon 1993; Chopin 2002). A reading that would
    reduce the effective sample size too much is taken in tempered stages (Del Moral 2006).  weights: (N,)
    exp(log_weights), scaled so that the greatest is 1.
    """
    count = particles.shape[1]
    step = len(readings) - 1
    reading = readings[step]
    derived = np.empty((0 if is_location_only(unknowns, priors) else DERIVED, count))
    means, densities = np.empty(count), np.empty(count)
    rank = 0.5
    exponent = 0.0
    stage = 0
    while True:
        if len(derived):
            derive(particles, count, unknowns, priors, derived)
        reading_densities(particles, derived, count, reading, priors, sensor, means, densities)
        if stage == 0:
            chance = uniform(key_of(seed, step, 0, 1000), 0)
            rank = predictive_rank(means, derived, weights, reading[5], priors, sensor, chance)
        left = 1.0 - exponent
        share, size = tempered_share(log_weights, densities, left, weights)
        exponent = 1.0 if share >= left else exponent + share
        reading[6] = exponent
        for i in range(count):
            log_weights[i] += share * densities[i]
            log_targets[i] += share * densities[i]
        if size < RESAMPLE_BELOW * count:
            ancestors = systematic(weights, uniform(key_of(seed, step, stage, 0), 0))
            resample_move(
                particles,
                log_targets,
                ancestors,
                sweeps,
                readings,
                unknowns,
                priors,
                sensor,
                seed,
                step,
                stage,
            )
            log_weights[:] = 0.0
            weights[:] = 1.0
            stage += 1
        if exponent == 1.0 or stage == MAX_STAGES:
            return rank


@kernel(
    "void(float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], "
    "float64[:, ::1], int64[::1], "
    "int64[::1], float64[:, :, ::1], float64[:, ::1], uint64[::1], int64, int64[::1])",
    nogil=True,
)
def update_missions(
    particles: Array,
    log_weights: Array,
    weights: Array,
    log_targets: Array,
    readings: Array,
    ranks: Array,
    counts: NDArray[np.int64],
    unknowns: NDArray[np.int64],
    priors: Array,
    sensors: Array,
    seeds: NDArray[np.uint64],
    sweeps: int,
    missions: NDArray[np.int64],
) -> None:
    """Apply `update` to each of these missions of a batch, with its first `counts` readings; arrays as in
    `update`, stacked.
    """
    for b in missions:
        count = counts[b]
        ranks[b, count - 1] = update(
            particles[b],
            log_weights[b],
            weights[b],
            log_targets[b],
            readings[b, :count],
            unknowns,
            priors[b],
            sensors[b],
            seeds[b],
            sweeps,
        )
