"""Log-likelihoods of gas values as defined in `plume/sensors/sensor.py`, and log prior densities."""

import math
from functools import partial
from typing import Any, NamedTuple

import numba
import numpy as np

from estimator.kernels.spikes import spike_density
from plume import elementary
from plume.compiled import kernel, subroutine
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array, Indices
from plume.intermittency import ONE_BY_ROOT_2PI, correction, exceeding, parts_of_density
from plume.kernels import (
    DERIVED,
    NOISES,
    derive,
    is_intermittent,
    is_location_only,
    is_plain,
    squares_of_puffs,
)
from plume.numerics import HALF_LOG_2PI, erfc, exp, log, log1p, log_gamma
from plume.parameters import (
    AROUND,
    BEYOND,
    BLANK,
    CLEAN,
    DWELL,
    GAMMA,
    GAUSSIAN_KIND,
    HITS_KIND,
    LOGNORMAL,
    NORMAL,
    RAY,
    SATURATION,
    TAU,
    THRESHOLD_KIND,
    D,
    Q,
    X,
    Y,
    Z,
)
from plume.sensors.response import LEG_SHARES, follow, gas_means, is_direct, kept_of, lags, settle

LOG_BEYOND = float(elementary.log(BEYOND))
FUSED = 8  # readings whose densities are added together: products of 8 variances neither overflow nor vanish


@subroutine
def normal_cdf(value: float) -> float:
    """P(Z ≤ value) of a standard normal variable."""
    return 0.5 * erfc(-value * math.sqrt(0.5))


class Model(NamedTuple):
    """What the filter assumes, as kernels take it."""

    unknowns: Indices  # (D,) indices into `plume.parameters.PARAMETERS`
    priors: Array  # (15, 5): kind, two numbers, and the support's ends of each parameter
    sensor: Array  # (SENSOR_NUMBERS,): kind and numbers
    spikes: Array  # (1,): share of the readings that say nothing of the source
    walls: Array  # (W, 5): sides of polygons in which it is not, or is expected, as `Config.walls`
    densities: Array  # (1 + P,): of the prior of the place in polygons, as `Config.densities`


tuple_type: Any = numba.types.NamedTuple
ROW, TABLE, STACK = numba.float64[::1], numba.float64[:, ::1], numba.float64[:, :, ::1]
MODEL = tuple_type((numba.int64[::1], TABLE, ROW, ROW, TABLE, ROW), Model)


@subroutine
def is_saturated(gas: float, sensor: Array) -> bool:
    """True if the sensor cannot show whether it would read more."""
    return bool(gas >= sensor[SATURATION])


@partial(subroutine, forceinline=True)
def parts_of_gas(
    mean: float, fresh: float, noise: float, square: float, slope: float, floor: float
) -> tuple[float, float, float, float, float]:
    """Return what a reading is made of in intermittent gas, as `plume.sensors.sensor.fluctuating` does.

    They are the probability of a blank, the variance of its noise, the mean and the squared cv of the gas
    where there is some, its noise with it, and the variance of the noise that does not go with it.
    noise: the square of its factor.  square: of the cv of all the gas.  slope, floor: α² and β².
    """
    slope, floor = noise * slope, noise * floor
    blank, of_gas = BLANK * square / (1 + square), (1 - BLANK) * square
    gas = fresh / (1 - blank)
    older = mean - fresh
    steady = slope / max(slope + of_gas, 1e-300)
    with_gas = slope * (older * older + 2 * older * gas + steady * gas * gas) + floor
    return blank, slope * mean * mean + floor, gas, of_gas * (1 + slope + steady), with_gas


@subroutine
def gas_densities(
    means: Array,
    fresh: Array,
    noises: Array,
    squares: Array,
    count: int,
    gas: float,
    slope: float,
    floor: float,
    result: Array,
) -> None:
    """Fill `result` with the density of a reading in intermittent gas, made of what `parts_of_gas` says.

    The table has a loop of its own: LLVM vectorises only half of a loop that does all.
    """
    scratch = np.empty((5, count))
    nothings, shares, factors, modes, ratios = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    for i in range(count):
        blank, without, there, of_gas, with_gas = parts_of_gas(
            means[i], fresh[i], noises[i], squares[i], slope, floor
        )
        residual, precision = gas - (means[i] - fresh[i]), 1 / without
        nothing = ONE_BY_ROOT_2PI * math.sqrt(precision) * exp(-0.5 * residual * residual * precision)
        nothings[i], shares[i] = blank * nothing, 1 - blank
        result[i], factors[i], modes[i], ratios[i] = parts_of_density(residual, there, with_gas, of_gas)
    for i in range(count):
        factors[i] *= correction(modes[i], ratios[i])
    for i in range(count):
        result[i] = nothings[i] + shares[i] * (result[i] * factors[i])


@subroutine
def log_densities(
    means: Array,
    fresh: Array,
    squares: Array,
    derived: Array,
    count: int,
    gas: float,
    model: Model,
    result: Array,
) -> None:
    """Fill `result` with the log-likelihood of a gas value for each mean, as plume/sensors/ defines it.

    Where a share of the readings are spikes, it is that of the mixture.
    fresh: (count,) the part of each mean that the gas at the place gives and that fluctuates with it; all of
    it, but for a sensor that lags.  squares: (count,) of the cv of that gas, if it is not steady.
    derived: as of `reading_densities`, for the noise where it is unknown.
    """
    sensor, spikes, spike = model.sensor, model.spikes[0], 0.0
    if spikes > 0:
        spike = spikes * spike_density(gas, sensor)
    if is_intermittent(model.priors) and not is_saturated(gas, sensor):
        slope, floor = sensor[1] * sensor[1], sensor[2] * sensor[2]
        gas_densities(means, fresh, derived[NOISES], squares, count, gas, slope, floor, result)
        for i in range(count):
            result[i] = log(max((1 - spikes) * result[i] + spike, 1e-300))
        return
    _of_other_readings(means, fresh, squares, derived, count, gas, model, result)
    if spikes > 0:
        for i in range(count):
            result[i] = log((1 - spikes) * exp(result[i]) + spike)


@subroutine
def _of_other_readings(
    means: Array,
    fresh: Array,
    squares: Array,
    derived: Array,
    count: int,
    gas: float,
    model: Model,
    result: Array,
) -> None:
    """Fill `result` as `log_densities` does without spikes: in steady gas, or of a saturated sensor."""
    sensor = model.sensor
    kind, slope, floor = sensor[0], sensor[1] * sensor[1], sensor[2] * sensor[2]
    plain = is_plain(model.priors)
    if kind == HITS_KIND and gas == 0.0:  # most are, and need no logarithm
        constant = log_gamma(1.0)
        for i in range(count):
            result[i] = -(sensor[1] * means[i] + sensor[2]) - constant
    elif kind == HITS_KIND:
        constant = log_gamma(gas + 1.0)
        for i in range(count):
            expected = sensor[1] * means[i] + sensor[2]
            result[i] = gas * log(expected) - expected - constant
    elif is_saturated(gas, sensor):
        for i in range(count):
            noise = derived[NOISES, i] if len(derived) else 1.0
            if is_intermittent(model.priors):
                blank, without, there, of_gas, with_gas = parts_of_gas(
                    means[i], fresh[i], noise, squares[i], slope, floor
                )
                far = sensor[SATURATION] - (means[i] - fresh[i])
                beyond = blank * normal_cdf(-far / math.sqrt(without))
                beyond += (1 - blank) * exceeding(far, there, with_gas, of_gas)
            else:
                variance = noise * (slope * means[i] * means[i] + floor)
                beyond = normal_cdf((means[i] - sensor[SATURATION]) / math.sqrt(variance))
            result[i] = log(max(beyond, 1e-300))
    elif kind == THRESHOLD_KIND and gas == 0.0:
        for i in range(count):
            if plain:
                variance = (sensor[1] * means[i]) ** 2 + floor
            else:
                variance = derived[NOISES, i] * (slope * means[i] * means[i] + floor)
            below = normal_cdf((sensor[3] - means[i]) / math.sqrt(variance))
            result[i] = log(max(sensor[4] + (1 - sensor[4]) * below, 1e-300))
    else:
        constant = HALF_LOG_2PI - (log1p(-sensor[4]) if kind == THRESHOLD_KIND else 0.0)
        for i in range(count):
            variance = slope * means[i] * means[i] + floor
            if not plain:
                variance *= derived[NOISES, i]
            residual = gas - means[i]
            result[i] = -0.5 * (residual * residual / variance + log(variance)) - constant


@subroutine
def derived_of(count: int, model: Model) -> Array:
    """Return an array for `count` columns of `plume.kernels.derive`.

    It is empty where only the location is unknown, which has a faster loop.
    """
    few = is_location_only(model.unknowns, model.priors) and model.sensor[RAY] == 0
    return np.empty((0 if few else DERIVED, count))


@subroutine
def element_means(
    particles: Array,
    derived: Array,
    count: int,
    reading: Array,
    model: Model,
    means: Array,
    fresh: Array,
    scratch: Array,
) -> None:
    """Fill `means` (count,) with what the sensor reads without noise, and `fresh` as of `log_densities`.

    derived: columns that `derive` filled; empty if only the location is unknown.  scratch: (count,).
    """
    sensor = model.sensor
    gas_means(particles, derived, count, reading, model.priors, sensor, means)
    settle(means, count, sensor)
    if not lags(sensor):
        for i in range(count):
            fresh[i] = means[i]
        return
    for i in range(count):
        scratch[i] = reading[9]
    place, parts = reading[:5].copy(), len(LEG_SHARES)
    for part in range(parts if reading[10] > 0 else 0):
        place[0] = reading[7] + LEG_SHARES[part] * (reading[0] - reading[7])
        place[1] = reading[8] + LEG_SHARES[part] * (reading[1] - reading[8])
        gas_means(particles, derived, count, place, model.priors, sensor, fresh)
        settle(fresh, count, sensor)
        follow(scratch, fresh, count, reading[10] / parts, sensor)
    rise, decay = kept_of(sensor[DWELL], sensor)
    falls = sensor[CLEAN] > 0
    for i in range(count):
        kept = rise if (means[i] > scratch[i]) != falls else decay
        fresh[i] = (1 - kept) * means[i]
        means[i] = fresh[i] + kept * scratch[i]


@subroutine
def reading_densities(
    particles: Array,
    derived: Array,
    count: int,
    reading: Array,
    model: Model,
    means: Array,
    fresh: Array,
    squares: Array,
    result: Array,
) -> None:
    """Fill `means`, `fresh`, `squares` and `result` (count,), the log-likelihood by particle.

    `element_means` and `squares_of_puffs` say what they are; of gas that is steady, `squares` stays as it is.
    """
    element_means(particles, derived, count, reading, model, means, fresh, result)
    if is_intermittent(model.priors):
        squares_of_puffs(derived, count, reading, model.priors, model.sensor, squares)
    log_densities(means, fresh, squares, derived, count, reading[5], model, result)


@subroutine
def is_fused(readings: Array, model: Model) -> bool:
    """True if `add_place_densities` applies.

    It does in the paper's case with a Gaussian sensor without spikes, for numbers whose products stay in
    range.
    """
    priors, sensor = model.priors, model.sensor
    if (
        sensor[0] != GAUSSIAN_KIND
        or not is_direct(sensor)
        or model.spikes[0] > 0
        or not is_location_only(model.unknowns, priors)
    ):
        return False
    scale = priors[Q, 1] / (4 * math.pi * priors[D, 1])
    sound: bool = sensor[2] > 1e-12 and (1 + sensor[1] + sensor[2]) * (1 + scale) < 1e10
    for t in range(len(readings)):
        sound = sound and abs(readings[t, 5]) < 1e10
    return sound


@subroutine
def add_place_densities(
    places: Array, count: int, readings: Array, model: Model, scratch: Array, targets: Array
) -> None:
    """Add the log-likelihoods of readings (1 to FUSED, 7), the last first, to targets of places (2, count).

    The same as `reading_densities` in the paper's case, with one division and one logarithm for all of
    them: of each reading, the square of the residual and the variance, both times the squared distance,
    are sums of products; fractions are brought to one denominator.
    scratch: (3, count or more).  All shares are 1.
    """
    priors, sensor = model.priors, model.sensor
    diffusivity = priors[D, 1]
    scale = priors[Q, 1] / (4 * math.pi * diffusivity)
    slope, floor = sensor[1] * sensor[1] * scale * scale, sensor[2] * sensor[2]
    least = SOURCE_RADIUS_M * SOURCE_RADIUS_M
    numerators, variances, squares = scratch[0], scratch[1], scratch[2]
    for j in range(count):
        numerators[j], variances[j], squares[j] = 0.0, 1.0, 1.0
    for t in range(len(readings) - 1, -1, -1):
        drift_x, drift_y = readings[t, 3] / (2 * diffusivity), readings[t, 4] / (2 * diffusivity)
        inverse_length = math.sqrt(1 / (diffusivity * priors[TAU, 1]) + drift_x * drift_x + drift_y * drift_y)
        x, y, dz, gas = readings[t, 0], readings[t, 1], readings[t, 2] - priors[Z, 1], readings[t, 5]
        dz_squared = dz * dz
        for j in range(count):
            dx = x - places[0, j]
            dy = y - places[1, j]
            square = max(dx * dx + dy * dy + dz_squared, least)
            distance = math.sqrt(square)
            decay = exp(-distance * inverse_length - (dx * drift_x + dy * drift_y))
            residual = gas * distance - scale * decay
            variance = slope * decay * decay + floor * square
            numerators[j] = numerators[j] * variance + residual * residual * variances[j]
            variances[j] *= variance
            squares[j] *= square
    constant = HALF_LOG_2PI * len(readings)
    for j in range(count):
        targets[j] -= 0.5 * (numerators[j] / variances[j] + log(variances[j] / squares[j])) + constant


@subroutine
def is_a_normal_density(gas: float, sensor: Array) -> bool:
    """True if this gas value has a density, which noise widens and so lowers; false if a probability."""
    return (
        not is_saturated(gas, sensor)
        and sensor[0] != HITS_KIND
        and (sensor[0] != THRESHOLD_KIND or gas != 0.0)
    )


@subroutine
def greatest_log_density(gas: float, model: Model) -> tuple[float, float]:
    """Return (a, r) of an upper bound of the log-likelihood of a gas value: a + log(1/f + r).

    It holds whatever the mean. f is the factor on the noise; where the value has a probability, 1. Without
    spikes r is 0, and a density falls as 1/f. That of spikes does not: it is r times the rest's at f = 1.
    """
    greatest, spikes = _greatest_without_spikes(gas, model.sensor, model.priors), model.spikes[0]
    kept = greatest + log1p(-spikes)
    return kept, spikes * spike_density(gas, model.sensor) * exp(-kept)


@subroutine
def _greatest_without_spikes(gas: float, sensor: Array, priors: Array) -> float:
    """Return the bound of readings that are no spikes, for noise of a factor of 1.

    If the gas is steady and the noise known, it falls with the reading: a strong reading needs a large mean,
    and a large mean has much noise.
    """
    if sensor[0] == HITS_KIND:
        return gas * log(gas) - gas - log_gamma(gas + 1.0) + 1e-9 if gas > 0 else 0.0
    if is_saturated(gas, sensor) or (sensor[0] == THRESHOLD_KIND and gas == 0.0):
        return 0.0
    slope, floor = sensor[1] * sensor[1], sensor[2] * sensor[2]
    if gas <= 0 or not is_plain(priors):
        return -0.5 * log(floor) - HALF_LOG_2PI
    best = -0.5 * log(slope * gas * gas + floor)  # of means above the reading
    for cell in range(20):  # of means in twentieths of the reading: the least distance, the best variances
        low, high = cell / 20 * gas, (cell + 1) / 20 * gas
        distance = (gas - high) ** 2 / (slope * high * high + floor)
        best = max(best, -0.5 * (distance + log(slope * low * low + floor)))
    return best - HALF_LOG_2PI


@kernel(numba.float64[::1](numba.float64[:, ::1], MODEL, numba.float64[::1]))
def log_likelihoods(particles: Array, model: Model, reading: Array) -> Array:
    """Log-likelihood of one reading (7,) or (11,) under each particle: (N,)."""
    count = particles.shape[1]
    means, fresh, squares, result = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    derived = derived_of(count, model)
    if len(derived):
        derive(particles, count, model.unknowns, model.priors, derived)
    reading_densities(particles, derived, count, reading, model, means, fresh, squares, result)
    return result


@subroutine
def place_density(particles: Array, i: int, model: Model) -> float:
    """Density of the prior of particle i's place in the polygons of the model, up to a constant; 0 in a wall.

    A polygon encloses a place as `plume.polygons.polygons.enclosed` says.
    """
    x, y = model.priors[X, 1], model.priors[Y, 1]
    for row in range(len(model.unknowns)):
        x = particles[row, i] if model.unknowns[row] == X else x
        y = particles[row, i] if model.unknowns[row] == Y else y
    total, turns, number = model.densities[0], 0, 0
    for side in range(len(model.walls)):
        x_1, y_1, x_2, y_2, of = model.walls[side]
        if of != number:
            if turns != 0 and number == 0:
                return 0.0
            total += model.densities[number] if turns != 0 else 0.0
            turns, number = 0, int(of)
        left = (x_2 - x_1) * (y - y_1) - (y_2 - y_1) * (x - x_1)
        if y_1 <= y < y_2 and left > 0:
            turns += 1
        elif y_2 <= y < y_1 and left < 0:
            turns -= 1
    if turns != 0:
        return 0.0 if number == 0 else total + float(model.densities[number])
    return float(total)


@subroutine
def fill_log_priors(particles: Array, count: int, model: Model, result: Array) -> None:
    """Fill `result` (count,) with the log prior density of each particle up to a constant.

    Of a log-normal parameter it is that of its logarithm.
    """
    for i in range(count):
        result[i] = 0.0
    for row in range(len(model.unknowns)):
        index = model.unknowns[row]
        kind, a, b = model.priors[index, 0], model.priors[index, 1], model.priors[index, 2]
        if kind == NORMAL:
            for i in range(count):
                result[i] -= 0.5 * ((particles[row, i] - a) / b) ** 2
        elif kind == AROUND:
            for i in range(count):
                result[i] += 0.0 if a <= particles[row, i] <= b else LOG_BEYOND
        elif kind == GAMMA:
            for i in range(count):
                result[i] += (a - 1) * log(particles[row, i]) - particles[row, i] / b
        elif kind == LOGNORMAL:
            for i in range(count):
                result[i] -= 0.5 * ((log(particles[row, i]) - a) / b) ** 2
    if len(model.densities) > 1:
        for i in range(count):
            result[i] += log(place_density(particles, i, model))


@kernel(numba.float64[::1](numba.float64[:, ::1], MODEL))
def log_priors(particles: Array, model: Model) -> Array:
    """Log prior density of each particle up to a constant: (N,)."""
    result = np.empty(particles.shape[1])
    fill_log_priors(particles, len(result), model, result)
    return result
