"""Log-likelihoods of gas values as defined in `plume/sensor.py`, and log prior densities."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from plume.compiled import kernel
from plume.intermittency import HALF_LOG_2PI, log_density
from plume.kernels import CVS, DERIVED, NOISES, derive, derived_means, is_location_only, is_plain, location_means
from plume.numerics import log
from plume.parameters import CV, GAMMA, KNOWN, LOGNORMAL, NORMAL
from plume.sensor import HITS_KIND, THRESHOLD_KIND

Array = NDArray[np.float64]


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
def noisy_log_densities_of(means: Array, count: int, gas: float, sensor: Array, derived: Array, intermittent: bool, result: Array) -> None:
    """Do the same where the sensor's noise, or the gas's intermittency, differs between the columns of `derived`."""
    slope, floor = sensor[1] * sensor[1], sensor[2] * sensor[2]
    if intermittent:
        for i in range(count):
            result[i] = log_density(gas, means[i], derived[NOISES, i] * (slope * means[i] * means[i] + floor), derived[CVS, i])
    elif sensor[0] == THRESHOLD_KIND and gas == 0.0:
        for i in range(count):
            std = math.sqrt(derived[NOISES, i] * (slope * means[i] * means[i] + floor))
            result[i] = log(max(sensor[4] + (1 - sensor[4]) * normal_cdf((sensor[3] - means[i]) / std), 1e-300))
    else:
        constant = HALF_LOG_2PI - (math.log1p(-sensor[4]) if sensor[0] == THRESHOLD_KIND else 0.0)
        for i in range(count):
            variance = derived[NOISES, i] * (slope * means[i] * means[i] + floor)
            residual = gas - means[i]
            result[i] = -0.5 * (residual * residual / variance + log(variance)) - constant


@numba.njit(error_model="numpy")
def is_intermittent(priors: Array) -> bool:
    """True if the gas is not taken to be steady."""
    intermittent: bool = priors[CV, 0] != KNOWN or priors[CV, 1] != 0
    return intermittent


@numba.njit(error_model="numpy")
def reading_densities(
    particles: Array, derived: Array, count: int, reading: Array, priors: Array, sensor: Array, means: Array, result: Array
) -> None:
    """Fill `means` and `result` (count,) with the concentration and the log-likelihood of one reading under each particle.

    derived: columns that `derive` filled; empty if only the location is unknown.
    """
    if len(derived) == 0:
        location_means(particles, count, reading, priors, means)
    else:
        derived_means(derived, count, reading, priors, means)
    if is_plain(priors) or sensor[0] == HITS_KIND:
        log_densities_of(means, count, reading[5], sensor, result)
    else:
        noisy_log_densities_of(means, count, reading[5], sensor, derived, is_intermittent(priors), result)


@numba.njit(error_model="numpy")
def is_a_normal_density(gas: float, sensor: Array) -> bool:
    """True if the likelihood of this gas value is a density, which noise widens and so lowers; false if it is a probability."""
    normal: bool = sensor[0] != HITS_KIND and (sensor[0] != THRESHOLD_KIND or gas != 0.0)
    return normal


@numba.njit(error_model="numpy")
def greatest_log_density(gas: float, sensor: Array, priors: Array) -> float:
    """Return an upper bound of the log-likelihood of this gas value, whatever the mean, for a noise factor of 1.

    If the gas is steady and the noise known, the bound falls with the reading: a strong reading needs a large mean, and so much noise.
    """
    if sensor[0] == HITS_KIND:
        return gas * math.log(gas) - gas - math.lgamma(gas + 1.0) + 1e-9 if gas > 0 else 0.0
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return 0.0
    slope, floor = sensor[1] * sensor[1], sensor[2] * sensor[2]
    if gas <= 0 or not is_plain(priors):
        return -0.5 * math.log(floor) - HALF_LOG_2PI
    best = -0.5 * math.log(slope * gas * gas + floor)  # of means above the reading
    for cell in range(20):  # of means in twentieths of the reading: the least distance with the best variances
        low, high = cell / 20 * gas, (cell + 1) / 20 * gas
        best = max(best, -0.5 * ((gas - high) ** 2 / (slope * high * high + floor) + math.log(slope * low * low + floor)))
    return best - HALF_LOG_2PI


@kernel("float64[::1](float64[:, ::1], int64[::1], float64[:, ::1], float64[::1], float64[::1])")
def log_likelihoods(particles: Array, unknowns: NDArray[np.int64], priors: Array, sensor: Array, reading: Array) -> Array:
    """Log-likelihood of one reading (7,) under each particle: (N,)."""
    count = particles.shape[1]
    means, result = np.empty(count), np.empty(count)
    derived = np.empty((0 if is_location_only(unknowns, priors) else DERIVED, count))
    if len(derived):
        derive(particles, count, unknowns, priors, derived)
    reading_densities(particles, derived, count, reading, priors, sensor, means, result)
    return result


@numba.njit(error_model="numpy")
def log_prior(particles: Array, i: int, unknowns: NDArray[np.int64], priors: Array) -> float:
    """Log prior density of particle i up to a constant; of a log-normal parameter, the density of its logarithm."""
    total = 0.0
    for row in range(len(unknowns)):
        kind, a, b = priors[unknowns[row], 0], priors[unknowns[row], 1], priors[unknowns[row], 2]
        value = particles[row, i]
        if kind == NORMAL:
            total -= 0.5 * ((value - a) / b) ** 2
        elif kind == GAMMA:
            total += (a - 1) * log(value) - value / b
        elif kind == LOGNORMAL:
            total -= 0.5 * ((log(value) - a) / b) ** 2
    return total


@kernel("float64[::1](float64[:, ::1], int64[::1], float64[:, ::1])")
def log_priors(particles: Array, unknowns: NDArray[np.int64], priors: Array) -> Array:
    """Log prior density of each particle up to a constant: (N,)."""
    result = np.empty(particles.shape[1])
    for i in range(len(result)):
        result[i] = log_prior(particles, i, unknowns, priors)
    return result
