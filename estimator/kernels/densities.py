"""Log-likelihoods of gas values as defined in `plume/sensor.py`, and log prior densities."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from plume.compiled import kernel
from plume.kernels import DERIVED, derive, derived_means, is_location_only, location_means
from plume.numerics import log
from plume.parameters import GAMMA, NORMAL
from plume.sensor import HITS_KIND, THRESHOLD_KIND

Array = NDArray[np.float64]

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


@numba.njit(error_model="numpy")
def normal_cdf(value: float) -> float:
    """P(Z ≤ value) of a standard normal variable."""
    return 0.5 * math.erfc(-value * math.sqrt(0.5))


@numba.njit(error_model="numpy")
def log_densities_of(means: Array, count: int, gas: float, sensor: Array, result: Array) -> None:
    """Fill `result` with the log-likelihood of a gas value for each mean, as `log_likelihood` in plume/sensor.py."""
    if sensor[0] == HITS_KIND:
        constant = math.lgamma(gas + 1.0)
        for i in range(count):
            expected = sensor[1] * means[i] + sensor[2]
            result[i] = gas * log(expected) - expected - constant
        return
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        for i in range(count):
            std = math.sqrt((sensor[1] * means[i]) ** 2 + sensor[2] * sensor[2])
            below = normal_cdf((sensor[3] - means[i]) / std)
            result[i] = log(max(sensor[4] + (1 - sensor[4]) * below, 1e-300))
        return
    constant = HALF_LOG_2PI - (math.log1p(-sensor[4]) if sensor[0] == THRESHOLD_KIND else 0.0)
    slope, floor = sensor[1] * sensor[1], sensor[2] * sensor[2]
    for i in range(count):
        variance = slope * means[i] * means[i] + floor
        residual = gas - means[i]
        result[i] = -0.5 * (residual * residual / variance + log(variance)) - constant


@numba.njit(error_model="numpy")
def greatest_log_density(gas: float, sensor: Array) -> float:
    """Return an upper bound of the log-likelihood of this gas value, whatever the mean."""
    if sensor[0] == HITS_KIND:
        return gas * math.log(gas) - gas - math.lgamma(gas + 1.0) + 1e-9 if gas > 0 else 0.0
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return 0.0
    return -math.log(sensor[2]) - HALF_LOG_2PI


@kernel("float64[::1](float64[:, ::1], int64[::1], float64[:, ::1], float64[::1], float64[::1])")
def log_likelihoods(particles: Array, unknowns: NDArray[np.int64], priors: Array, sensor: Array, reading: Array) -> Array:
    """Log-likelihood of one reading (7,) under each particle: (N,)."""
    count = particles.shape[1]
    means, result = np.empty(count), np.empty(count)
    if is_location_only(unknowns, priors):
        location_means(particles, count, reading, priors, means)
    else:
        derived = np.empty((DERIVED, count))
        derive(particles, count, unknowns, priors, derived)
        derived_means(derived, count, reading, priors, means)
    log_densities_of(means, count, reading[5], sensor, result)
    return result


@numba.njit(error_model="numpy")
def log_prior(particles: Array, i: int, unknowns: NDArray[np.int64], priors: Array) -> float:
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


@kernel("float64[::1](float64[:, ::1], int64[::1], float64[:, ::1])")
def log_priors(particles: Array, unknowns: NDArray[np.int64], priors: Array) -> Array:
    """Log prior density of each particle up to a constant: (N,)."""
    result = np.empty(particles.shape[1])
    for i in range(len(result)):
        result[i] = log_prior(particles, i, unknowns, priors)
    return result
