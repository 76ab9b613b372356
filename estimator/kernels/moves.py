"""Metropolis–Hastings moves that leave the posterior given all readings invariant."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.kernels.densities import (
    FUSED,
    add_place_densities,
    greatest_log_density,
    is_a_normal_density,
    is_fused,
    log_prior,
    reading_densities,
)
from estimator.kernels.draws import key_of, uniform, word_at
from plume.compiled import kernel
from plume.kernels import DERIVED, NOISES, derive, is_location_only, is_plain
from plume.numerics import direction, dot, exp, log, total_of
from plume.parameters import LOGNORMAL, PHI, X, Y

Array = NDArray[np.float64]

EVERYTHING, PLACE, REST = 0, 1, 2
"""What a proposal changes: all unknowns, those of the place, or the others."""
FREEDOM = 4.0
"""Degrees of freedom of the independent proposals: their tails are heavier than a posterior's."""
TINY = 1e-12
"""A variance that keeps a collapsed cloud's covariance regular, m²."""
BLOCK = 256
"""Proposals that are judged together: their arrays stay in the processor's first-level cache."""
ENOUGH, ENOUGH_OF_MORE = 0.5, 2.0
"""Accepted moves for each particle after which further sweeps would hardly change the cloud: of the place
alone, and of more unknowns.
"""


@numba.njit(error_model="numpy")
def _propose(
    particles: Array,
    pool: Array,
    stds: Array,
    unknowns: NDArray[np.int64],
    priors: Array,
    block: int,
    key: np.uint64,
    proposals: Array,
    needed: Array,
) -> None:
    """Fill `proposals` (D, M) with a step for each particle (D, M) (differential evolution, ter Braak
    2006).

    A step is a scaled difference of two members of the pool (D, N) plus a little uniform noise. Such steps
    follow curved and multimodal posteriors. Log-normal unknowns step in their logarithm, in which the pool
    holds them. If a proposal leaves the prior's support, its `needed` becomes infinite, so that it is
    rejected. (Reflection at the ends would make correlated steps asymmetric.)
    """
    rows, count = particles.shape
    moved = 0
    for row in range(rows):
        of_place = unknowns[row] == X or unknowns[row] == Y
        moved += block == EVERYTHING or of_place == (block == PLACE)
    largest = 2.38 / math.sqrt(2.0 * moved)
    ones, others, scales = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    size, low_half, half = np.uint64(pool.shape[1]), np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(count):
        word = word_at(key, 2 * i)
        ones[i] = ((word >> half) * size) >> half
        others[i] = ((word & low_half) * size) >> half
        chance = 3 * uniform(key, 2 * i + 1)
        scales[i] = largest * (
            0.7 if chance < 1 else 0.35 if chance < 2 else 0.12
        )  # smaller steps for thin ridges
    for row in range(rows):
        of_place = unknowns[row] == X or unknowns[row] == Y
        if not (block == EVERYTHING or of_place == (block == PLACE)):
            for i in range(count):
                proposals[row, i] = particles[row, i]
            continue
        low, high = priors[unknowns[row], 3], priors[unknowns[row], 4]
        first = (2 + row) * count
        for i in range(count):
            noise = 0.17 * (uniform(key, first + i) - 0.5)
            proposals[row, i] = scales[i] * (pool[row, ones[i]] - pool[row, others[i]]) + noise * stds[row]
        if priors[unknowns[row], 0] == LOGNORMAL:
            for i in range(count):
                proposals[row, i] = particles[row, i] * exp(proposals[row, i])
        else:
            for i in range(count):
                proposals[row, i] += particles[row, i]
            if unknowns[row] == PHI and high - low == 2 * math.pi:
                for i in range(count):
                    proposals[row, i] = low + (proposals[row, i] - low) % (2 * math.pi)
        for i in range(count):
            inside = low <= proposals[row, i] <= high
            needed[i] = needed[i] if inside else np.inf


@numba.njit(error_model="numpy")
def _propose_place(states: Array, priors: Array, key: np.uint64, proposals: Array, needed: Array) -> None:
    """Fill `proposals` (2, N) with places that do not depend on the states: Student's t with the
    particles' mean and covariance.

    A posterior that is close to normal accepts most of them. `needed` becomes what the log target of a
    proposal has to reach, by the ratio of the proposal's densities.
    """
    count = states.shape[1]
    mean_x, mean_y = total_of(states[0]) / count, total_of(states[1]) / count
    dx, dy = states[0] - mean_x, states[1] - mean_y
    xx, xy, yy = dot(dx, dx) / count, dot(dx, dy) / count, dot(dy, dy) / count
    a = math.sqrt(max(xx, TINY))
    b = xy / a
    c = math.sqrt(max(yy - b * b, 1e-6 * yy + TINY))
    inverse_a, inverse_c = 1 / a, 1 / c
    for i in range(count):
        square = FREEDOM * (1 / math.sqrt(uniform(key, 2 * i)) - 1)  # of the radius, by inversion
        radius = math.sqrt(square)
        cosine, sine = direction(uniform(key, 2 * i + 1))
        proposals[0, i] = mean_x + a * radius * cosine
        proposals[1, i] = mean_y + radius * (b * cosine + c * sine)
        one = dx[i] * inverse_a
        two = (dy[i] - b * one) * inverse_c
        needed[i] += 0.5 * (FREEDOM + 2) * log((FREEDOM + one * one + two * two) / (FREEDOM + square))
    for i in range(count):
        inside = (
            priors[X, 3] <= proposals[0, i] <= priors[X, 4]
            and priors[Y, 3] <= proposals[1, i] <= priors[Y, 4]
        )
        needed[i] = needed[i] if inside else np.inf


@numba.njit(error_model="numpy")
def _judge(
    proposals: Array,
    derived: Array,
    targets: Array,
    needed: Array,
    owners: NDArray[np.int64],
    alive: int,
    readings: Array,
    bounds: Array,
    priors: Array,
    sensor: Array,
    scratch: Array,
    fused: bool,
) -> int:
    """Add the log-likelihood of all readings to the targets of the first `alive` proposals; returns how
    many are accepted, now in front.

    bounds: (2, T) the greatest log-likelihood of all readings before each, and the sum of the shares of
    those that have noise. Readings are evaluated newest first, since the newest is the most likely to
    reject. A proposal is given up early if it cannot reach `needed` even with the best possible likelihood
    of the remaining readings. This changes no decision.
    """
    rows = len(proposals)
    last = len(readings) - 1
    plain = is_plain(priors)
    means, densities, log_noises, possible = scratch[0], scratch[1], scratch[2], scratch[3]
    keepers = np.empty(alive, np.int64)
    back = next_check = 0
    while back <= last:
        t = last - back
        share = readings[t, 6]
        if fused and share == 1.0:
            newest = t
            while t > 0 and last - t < next_check and newest - t + 1 < FUSED and readings[t - 1, 6] == 1.0:
                t -= 1
            back = last - t
            add_place_densities(proposals, alive, readings, t, newest, priors, sensor, scratch[3:], targets)
        else:
            reading_densities(proposals, derived, alive, readings[t], priors, sensor, means, densities)
            for j in range(alive):
                targets[j] += share * densities[j]
        back += 1
        if back > next_check or t == 0:
            next_check = 2 * back - 1
            if not plain:
                for j in range(alive):
                    log_noises[j] = log(derived[NOISES, j])
            for j in range(alive):
                possible[j] = targets[j] + bounds[0, t] - 0.5 * bounds[1, t] * log_noises[j] - needed[j]
            kept = 0
            for j in range(alive):
                keepers[kept] = j
                kept += possible[j] >= 0
            for row in range(rows):
                for j in range(kept):
                    proposals[row, j] = proposals[row, keepers[j]]
            for row in range(len(derived)):
                for j in range(kept):
                    derived[row, j] = derived[row, keepers[j]]
            for j in range(kept):
                owners[j], targets[j], needed[j] = owners[keepers[j]], targets[keepers[j]], needed[keepers[j]]
            alive = kept
            if alive == 0:
                break
    return alive


@kernel(
    "int64(float64[:, ::1], float64[::1], int64[::1], int64, float64[:, ::1], int64[::1], float64[:, ::1], "
    "float64[::1], uint64, "
    "int64, int64)"
)
def resample_move(
    particles: Array,
    log_targets: Array,
    ancestors: NDArray[np.int64],
    sweeps: int,
    readings: Array,
    unknowns: NDArray[np.int64],
    priors: Array,
    sensor: Array,
    seed: int,
    step: int,
    stage: int,
) -> int:
    """Replace the particles (D, N) by their ancestors (N,), and move these by Metropolis–Hastings sweeps.

    The sweeps leave the posterior given all readings invariant. They end when ENOUGH moves have been
    accepted, or after `sweeps`.
    log_targets: (N,) log posterior density of each particle up to a constant.  Returns the number of
    accepted moves.
    """
    rows, count = particles.shape
    last = len(readings) - 1
    only_location = is_location_only(unknowns, priors)
    fused = is_fused(unknowns, readings, priors, sensor)
    only_place = rows == 2 and unknowns[0] == X and unknowns[1] == Y
    pool, stds, before = np.empty((rows, count)), np.empty(rows), log_targets.copy()
    for i in range(count):
        log_targets[i] = before[ancestors[i]]
    for row in range(rows):
        for i in range(count):
            pool[row, i] = particles[row, ancestors[i]]
        for i in range(count):
            particles[row, i] = pool[row, i]
        if priors[unknowns[row], 0] == LOGNORMAL:
            for i in range(count):
                pool[row, i] = log(pool[row, i])
        offsets = pool[row] - total_of(pool[row]) / count
        stds[row] = math.sqrt(dot(offsets, offsets) / count)
    bounds = np.zeros((2, last + 1))
    for t in range(last):
        share = readings[t, 6]
        bounds[0, t + 1] = bounds[0, t] + share * greatest_log_density(readings[t, 5], sensor, priors)
        bounds[1, t + 1] = bounds[1, t] + share * is_a_normal_density(readings[t, 5], sensor)
    proposals, needed = np.empty((rows, count)), np.empty(count)
    few, derived, scratch = (
        np.empty((rows, BLOCK)),
        np.empty((0 if only_location else DERIVED, BLOCK)),
        np.zeros((6, BLOCK)),
    )
    owners, targets, thresholds = np.empty(BLOCK, np.int64), np.empty(BLOCK), np.empty(BLOCK)
    accepted, enough = 0, ENOUGH if only_place else ENOUGH_OF_MORE
    for sweep in range(sweeps):
        key = key_of(seed, step, stage, 2 * sweep + 2)
        for i in range(count):
            needed[i] = log_targets[i] + log(uniform(key, i))
        key = key_of(seed, step, stage, 2 * sweep + 1)
        if only_place and sweep == 0:
            _propose_place(particles, priors, key, proposals, needed)
        else:
            block = sweep % 3 if rows > 3 and unknowns[0] <= Y else EVERYTHING
            _propose(particles, pool, stds, unknowns, priors, block, key, proposals, needed)
        for first in range(0, count, BLOCK):
            size = min(BLOCK, count - first)
            for row in range(rows):
                for j in range(size):
                    few[row, j] = proposals[row, first + j]
            for j in range(size):
                owners[j] = first + j
                thresholds[j] = needed[first + j]
                targets[j] = log_prior(few, j, unknowns, priors)
            if not only_location:
                derive(few, size, unknowns, priors, derived)
            size = _judge(
                few,
                derived,
                targets,
                thresholds,
                owners,
                size,
                readings,
                bounds,
                priors,
                sensor,
                scratch,
                fused,
            )
            for j in range(size):
                for row in range(rows):
                    particles[row, owners[j]] = few[row, j]
                log_targets[owners[j]] = targets[j]
            accepted += size
        if accepted >= enough * count:
            break
    return accepted
