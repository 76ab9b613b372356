"""The filter's fused loops over particles, compiled by numba and cached; plume/ has the readable formulas, tests hold them equal.

Plain IEEE arithmetic in a fixed order, exp and log included: no fastmath, no threads, no libm but for angles and rare sensors. A
mission's numbers are therefore the same bits alone or in a batch, on any number of threads. Loops are simple so that LLVM turns
them into vector instructions.

particles: (D, N), a row for each unknown.  unknowns: (D,) indices into x, y, z, q, u, φ, d, τ.
priors: (8, 5) rows of kind, a, b and the support's ends.  sensor: (5,) kind and numbers.  readings: (T, 7) rows of x, y,
height above the source's plane or home, wind_x, wind_y, gas, share: the exponent that the reading's likelihood is taken to.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from estimator.priors import GAMMA, MEASURED, NORMAL
from plume.dispersion import SOURCE_RADIUS_M
from plume.numerics import exp, log, total_of

Array = NDArray[np.float64]

X, Y, Z, Q, U, PHI, D, TAU = range(8)
GAUSSIAN, THRESHOLD, HITS = 0.0, 1.0, 2.0

RESAMPLE_BELOW = 0.5
"""Share of N that the effective sample size must keep."""
STAGE_FLOOR = 0.4
"""Where one reading would crush the effective sample size below this share of N, it is taken in tempered stages."""
MAX_STAGES = 40
"""After so many stages the rest of a reading is left out for good: no reading, however absurd, may crush the cloud to a point."""
CHECK_PARTICLES = 1000
"""So many particles, evenly spaced, stand for all in the predictive check of a reading."""

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
DERIVED = 9
"""Rows that the plume needs of a particle: x, y, z, q/(4π d), 1/(2d), 1/(d τ), u, cos φ, sin φ."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_ONE = np.uint64(0xBF58476D1CE4E5B9)
MIX_TWO = np.uint64(0x94D049BB133111EB)


@numba.njit(error_model="numpy")
def _mix(word: np.uint64) -> np.uint64:
    """SplitMix64's finaliser (Steele et al. 2014)."""
    word = (word ^ (word >> np.uint64(30))) * MIX_ONE
    word = (word ^ (word >> np.uint64(27))) * MIX_TWO
    return word ^ (word >> np.uint64(31))


@numba.njit(error_model="numpy")
def _key(seed: int, step: int, stage: int, stream: int) -> np.uint64:
    """Where the SplitMix64 sequence of one (seed, step, stage, stream) begins."""
    word = _mix(seed + GOLDEN)
    word = _mix(word ^ (np.uint64(step) + np.uint64(1)) * GOLDEN)
    return _mix(word ^ (np.uint64(stage * 1024 + stream) + np.uint64(1)) * GOLDEN)


@numba.njit(error_model="numpy")
def _word(key: np.uint64, index: int) -> np.uint64:
    """Draw number `index` of a sequence: 64 bits."""
    return _mix(key + (np.uint64(index) + np.uint64(1)) * GOLDEN)


@numba.njit(error_model="numpy")
def _uniform(key: np.uint64, index: int) -> float:
    """Draw number `index` of a sequence, uniform in (0, 1)."""
    return (float(_word(key, index) >> np.uint64(12)) + 0.5) * 2.0**-52


@numba.njit("uint64(uint64, int64)", cache=True)
def uniform_key(seed: int, step: int) -> np.uint64:
    """Return the key that `update` draws with at a step; for tests of the generator."""
    return _key(seed, step, 0, 0)


@numba.njit("float64[::1](uint64, int64)", cache=True)
def uniforms(key: np.uint64, count: int) -> Array:
    """Return the first draws of a sequence; for tests of the generator."""
    result = np.empty(count)
    for i in range(count):
        result[i] = _uniform(key, i)
    return result


@numba.njit("float64[:, ::1](float64[::1])", cache=True)
def exp_and_log(values: Array) -> Array:
    """Return e^v and ln v as the kernels compute them; for tests."""
    result = np.empty((2, len(values)))
    for i in range(len(values)):
        result[0, i] = exp(values[i])
        result[1, i] = log(abs(values[i]))
    return result


@numba.njit(error_model="numpy")
def _only_location(unknowns: NDArray[np.int64], priors: Array) -> bool:
    """Whether x and y alone are unknown and the wind is measured: the paper's case, which has a faster loop."""
    return len(unknowns) == 2 and unknowns[0] == X and unknowns[1] == Y and priors[U, 0] == MEASURED and priors[PHI, 0] == MEASURED


@numba.njit(error_model="numpy")
def _location_means(particles: Array, count: int, reading: Array, priors: Array, means: Array) -> None:
    """Concentration where the reading was taken for sources at particles (2, count), all else known."""
    diffusivity, lifetime = priors[D, 1], priors[TAU, 1]
    wind_x, wind_y = reading[3], reading[4]
    inverse_length = math.sqrt(1 / (diffusivity * lifetime) + (wind_x * wind_x + wind_y * wind_y) / (4 * diffusivity * diffusivity))
    scale = priors[Q, 1] / (4 * math.pi * diffusivity)
    drift_x, drift_y = wind_x / (2 * diffusivity), wind_y / (2 * diffusivity)
    x, y = reading[0], reading[1]
    dz = reading[2] - priors[Z, 1]
    dz_squared = dz * dz
    for i in range(count):
        dx = x - particles[0, i]
        dy = y - particles[1, i]
        distance = max(math.sqrt(dx * dx + dy * dy + dz_squared), SOURCE_RADIUS_M)
        means[i] = scale / distance * exp(-distance * inverse_length - (dx * drift_x + dy * drift_y))


@numba.njit(error_model="numpy")
def _derive(particles: Array, count: int, unknowns: NDArray[np.int64], priors: Array, derived: Array) -> None:
    """Fill `derived` (DERIVED, count) from particles (D, count) and what is known."""
    values = np.empty(8)
    values[:] = priors[:, 1]
    for i in range(count):
        for row in range(len(unknowns)):
            values[unknowns[row]] = particles[row, i]
        derived[0, i] = values[X]
        derived[1, i] = values[Y]
        derived[2, i] = values[Z]
        derived[3, i] = values[Q] / (4 * math.pi * values[D])
        derived[4, i] = 0.5 / values[D]
        derived[5, i] = 1 / (values[D] * values[TAU])
        derived[6, i] = values[U]
        derived[7, i] = math.cos(values[PHI])
        derived[8, i] = math.sin(values[PHI])


@numba.njit(error_model="numpy")
def _derived_means(derived: Array, count: int, reading: Array, priors: Array, means: Array) -> None:
    """Concentration where the reading was taken for each column of `derived`; wind that is measured comes from the reading."""
    x, y, height = reading[0], reading[1], reading[2]
    speed_measured, direction_measured = priors[U, 0] == MEASURED, priors[PHI, 0] == MEASURED
    speed = math.sqrt(reading[3] * reading[3] + reading[4] * reading[4])
    cosine, sine = (reading[3] / speed, reading[4] / speed) if speed > 0 else (1.0, 0.0)
    for i in range(count):
        u = speed if speed_measured else derived[6, i]
        c = cosine if direction_measured else derived[7, i]
        s = sine if direction_measured else derived[8, i]
        dx = x - derived[0, i]
        dy = y - derived[1, i]
        dz = height - derived[2, i]
        distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), SOURCE_RADIUS_M)
        drift = u * derived[4, i]
        inverse_length = math.sqrt(derived[5, i] + drift * drift)
        means[i] = derived[3, i] / distance * exp(-distance * inverse_length - drift * (dx * c + dy * s))


@numba.njit(error_model="numpy")
def _normal_cdf(value: float) -> float:
    return 0.5 * math.erfc(-value * math.sqrt(0.5))


@numba.njit(error_model="numpy")
def _log_densities(means: Array, count: int, gas: float, sensor: Array, result: Array) -> None:
    """Log-likelihood of a gas value for each mean: the log_likelihood of plume/sensor.py."""
    if sensor[0] == HITS:
        constant = math.lgamma(gas + 1.0)
        for i in range(count):
            expected = sensor[1] * means[i] + sensor[2]
            result[i] = gas * log(expected) - expected - constant
        return
    if sensor[0] == THRESHOLD and gas == 0.0:
        for i in range(count):
            std = math.sqrt((sensor[1] * means[i]) ** 2 + sensor[2] * sensor[2])
            below = _normal_cdf((sensor[3] - means[i]) / std)
            result[i] = log(max(sensor[4] + (1 - sensor[4]) * below, 1e-300))
        return
    constant = HALF_LOG_2PI - (math.log1p(-sensor[4]) if sensor[0] == THRESHOLD else 0.0)
    slope, floor = sensor[1] * sensor[1], sensor[2] * sensor[2]
    for i in range(count):
        variance = slope * means[i] * means[i] + floor
        residual = gas - means[i]
        result[i] = -0.5 * (residual * residual / variance + log(variance)) - constant


@numba.njit(error_model="numpy")
def _greatest_log_density(gas: float, sensor: Array) -> float:
    """Return what no log-likelihood of this gas value can exceed."""
    if sensor[0] == HITS:
        return gas * math.log(gas) - gas - math.lgamma(gas + 1.0) + 1e-9 if gas > 0 else 0.0
    if sensor[0] == THRESHOLD and gas == 0.0:
        return 0.0
    return -math.log(sensor[2]) - HALF_LOG_2PI


@numba.njit("float64[::1](float64[:, ::1], int64[::1], float64[:, ::1], float64[::1], float64[::1])", cache=True)
def log_likelihoods(particles: Array, unknowns: NDArray[np.int64], priors: Array, sensor: Array, reading: Array) -> Array:
    """Log-likelihood of one reading for each particle: (N,)."""
    count = particles.shape[1]
    means, result = np.empty(count), np.empty(count)
    if _only_location(unknowns, priors):
        _location_means(particles, count, reading, priors, means)
    else:
        derived = np.empty((DERIVED, count))
        _derive(particles, count, unknowns, priors, derived)
        _derived_means(derived, count, reading, priors, means)
    _log_densities(means, count, reading[5], sensor, result)
    return result


@numba.njit("float64[:, ::1](float64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1])", cache=True, nogil=True)
def mean_concentrations(particles: Array, unknowns: NDArray[np.int64], priors: Array, readings: Array) -> Array:
    """Concentration under each particle where each reading (A, 5 or more) is taken: (A, N)."""
    count = particles.shape[1]
    result = np.empty((len(readings), count))
    only_location = _only_location(unknowns, priors)
    derived = np.empty((0 if only_location else DERIVED, count))
    if not only_location:
        _derive(particles, count, unknowns, priors, derived)
    for a in range(len(readings)):
        if only_location:
            _location_means(particles, count, readings[a], priors, result[a])
        else:
            _derived_means(derived, count, readings[a], priors, result[a])
    return result


@numba.njit(error_model="numpy")
def _gaussian_tails(means: Array, gas: float, slope: float, floor: float, result: Array) -> None:
    """P(Z ≤ gas) for each mean, to 1.5e-7 (Abramowitz and Stegun 7.1.26)."""
    for i in range(len(means)):
        residual = gas - means[i]
        half_square = 0.5 * residual * residual / (slope * means[i] * means[i] + floor)
        t = 1 / (1 + 0.3275911 * math.sqrt(half_square))
        p = t * 1.061405429 - 1.453152027
        p = p * t + 1.421413741
        p = p * t - 0.284496736
        p = p * t + 0.254829592
        tail = 0.5 * p * t * exp(-half_square)
        result[i] = 1 - tail if residual > 0 else tail


@numba.njit(error_model="numpy")
def _hits_cdf(count: float, expected: float) -> float:
    """P(K ≤ count) of a Poisson count; beyond 100 by Wilson and Hilferty's cube root."""
    if count < 0:
        return 0.0
    if count > 100:
        k = count + 1
        return _normal_cdf(3 * math.sqrt(k) * (1 - 1 / (9 * k) - (expected / k) ** (1 / 3)))
    term = math.exp(-expected)
    total = term
    for k in range(1, int(count) + 1):
        term *= expected / k
        total += term
    return min(total, 1.0)


@numba.njit(error_model="numpy")
def _predictive_rank(means: Array, weights: Array, gas: float, sensor: Array, chance: float) -> float:
    """Return how far up its predictive distribution a reading lies: uniform in (0, 1) where the model is right (Dawid 1984).

    means, weights: of particles before the reading.  chance: uniform in (0, 1); breaks ties of discrete readings.
    """
    count = len(means)
    share, total = 0.0, 0.0
    if sensor[0] == GAUSSIAN:
        tails = np.empty(count)
        _gaussian_tails(means, gas, sensor[1] * sensor[1], sensor[2] * sensor[2], tails)
        for i in range(count):
            share += weights[i] * tails[i]
            total += weights[i]
        return share / total
    for i in range(count):
        if sensor[0] == HITS:
            expected = sensor[1] * means[i] + sensor[2]
            below = _hits_cdf(gas - 1, expected)
            tail = below + chance * (_hits_cdf(gas, expected) - below)
        else:
            std = math.sqrt((sensor[1] * means[i]) ** 2 + sensor[2] * sensor[2])
            tail = sensor[4] + (1 - sensor[4]) * _normal_cdf((max(gas, sensor[3]) - means[i]) / std)
            if gas == 0.0:
                tail *= chance
        share += weights[i] * tail
        total += weights[i]
    return share / total


@numba.njit(error_model="numpy")
def _dot(one: Array, other: Array) -> float:
    """Σ one · other, summed as `total_of` does."""
    a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    whole = len(one) - len(one) % 8
    for i in range(0, whole, 8):
        a += one[i] * other[i]
        b += one[i + 1] * other[i + 1]
        c += one[i + 2] * other[i + 2]
        d += one[i + 3] * other[i + 3]
        e += one[i + 4] * other[i + 4]
        f += one[i + 5] * other[i + 5]
        g += one[i + 6] * other[i + 6]
        h += one[i + 7] * other[i + 7]
    for i in range(whole, len(one)):
        a += one[i] * other[i]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@numba.njit(error_model="numpy")
def _greatest(values: Array) -> float:
    a, b, c, d = values[0], values[0], values[0], values[0]
    whole = len(values) - len(values) % 4
    for i in range(0, whole, 4):
        a = max(a, values[i])
        b = max(b, values[i + 1])
        c = max(c, values[i + 2])
        d = max(d, values[i + 3])
    for i in range(whole, len(values)):
        a = max(a, values[i])
    greatest: float = max(max(a, b), max(c, d))
    return greatest


@numba.njit(error_model="numpy")
def _weigh(log_weights: Array, share: float, log_densities: Array, weights: Array) -> float:
    """Set weights ∝ exp(log_weights + share · log_densities), the greatest 1; returns the effective sample size."""
    for i in range(len(weights)):
        weights[i] = log_weights[i] + share * log_densities[i]
    highest = _greatest(weights)
    for i in range(len(weights)):
        weights[i] = exp(weights[i] - highest)
    total = total_of(weights)
    return total * total / _dot(weights, weights)


@numba.njit("float64(float64[::1])", cache=True)
def effective_sample_size(weights: Array) -> float:
    """(Σ w)² / Σ w² of weights (N,) that need not be normalised."""
    total = total_of(weights)
    return total * total / _dot(weights, weights)


@numba.njit("Tuple((float64[::1], float64[:, ::1]))(float64[:, ::1], float64[::1])", cache=True)
def moments(particles: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (D,) and covariance (D, D) of particles (D, N); the weights need not be normalised."""
    rows, count = particles.shape
    total = total_of(weights)
    mean = np.empty(rows)
    covariance = np.empty((rows, rows))
    offsets = np.empty((rows, count))
    weighted = np.empty(count)
    for row in range(rows):
        mean[row] = _dot(weights, particles[row]) / total
        for i in range(count):
            offsets[row, i] = particles[row, i] - mean[row]
            weighted[i] = weights[i] * offsets[row, i]
        for other in range(row + 1):
            covariance[row, other] = _dot(weighted, offsets[other]) / total
            covariance[other, row] = covariance[row, other]
    return mean, covariance


@numba.njit("int64[::1](float64[::1], float64)", cache=True)
def systematic(weights: Array, offset: float) -> NDArray[np.int64]:
    """Systematic resampling: ancestor k is where the cumulative weight passes (k + offset) / N of the whole, offset in [0, 1)."""
    count = len(weights)
    ancestors = np.empty(count, np.int64)
    scale = count / total_of(weights)
    ancestor = 0
    cumulative = weights[0] * scale
    for k in range(count):
        while cumulative <= k + offset and ancestor < count - 1:
            ancestor += 1
            cumulative += weights[ancestor] * scale
        ancestors[k] = ancestor
    return ancestors


@numba.njit(error_model="numpy")
def _log_prior(particles: Array, i: int, unknowns: NDArray[np.int64], priors: Array) -> float:
    """Log prior density of particle i up to a constant."""
    total = 0.0
    for row in range(len(unknowns)):
        kind, a, b = priors[unknowns[row], 0], priors[unknowns[row], 1], priors[unknowns[row], 2]
        value = particles[row, i]
        if kind == NORMAL:
            total -= 0.5 * ((value - a) / b) ** 2
        elif kind == GAMMA:
            total += (a - 1) * log(value) - value / b
    return total


@numba.njit("float64[::1](float64[:, ::1], int64[::1], float64[:, ::1])", cache=True)
def log_priors(particles: Array, unknowns: NDArray[np.int64], priors: Array) -> Array:
    """Log prior density of each particle up to a constant: (N,)."""
    result = np.empty(particles.shape[1])
    for i in range(len(result)):
        result[i] = _log_prior(particles, i, unknowns, priors)
    return result


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
    """Propose a step for each particle (ter Braak 2006); where it leaves the prior's support, what it needs becomes infinite.

    A step is a scaled difference of two other particles, which follows curved and split posteriors, with a little uniform noise.
    """
    rows, count = particles.shape
    largest = 2.38 / math.sqrt(2.0 * rows)
    ones, others, scales = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    size, low_half, half = np.uint64(count), np.uint64(0xFFFFFFFF), np.uint64(32)
    for i in range(count):
        word = _word(key, 2 * i)
        ones[i] = ((word >> half) * size) >> half
        others[i] = ((word & low_half) * size) >> half
        chance = 3 * _uniform(key, 2 * i + 1)
        scales[i] = largest * (0.7 if chance < 1 else 0.35 if chance < 2 else 0.12)  # finer ones for thin ridges
    for row in range(rows):
        low, high = priors[unknowns[row], 3], priors[unknowns[row], 4]
        first = (2 + row) * count
        for i in range(count):
            noise = 0.17 * (_uniform(key, first + i) - 0.5)
            proposals[row, i] = particles[row, i] + scales[i] * (frozen[row, ones[i]] - frozen[row, others[i]]) + noise * stds[row]
        if unknowns[row] == PHI and high - low == 2 * math.pi:
            for i in range(count):
                proposals[row, i] = low + (proposals[row, i] - low) % (2 * math.pi)
        for i in range(count):
            inside = low <= proposals[row, i] <= high
            needed[i] = needed[i] if inside else np.inf


@numba.njit(
    "int64(float64[:, ::1], float64[::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[::1], uint64, int64, int64, int64)",
    cache=True,
)
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
    """Metropolis–Hastings sweeps, in place, that leave the posterior given all readings invariant; returns how many moves were taken.

    log_targets: log posterior of each particle up to a constant.
    """
    rows, count = particles.shape
    last = len(readings) - 1
    only_location = _only_location(unknowns, priors)
    frozen = particles.copy()
    stds = np.empty(rows)
    for row in range(rows):
        offsets = frozen[row] - total_of(frozen[row]) / count
        stds[row] = math.sqrt(_dot(offsets, offsets) / count)
    best = 0.0
    for t in range(last):
        best += readings[t, 6] * _greatest_log_density(readings[t, 5], sensor)
    proposals = np.empty((rows, count))
    derived = np.empty((0 if only_location else DERIVED, count))
    owners = np.empty(count, np.int64)
    targets, needed, means, densities = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    accepted = 0
    for sweep in range(sweeps):
        key = _key(seed, step, stage, 2 * sweep + 2)
        for i in range(count):
            owners[i] = i
            needed[i] = log_targets[i] + log(_uniform(key, i))
        _propose(particles, frozen, stds, unknowns, priors, _key(seed, step, stage, 2 * sweep + 1), proposals, needed)
        for i in range(count):
            targets[i] = _log_prior(proposals, i, unknowns, priors)
        if not only_location:
            _derive(proposals, count, unknowns, priors, derived)
        # Newest first: it is the likeliest to reject. A proposal that cannot reach what it needs any more, even if all the readings
        # left were explained as well as any can be, is given up; that changes no decision.
        alive = count
        best_left = best
        next_check = 0
        for back in range(last + 1):
            t = last - back
            if only_location:
                _location_means(proposals, alive, readings[t], priors, means)
            else:
                _derived_means(derived, alive, readings[t], priors, means)
            _log_densities(means, alive, readings[t, 5], sensor, densities)
            share = readings[t, 6]
            for j in range(alive):
                targets[j] += share * densities[j]
            if back > 0:
                best_left -= share * _greatest_log_density(readings[t, 5], sensor)
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


@numba.njit(error_model="numpy")
def _tempered_share(log_weights: Array, log_densities: Array, left: float, weights: Array) -> tuple[float, float]:
    """Return the greatest exponent, at most `left`, at which the likelihood leaves about STAGE_FLOOR · N effective particles, and those."""
    floor = STAGE_FLOOR * len(weights)
    size = _weigh(log_weights, left, log_densities, weights)
    if size >= floor:
        return left, size
    low, high = 0.0, left
    for _ in range(60):
        middle = 0.5 * (low + high)
        size = _weigh(log_weights, middle, log_densities, weights)
        if size < floor:
            high = middle
        elif size > 1.2 * floor:
            low = middle
        else:
            return middle, size
    return high, _weigh(log_weights, high, log_densities, weights)


@numba.njit(
    "float64(float64[:, ::1], float64[::1], float64[::1], float64[::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[::1], "
    "uint64, int64)",
    cache=True,
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
    """Assimilate the last of the readings (T, 7), in place, its share included; returns its predictive rank.

    Reweight, and where the weights degenerate, resample and move (Gordon 1993; Chopin 2002); a reading that would crush the weights
    is taken in tempered stages (Del Moral 2006).  weights: exp(log_weights), the greatest 1.
    """
    rows, count = particles.shape
    step = len(readings) - 1
    reading = readings[step]
    only_location = _only_location(unknowns, priors)
    derived = np.empty((0 if only_location else DERIVED, count))
    means, densities = np.empty(count), np.empty(count)
    rank = 0.5
    exponent = 0.0
    stage = 0
    while True:
        if only_location:
            _location_means(particles, count, reading, priors, means)
        else:
            _derive(particles, count, unknowns, priors, derived)
            _derived_means(derived, count, reading, priors, means)
        _log_densities(means, count, reading[5], sensor, densities)
        if stage == 0:
            stride = max(count // CHECK_PARTICLES, 1)
            chance = _uniform(_key(seed, step, 0, 1000), 0)
            rank = _predictive_rank(means[::stride].copy(), weights[::stride].copy(), reading[5], sensor, chance)
        left = 1.0 - exponent
        share, size = _tempered_share(log_weights, densities, left, weights)
        exponent = 1.0 if share >= left else exponent + share
        reading[6] = exponent
        for i in range(count):
            log_weights[i] += share * densities[i]
            log_targets[i] += share * densities[i]
        if size < RESAMPLE_BELOW * count:
            ancestors = systematic(weights, _uniform(_key(seed, step, stage, 0), 0))
            for row in range(rows):
                particles[row] = particles[row][ancestors]
            log_targets[:] = log_targets[ancestors]
            log_weights[:] = 0.0
            weights[:] = 1.0
            metropolis(particles, log_targets, readings, unknowns, priors, sensor, seed, step, stage, sweeps)
            stage += 1
        if exponent == 1.0 or stage == MAX_STAGES:
            return rank


@numba.njit(
    "void(float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], int64[::1], "
    "int64[::1], float64[:, :, ::1], float64[:, ::1], uint64[::1], int64, int64[::1])",
    cache=True,
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
    """Let these missions of a batch assimilate the last of their `counts` readings, each as if alone; arrays as in `update`, stacked."""
    for b in missions:
        count = counts[b]
        ranks[b, count - 1] = update(
            particles[b], log_weights[b], weights[b], log_targets[b], readings[b, :count], unknowns, priors[b], sensors[b], seeds[b], sweeps
        )


@numba.njit(
    "void(float64[:, :, ::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[:, :, ::1])",
    cache=True,
    nogil=True,
)
def moments_of_missions(particles: Array, weights: Array, missions: NDArray[np.int64], means: Array, covariances: Array) -> None:
    """Put the `moments` of these missions of a batch into means (B, D) and covariances (B, D, D)."""
    for b in missions:
        means[b], covariances[b] = moments(particles[b], weights[b])


@numba.njit("float64(float64[::1])", cache=True)
def uniformity_p_value(ranks: Array) -> float:
    """p-value of the Anderson–Darling test that ranks (n ≥ 8,) are uniform in (0, 1) (Marsaglia and Marsaglia 2004)."""
    count = len(ranks)
    ordered = np.sort(ranks)
    total = 0.0
    for i in range(count):
        low = min(max(ordered[i], 1e-15), 1 - 1e-15)
        high = min(max(ordered[count - 1 - i], 1e-15), 1 - 1e-15)
        total += (2 * i + 1) * (math.log(low) + math.log1p(-high))
    z = -count - total / count
    if z > 8:  # beyond the published formula's accuracy: the tail's own shape, joined to it at 8
        return 0.94 * math.exp(-z) / math.sqrt(z)
    if z < 2:
        p = 2.00012 + (0.247105 - (0.0649821 - (0.0347962 - (0.011672 - 0.00168691 * z) * z) * z) * z) * z
        limit = math.exp(-1.2337141 / z) / math.sqrt(z) * p
    else:
        limit = math.exp(-math.exp(1.0776 - (2.30695 - (0.43424 - (0.082433 - (0.008056 - 0.0003146 * z) * z) * z) * z) * z))
    if limit > 0.8:
        g = -130.2137 + (745.2337 - (1705.091 - (1950.646 - (1116.360 - 255.7844 * limit) * limit) * limit) * limit) * limit
        limit += g / count
    else:
        c = 0.01265 + 0.1757 / count
        if limit < c:
            t = limit / c
            t = math.sqrt(t) * (1 - t) * (49 * t - 102)
            limit += t * (0.0037 / count**3 + 0.00078 / count**2 + 0.00006 / count)
        else:
            t = (limit - c) / (0.8 - c)
            t = -0.00022633 + (6.54034 - (14.6538 - (14.458 - (8.259 - 1.91864 * t) * t) * t) * t) * t
            limit += t * (0.04213 / count + 0.01365 / count**2)
    return max(1 - limit, 0.0)
