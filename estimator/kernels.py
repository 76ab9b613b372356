"""The filter's fused loops over particles, compiled by numba and cached; plume/ has the readable formulas, a test holds them equal.

A reading is a row (x, y, wind_x, wind_y, gas); the model is (rate, diffusivity, lifetime, area side).
Plain IEEE arithmetic in a fixed order (no fastmath, no threads): the same bits on every run.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from plume.dispersion import SOURCE_RADIUS_M
from plume.sensor import ENVIRONMENT_NOISE, SENSOR_NOISE

Array = NDArray[np.float64]
NOISE_FLOOR = ENVIRONMENT_NOISE**2
NOISE_SLOPE = SENSOR_NOISE**2
HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
LOG_DENSITY_BOUND = -0.5 * math.log(NOISE_FLOOR) - HALF_LOG_2PI


@numba.njit("float64(float64, float64, float64[::1], float64, float64, float64, float64)", cache=True)
def _log_likelihood(x: float, y: float, reading: Array, scale: float, inverse_length: float, drift_x: float, drift_y: float) -> float:
    """Log-likelihood of one reading for a source at (x, y), given the factors of the plume that do not depend on it."""
    dx = reading[0] - x
    dy = reading[1] - y
    distance = max(math.sqrt(dx * dx + dy * dy), SOURCE_RADIUS_M)
    mean = scale / distance * math.exp(-distance * inverse_length - (dx * drift_x + dy * drift_y))
    variance = NOISE_SLOPE * mean * mean + NOISE_FLOOR
    residual = reading[4] - mean
    log_density: float = -0.5 * (residual * residual / variance + math.log(variance)) - HALF_LOG_2PI
    return log_density


@numba.njit("UniTuple(float64, 4)(float64[::1], float64[::1])", cache=True)
def _plume_factors(reading: Array, model: Array) -> tuple[float, float, float, float]:
    """q/(4π d), 1/λ, and the wind over 2d."""
    rate, diffusivity, lifetime = model[0], model[1], model[2]
    speed_squared = reading[2] * reading[2] + reading[3] * reading[3]
    inverse_length = math.sqrt((1 + speed_squared * lifetime / (4 * diffusivity)) / (diffusivity * lifetime))
    return rate / (4 * math.pi * diffusivity), inverse_length, reading[2] / (2 * diffusivity), reading[3] / (2 * diffusivity)


@numba.njit("float64[::1](float64[:, ::1], float64[::1], float64[::1])", cache=True)
def log_likelihoods(particles: Array, reading: Array, model: Array) -> Array:
    """Log-likelihood of one reading for each particle (N, 2)."""
    scale, inverse_length, drift_x, drift_y = _plume_factors(reading, model)
    result = np.empty(len(particles))
    for i in range(len(particles)):
        result[i] = _log_likelihood(particles[i, 0], particles[i, 1], reading, scale, inverse_length, drift_x, drift_y)
    return result


@numba.njit("float64(float64[::1])", cache=True)
def effective_sample_size(log_weights: Array) -> float:
    """1 / Σ w² of the normalised weights."""
    highest = log_weights.max()
    total = 0.0
    total_squared = 0.0
    for i in range(len(log_weights)):
        weight = math.exp(log_weights[i] - highest)
        total += weight
        total_squared += weight * weight
    return total * total / total_squared


@numba.njit("float64[::1](float64[::1])", cache=True)
def normalised(log_weights: Array) -> Array:
    """Weights that sum to one."""
    highest = log_weights.max()
    weights = np.empty(len(log_weights))
    total = 0.0
    for i in range(len(log_weights)):
        weights[i] = math.exp(log_weights[i] - highest)
        total += weights[i]
    for i in range(len(log_weights)):
        weights[i] /= total
    return weights


@numba.njit("UniTuple(float64, 5)(float64[:, ::1], float64[::1])", cache=True)
def moments(particles: Array, weights: Array) -> tuple[float, float, float, float, float]:
    """Weighted mean and covariance of particles (N, 2): (x, y, xx, xy, yy)."""
    mean_x = 0.0
    mean_y = 0.0
    for i in range(len(particles)):
        mean_x += weights[i] * particles[i, 0]
        mean_y += weights[i] * particles[i, 1]
    xx = 0.0
    xy = 0.0
    yy = 0.0
    for i in range(len(particles)):
        dx = particles[i, 0] - mean_x
        dy = particles[i, 1] - mean_y
        xx += weights[i] * dx * dx
        xy += weights[i] * dx * dy
        yy += weights[i] * dy * dy
    return mean_x, mean_y, xx, xy, yy


@numba.njit("int64[::1](float64[::1], float64)", cache=True)
def systematic(weights: Array, offset: float) -> NDArray[np.int64]:
    """Systematic resampling: ancestor k is where the cumulative weight passes (k + offset) / N, offset in [0, 1)."""
    count = len(weights)
    ancestors = np.empty(count, np.int64)
    ancestor = 0
    cumulative = weights[0]
    for k in range(count):
        while cumulative * count <= k + offset and ancestor < count - 1:
            ancestor += 1
            cumulative += weights[ancestor]
        ancestors[k] = ancestor
    return ancestors


@numba.njit(
    "float64(float64[:, ::1], float64[::1], float64[:, ::1], float64, float64[::1], float64[:, :, ::1], float64[:, ::1])", cache=True
)
def metropolis(
    particles: Array, log_targets: Array, readings: Array, last_exponent: float, model: Array, steps: Array, log_uniforms: Array
) -> float:
    """Metropolis–Hastings sweeps, in place, that leave the posterior given all readings (T, 5) invariant; returns the acceptance rate.

    steps: (sweeps, N, 2) symmetric proposal steps, m.  log_uniforms: (sweeps, N).  The last reading's likelihood is raised to
    `last_exponent`.  log_targets: log posterior of each particle up to a constant.  The prior is uniform over the area.
    """
    count = len(particles)
    last = len(readings) - 1
    factors = np.empty((len(readings), 4))
    for t in range(len(readings)):
        factors[t] = _plume_factors(readings[t], model)
    side = model[3]
    accepted = 0
    for sweep in range(len(steps)):
        for i in range(count):
            x = particles[i, 0] + steps[sweep, i, 0]
            y = particles[i, 1] + steps[sweep, i, 1]
            if not (0.0 <= x <= side and 0.0 <= y <= side):
                continue
            needed = log_targets[i] + log_uniforms[sweep, i]
            # Newest first: it is the likeliest to reject. No reading can add more than the log density at the noise floor,
            # so a proposal that cannot reach what is needed any more is given up early; that changes no decision.
            best_left = last * LOG_DENSITY_BOUND
            target = last_exponent * _log_likelihood(
                x, y, readings[last], factors[last, 0], factors[last, 1], factors[last, 2], factors[last, 3]
            )
            for t in range(last - 1, -1, -1):
                if target + best_left < needed:
                    break
                target += _log_likelihood(x, y, readings[t], factors[t, 0], factors[t, 1], factors[t, 2], factors[t, 3])
                best_left -= LOG_DENSITY_BOUND
            else:
                if target >= needed:
                    particles[i, 0] = x
                    particles[i, 1] = y
                    log_targets[i] = target
                    accepted += 1
    return accepted / (len(steps) * count)
