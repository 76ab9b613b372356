"""The filter's former moves, kept as a reference for `benchmarks.filter`: three sweeps of differential evolution for every particle."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.kernels.densities import log_densities_of
from estimator.kernels.draws import key_of, uniform, word_at
from estimator.kernels.weights import dot
from plume.compiled import kernel
from plume.kernels import location_means
from plume.numerics import log, total_of

Array = NDArray[np.float64]


@numba.njit(error_model="numpy")
def _propose(particles: Array, frozen: Array, stds: Array, area_m: float, key: np.uint64, proposals: Array, needed: Array) -> None:
    """Fill `proposals` (2, N) with a step for each particle; outside the area, its `needed` becomes infinite."""
    rows, count = particles.shape
    largest = 2.38 / math.sqrt(2.0 * rows)
    ones, others, scales = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    size, low_half, half = np.uint64(count), np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(count):
        word = word_at(key, 2 * i)
        ones[i] = ((word >> half) * size) >> half
        others[i] = ((word & low_half) * size) >> half
        chance = 3 * uniform(key, 2 * i + 1)
        scales[i] = largest * (0.7 if chance < 1 else 0.35 if chance < 2 else 0.12)
    for row in range(rows):
        first = (2 + row) * count
        for i in range(count):
            noise = 0.17 * (uniform(key, first + i) - 0.5)
            proposals[row, i] = particles[row, i] + scales[i] * (frozen[row, ones[i]] - frozen[row, others[i]]) + noise * stds[row]
        for i in range(count):
            inside = 0.0 <= proposals[row, i] <= area_m
            needed[i] = needed[i] if inside else np.inf


@kernel("int64(float64[:, ::1], float64[::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[::1], float64, uint64, int64, int64)")
def former_resample_move(
    particles: Array,
    log_targets: Array,
    ancestors: NDArray[np.int64],
    readings: Array,
    priors: Array,
    sensor: Array,
    area_m: float,
    seed: int,
    step: int,
    stage: int,
) -> int:
    """Replace the particles (2, N) by their ancestors and move each in three sweeps; returns the number of accepted moves."""
    rows, count = particles.shape
    last = len(readings) - 1
    particles[:] = particles[:, ancestors]
    log_targets[:] = log_targets[ancestors]
    frozen = particles.copy()
    stds = np.empty(rows)
    for row in range(rows):
        offsets = frozen[row] - total_of(frozen[row]) / count
        stds[row] = math.sqrt(dot(offsets, offsets) / count)
    floor = -math.log(sensor[2]) - 0.5 * math.log(2 * math.pi)
    best = 0.0
    for t in range(last):
        best += readings[t, 6] * floor
    proposals = np.empty((rows, count))
    owners = np.empty(count, np.int64)
    targets, needed, means, densities = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    accepted = 0
    for sweep in range(3):
        key = key_of(seed, step, stage, 2 * sweep + 2)
        for i in range(count):
            owners[i] = i
            targets[i] = 0.0
            needed[i] = log_targets[i] + log(uniform(key, i))
        _propose(particles, frozen, stds, area_m, key_of(seed, step, stage, 2 * sweep + 1), proposals, needed)
        alive = count
        best_left = best
        next_check = 0
        for back in range(last + 1):
            t = last - back
            location_means(proposals, alive, readings[t], priors, means)
            log_densities_of(means, alive, readings[t, 5], sensor, densities)
            share = readings[t, 6]
            for j in range(alive):
                targets[j] += share * densities[j]
            if back > 0:
                best_left -= share * floor
            if back == next_check and t > 0:
                next_check = 2 * back + 1
                kept = 0
                for j in range(alive):
                    for row in range(rows):
                        proposals[row, kept] = proposals[row, j]
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
