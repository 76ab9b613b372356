"""Metropolis–Hastings moves that leave the posterior given all readings invariant."""

import math
from typing import NamedTuple

import numba
import numpy as np

from estimator.kernels.densities import (
    FUSED,
    MODEL,
    Model,
    add_place_densities,
    derived_of,
    fill_log_priors,
    greatest_log_density,
    is_a_normal_density,
    is_fused,
    place_density,
    reading_densities,
)
from plume.compiled import kernel, subroutine
from plume.draws import key_of, normals, uniform, word_at
from plume.elementary import Array, Indices
from plume.kernels import NOISES, derive, is_plain
from plume.numerics import direction, dot, exp, log, log1p, total_of
from plume.parameters import LOGNORMAL, PHI, Y

EVERYTHING, PLACE, REST = 0, 1, 2  # what a proposal changes: all unknowns, those of the place, or the others
FREEDOM = 4.0  # degrees of freedom of independent proposals: their tails are heavier than a posterior's
TINY = 1e-12  # a variance that keeps a collapsed cloud's covariance regular, m²
BLOCK = 256  # proposals that are judged together: their arrays stay in the processor's first-level cache
# Accepted moves for each particle after which further sweeps would hardly change the cloud: where only the
# place is unknown; else independent draws, and those of more than three unknowns; steps, and steps alone.
ENOUGH_PLACES, ENOUGH_DRAWS, ENOUGH_DRAWS_OF_MANY = 0.5, 0.8, 0.4
ENOUGH_STEPS, ENOUGH_STEPS_ALONE = 1.0, 2.0


class Block(NamedTuple):
    """Proposals that are judged together. Those still in the race are in front."""

    particles: Array  # (D, BLOCK)
    derived: Array  # their columns of `plume.kernels.derive`; empty if only the location is unknown
    targets: Array  # (BLOCK,) log density of the prior and the readings so far
    needed: Array  # (BLOCK,) the log target that is accepted
    owners: Indices  # (BLOCK,) the particle that would move there
    scratch: Array  # (8, BLOCK)


@subroutine
def _is_moved(unknown: int, block: int) -> bool:
    return block == EVERYTHING or (unknown <= Y) == (block == PLACE)


@subroutine
def _is_circle(unknown: int, model: Model) -> bool:
    """True of a wind direction that may be any: a step may cross the end of its range."""
    return bool(unknown == PHI and model.priors[PHI, 4] - model.priors[PHI, 3] == 2 * math.pi)


@subroutine
def _propose_steps(
    particles: Array, pool: Array, model: Model, block: int, key: np.uint64, proposals: Array
) -> None:
    """Fill `proposals` with a step from each particle, (D, N) (differential evolution, ter Braak 2006).

    A step is a scaled difference of two members of the pool (D, N) plus a little uniform noise. Such steps
    follow curved and multimodal posteriors. Log-normal unknowns step in their logarithm, in which the pool
    holds them.
    """
    rows, count = particles.shape
    moved = 0
    for unknown in model.unknowns:
        moved += _is_moved(unknown, block)
    largest = 2.38 / math.sqrt(2.0 * moved)
    ones, others, scales = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    size, low_half, half = np.uint64(count), np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(count):
        word = word_at(key, 2 * i)
        ones[i] = ((word >> half) * size) >> half
        others[i] = ((word & low_half) * size) >> half
        chance = 3 * uniform(key, 2 * i + 1)  # smaller steps for thin ridges
        scales[i] = largest * (0.7 if chance < 1 else 0.35 if chance < 2 else 0.12)
    for row in range(rows):
        unknown = model.unknowns[row]
        if not _is_moved(unknown, block):
            for i in range(count):
                proposals[row, i] = particles[row, i]
            continue
        offsets = pool[row] - total_of(pool[row]) / count
        std = math.sqrt(dot(offsets, offsets) / count)
        first = (2 + row) * count
        for i in range(count):
            noise = 0.17 * (uniform(key, first + i) - 0.5)
            proposals[row, i] = scales[i] * (pool[row, ones[i]] - pool[row, others[i]]) + noise * std
        low = model.priors[unknown, 3]
        if model.priors[unknown, 0] == LOGNORMAL:
            for i in range(count):
                proposals[row, i] = particles[row, i] * exp(proposals[row, i])
        else:
            for i in range(count):
                proposals[row, i] += particles[row, i]
            if _is_circle(unknown, model):
                for i in range(count):
                    proposals[row, i] = low + (proposals[row, i] - low) % (2 * math.pi)


@subroutine
def _propose_places(particles: Array, key: np.uint64, proposals: Array, needed: Array) -> None:
    """Fill `proposals` (2, N) with independent places: Student's t with the particles' mean and covariance.

    A posterior that is close to normal accepts most of them. `needed` takes in the ratio of the proposal's
    densities.
    """
    count = particles.shape[1]
    mean_x, mean_y = total_of(particles[0]) / count, total_of(particles[1]) / count
    dx, dy = particles[0] - mean_x, particles[1] - mean_y
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


@subroutine
def _propose_draws(
    particles: Array, pool: Array, model: Model, key: np.uint64, proposals: Array, needed: Array
) -> None:
    """Fill `proposals` (D, N) with independent draws of all unknowns: Student's t with the pool's mean and
    covariance.

    Log-normal unknowns are drawn in their logarithm. `needed` takes in the ratio of the proposal's densities.
    """
    rows, count = pool.shape
    means, offsets, lower = np.empty(rows), np.empty((rows, count)), np.zeros((rows, rows))
    for row in range(rows):
        means[row] = total_of(pool[row]) / count
        for i in range(count):
            offsets[row, i] = pool[row, i] - means[row]
    for row in range(rows):  # Cholesky's factor of the covariance
        for column in range(row + 1):
            covariance = dot(offsets[row], offsets[column]) / count
            rest = covariance
            for other in range(column):
                rest -= lower[row, other] * lower[column, other]
            if row == column:
                lower[row, row] = math.sqrt(max(rest, 1e-6 * covariance + TINY))
            else:
                lower[row, column] = rest / lower[column, column]
    here, there, stretch, draws = (
        np.zeros(count),
        np.zeros(count),
        np.empty(count),
        np.empty((rows + 1, count)),
    )
    for i in range(count):
        stretch[i] = math.sqrt(-0.5 * FREEDOM / (log(uniform(key, 2 * i)) + log(uniform(key, 2 * i + 1))))
    for row in range(0, rows, 2):
        first = (2 + row) * count
        for i in range(count):
            draws[row, i], draws[row + 1, i] = normals(key, first + 2 * i)
    for row in range(rows):
        logarithmic = model.priors[model.unknowns[row], 0] == LOGNORMAL
        for i in range(count):
            draws[row, i] *= stretch[i]
            there[i] += draws[row, i] * draws[row, i]
            proposals[row, i] = means[row]
        for column in range(row + 1):
            factor = lower[row, column]
            for i in range(count):
                proposals[row, i] += factor * draws[column, i]
        whitened, inverse = offsets[row], 1 / lower[row, row]
        for i in range(count):
            value = particles[row, i]
            whitened[i] = (log(value) if logarithmic else value) - means[row]
        for column in range(row):
            factor, other_row = lower[row, column], offsets[column]
            for i in range(count):
                whitened[i] -= factor * other_row[i]
        for i in range(count):
            whitened[i] *= inverse
            here[i] += whitened[i] * whitened[i]
        if logarithmic:
            for i in range(count):
                proposals[row, i] = exp(proposals[row, i])
    for i in range(count):
        needed[i] += 0.5 * (FREEDOM + rows) * log((FREEDOM + here[i]) / (FREEDOM + there[i]))


@subroutine
def _refuse_outside(proposals: Array, model: Model, needed: Array) -> None:
    """Make `needed` infinite where a proposal leaves the prior's support.

    (Reflection at the ends would make correlated steps asymmetric.)
    """
    for row in range(len(proposals)):
        low, high = model.priors[model.unknowns[row], 3], model.priors[model.unknowns[row], 4]
        for i in range(len(needed)):
            inside = low <= proposals[row, i] <= high
            needed[i] = needed[i] if inside else np.inf
    if len(model.walls) > 0:
        for i in range(len(needed)):
            needed[i] = needed[i] if place_density(proposals, i, model) > 0 else np.inf


@subroutine
def _bounds(readings: Array, model: Model) -> Array:
    """Return (3, T), numbers (a, b, r) of all readings before each.

    Their log-likelihood is at most a + b · log(1/f + r), whatever the means; f is the factor on the noise.
    """
    bounds, plain = np.zeros((3, len(readings))), is_plain(model.priors)
    for t in range(len(readings) - 1):
        gas, share = readings[t, 5], readings[t, 6]
        greatest, spike = greatest_log_density(gas, model)
        falls = is_a_normal_density(gas, model.sensor) and not plain
        bounds[0, t + 1] = bounds[0, t] + share * (greatest if falls else greatest + log1p(spike))
        bounds[1, t + 1] = bounds[1, t] + share * falls
        bounds[2, t + 1] = max(bounds[2, t], spike) if falls else bounds[2, t]
    return bounds


@subroutine
def _keep_possible(block: Block, alive: int, possible: Array) -> int:
    """Bring to the front those of the first `alive` proposals whose `possible` is not negative.

    Returns how many.
    """
    particles, derived, targets, needed, owners, _ = block
    keepers, kept = np.empty(alive, np.int64), 0
    for j in range(alive):
        keepers[kept] = j
        kept += possible[j] >= 0
    for row in range(len(particles)):
        for j in range(kept):
            particles[row, j] = particles[row, keepers[j]]
    for row in range(len(derived)):
        for j in range(kept):
            derived[row, j] = derived[row, keepers[j]]
    for j in range(kept):
        owners[j], targets[j], needed[j] = owners[keepers[j]], targets[keepers[j]], needed[keepers[j]]
    return kept


@subroutine
def _judge(block: Block, alive: int, readings: Array, bounds: Array, model: Model, fused: bool) -> int:
    """Add the log-likelihood of all readings to the targets of the first `alive` proposals.

    Returns how many are accepted, now in front. Readings are evaluated newest first, since the newest is the
    most likely to reject. A proposal is given up early if it cannot reach `needed` even with the best
    possible likelihood of the remaining readings (`_bounds`). This changes no decision.
    """
    particles, derived, targets, needed, _, scratch = block
    means, densities, log_factors, possible = scratch[0], scratch[1], scratch[2], scratch[3]
    fresh, squares = scratch[4], scratch[5]  # of readings that are not fused
    plain = is_plain(model.priors)
    last = len(readings) - 1
    back = next_check = 0
    while back <= last and alive > 0:
        t = newest = last - back
        share = readings[t, 6]
        if fused and share == 1.0:
            while t > 0 and last - t < next_check and newest - t + 1 < FUSED and readings[t - 1, 6] == 1.0:
                t -= 1
            add_place_densities(particles, alive, readings[t : newest + 1], model, scratch[4:], targets)
        else:
            reading_densities(particles, derived, alive, readings[t], model, means, fresh, squares, densities)
            for j in range(alive):
                targets[j] += share * densities[j]
        back = last - t + 1
        if back > next_check or t == 0:
            next_check = 2 * back - 1
            if not plain:
                for j in range(alive):
                    log_factors[j] = log(1 / math.sqrt(derived[NOISES, j]) + bounds[2, t])
            for j in range(alive):
                possible[j] = targets[j] + bounds[0, t] + bounds[1, t] * log_factors[j] - needed[j]
            alive = _keep_possible(block, alive, possible)
    return alive


@subroutine
def _accept(
    particles: Array, log_targets: Array, proposals: Array, needed: Array, readings: Array, model: Model
) -> int:
    """Move each particle to its proposal (D, N) if that one's log target reaches `needed`.

    Returns how many moved.
    """
    rows, count = particles.shape
    bounds, fused = _bounds(readings, model), is_fused(readings, model)
    few, derived, scratch = np.empty((rows, BLOCK)), derived_of(BLOCK, model), np.zeros((8, BLOCK))
    owners, targets, thresholds = np.empty(BLOCK, np.int64), np.empty(BLOCK), np.empty(BLOCK)
    block, accepted = Block(few, derived, targets, thresholds, owners, scratch), 0
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        for row in range(rows):
            for j in range(size):
                few[row, j] = proposals[row, first + j]
        for j in range(size):
            owners[j], thresholds[j] = first + j, needed[first + j]
        fill_log_priors(few, size, model, targets)
        if len(derived):
            derive(few, size, model.unknowns, model.priors, derived)
        size = _judge(block, size, readings, bounds, model, fused)
        for j in range(size):
            for row in range(rows):
                particles[row, owners[j]] = few[row, j]
            log_targets[owners[j]] = targets[j]
        accepted += size
    return accepted


@kernel(
    numba.int64(
        *(numba.float64[:, ::1], numba.float64[::1], numba.float64[:, ::1], MODEL),
        *(numba.int64, numba.uint64, numba.int64),
    )
)
def move(
    particles: Array, log_targets: Array, readings: Array, model: Model, sweeps: int, seed: int, stage: int
) -> int:
    """Move the particles (D, N) by Metropolis–Hastings sweeps.

    They leave the posterior given all readings (T, 7) invariant. They end when enough moves have been
    accepted, or after `sweeps`. Random numbers are keyed by the seed, the number of readings and the stage.
    log_targets: (N,) log posterior density of each particle up to a constant.  Returns the number of accepted
    moves.
    """
    rows, count = particles.shape
    step, unknowns = len(readings) - 1, model.unknowns
    only_place = rows == 2 and unknowns[1] == Y
    pool, proposals, needed = particles.copy(), np.empty((rows, count)), np.empty(count)
    for row in range(rows):
        if model.priors[unknowns[row], 0] == LOGNORMAL:
            for i in range(count):
                pool[row, i] = log(pool[row, i])
    accepted, done, circle = 0, 0.0, False
    for unknown in unknowns:
        circle = circle or _is_circle(unknown, model)
    in_blocks = rows > 3 and unknowns[0] <= Y
    enough_draws = ENOUGH_DRAWS if rows <= 3 else ENOUGH_DRAWS_OF_MANY
    enough_steps = ENOUGH_PLACES if only_place else ENOUGH_STEPS_ALONE if circle else ENOUGH_STEPS
    for sweep in range(sweeps):
        key = key_of(seed, step, stage, 2 * sweep + 2)
        for i in range(count):
            needed[i] = log_targets[i] + log(uniform(key, i))
        key = key_of(seed, step, stage, 2 * sweep + 1)
        draws = not (only_place or circle) and sweep % 3 == 0
        if only_place and sweep == 0:
            _propose_places(particles, key, proposals, needed)
        elif draws:
            _propose_draws(particles, pool, model, key, proposals, needed)
        else:
            block = sweep % 3 if in_blocks else EVERYTHING
            _propose_steps(particles, pool, model, block, key, proposals)
        _refuse_outside(proposals, model, needed)
        moved = _accept(particles, log_targets, proposals, needed, readings, model)
        accepted += moved
        done += moved / (enough_draws if draws else enough_steps)
        if done >= count and not draws:  # draws leave most particles where they are: steps follow
            break
    return accepted
