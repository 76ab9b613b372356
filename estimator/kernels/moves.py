"""Metropolis–Hastings moves that leave the posterior given all readings invariant."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.kernels.densities import greatest_log_density, log_densities_of, log_prior
from estimator.kernels.draws import key_of, uniform, word_at
from estimator.kernels.weights import dot
from plume.compiled import kernel
from plume.kernels import DERIVED, derive, derived_means, is_location_only, location_means
from plume.numerics import log, total_of
from plume.parameters import PHI

Array = NDArray[np.float64]


@numba.njit(error_model="numpy")
def _propose(
    particles: Array,
    frozen: Array,
    stds: Array,
    unknowns: NDArray[np.int64],
    priors: Array,
    key: np.uint64,
    proposals: Array,
    needed: Array,
) -> None:
    """Fill `proposals` with a step for each particle (differential evolution, ter Braak 2006).

    A step is a scaled difference of two other particles plus a little uniform noise. Such steps follow curved and multimodal
    posteriors. If a proposal leaves the prior's support, its `needed` becomes infinite, so that it is rejected.
    """
    rows, count = particles.shape
    largest = 2.38 / math.sqrt(2.0 * rows)
    ones, others, scales = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    size, low_half, half = np.uint64(count), np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(count):
        word = word_at(key, 2 * i)
        ones[i] = ((word >> half) * size) >> half
        others[i] = ((word & low_half) * size) >> half
        chance = 3 * uniform(key, 2 * i + 1)
        scales[i] = largest * (0.7 if chance < 1 else 0.35 if chance < 2 else 0.12)  # smaller steps for thin ridges
    for row in range(rows):
        low, high = priors[unknowns[row], 3], priors[unknowns[row], 4]
        first = (2 + row) * count
        for i in range(count):
            noise = 0.17 * (uniform(key, first + i) - 0.5)
            proposals[row, i] = particles[row, i] + scales[i] * (frozen[row, ones[i]] - frozen[row, others[i]]) + noise * stds[row]
        if unknowns[row] == PHI and high - low == 2 * math.pi:
            for i in range(count):
                proposals[row, i] = low + (proposals[row, i] - low) % (2 * math.pi)
        for i in range(count):
            inside = low <= proposals[row, i] <= high
            needed[i] = needed[i] if inside else np.inf


@kernel("int64(float64[:, ::1], float64[::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[::1], uint64, int64, int64, int64)")
def metropolis(
    particles: Array,
    log_targets: Array,
    readings: Array,
    unknowns: NDArray[np.int64],
    priors: Array,
    sensor: Array,
    seed: int,
    step: int,
    stage: int,
    sweeps: int,
) -> int:
    """Move the particles in place by Metropolis–Hastings sweeps that leave the posterior given all readings invariant.

    log_targets: (N,) log posterior density of each particle up to a constant.  Returns the number of accepted moves.
    """
    rows, count = particles.shape
    last = len(readings) - 1
    only_location = is_location_only(unknowns, priors)
    frozen = particles.copy()
    stds = np.empty(rows)
    for row in range(rows):
        offsets = frozen[row] - total_of(frozen[row]) / count
        stds[row] = math.sqrt(dot(offsets, offsets) / count)
    best = 0.0
    for t in range(last):
        best += readings[t, 6] * greatest_log_density(readings[t, 5], sensor)
    proposals = np.empty((rows, count))
    derived = np.empty((0 if only_location else DERIVED, count))
    owners = np.empty(count, np.int64)
    targets, needed, means, densities = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    accepted = 0
    for sweep in range(sweeps):
        key = key_of(seed, step, stage, 2 * sweep + 2)
        for i in range(count):
            owners[i] = i
            needed[i] = log_targets[i] + log(uniform(key, i))
        _propose(particles, frozen, stds, unknowns, priors, key_of(seed, step, stage, 2 * sweep + 1), proposals, needed)
        for i in range(count):
            targets[i] = log_prior(proposals, i, unknowns, priors)
        if not only_location:
            derive(proposals, count, unknowns, priors, derived)
        # Readings are evaluated newest first, since the newest is the most likely to reject. A proposal is given up early if it cannot
        # reach `needed` even with the best possible likelihood of the remaining readings. This changes no decision.
        alive = count
        best_left = best
        next_check = 0
        for back in range(last + 1):
            t = last - back
            if only_location:
                location_means(proposals, alive, readings[t], priors, means)
            else:
                derived_means(derived, alive, readings[t], priors, means)
            log_densities_of(means, alive, readings[t, 5], sensor, densities)
            share = readings[t, 6]
            for j in range(alive):
                targets[j] += share * densities[j]
            if back > 0:
                best_left -= share * greatest_log_density(readings[t, 5], sensor)
            if back == next_check and t > 0:
                next_check = 2 * back + 1
                kept = 0
                for j in range(alive):
                    for row in range(rows):
                        proposals[row, kept] = proposals[row, j]
                    for row in range(len(derived)):
                        derived[row, kept] = derived[row, j]
                    owners[kept] = owners[j]
                    possible = targets[j] + best_left >= needed[j]
                    targets[kept] = targets[j]
                    needed[kept] = needed[j]
                    kept += possible
                alive = kept
        for j in range(alive):
            if targets[j] >= needed[j]:
                i = owners[j]
                for row in range(rows):
                    particles[row, i] = proposals[row, j]
                log_targets[i] = targets[j]
                accepted += 1
    return accepted
