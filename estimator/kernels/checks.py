"""Model checks: ranks of readings in their predictive distributions, with a test that they are uniform; and a
test that the measured winds are one wind.
"""

import math

import numpy as np

from estimator.kernels.densities import Model, is_saturated, normal_cdf, parts_of_gas
from estimator.kernels.spikes import spike_density, spike_rank
from plume.compiled import kernel, subroutine
from plume.elementary import Array
from plume.intermittency import distributions
from plume.kernels import NOISES, is_intermittent
from plume.numerics import HALF_LOG_2PI, dot, exp, log, log1p, log_gamma, total_of
from plume.parameters import DECAY, DWELL, GAUSSIAN_KIND, HITS_KIND, RISE, SATURATION, THRESHOLD_KIND
from plume.sensors.response import lags

# Approximate number of particles, evenly spaced, for the predictive rank of a reading; fewer in intermittent
# gas, where each takes long.
CHECK_PARTICLES, CHECK_INTERMITTENT = 1000, 250
# Least root mean square deviation of the measured winds, by their mean, that counts as more than one wind.
# It is a wander by 17°: over flat land there are 2.5° to 25°, 10° in neutral air (Pasquill's classes).
DIFFER = 0.3
FEWEST_WINDS = 8


@subroutine
def _gaussian_tails(
    means: Array, noises: Array, gas: float, slope: float, floor: float, result: Array
) -> None:
    """Fill `result` with P(Z ≤ gas) for each mean and squared noise factor.

    It is accurate to 1.5e-7 (Abramowitz and Stegun 7.1.26).
    """
    for i in range(len(means)):
        residual = gas - means[i]
        half_square = 0.5 * residual * residual / (noises[i] * (slope * means[i] * means[i] + floor))
        t = 1 / (1 + 0.3275911 * math.sqrt(half_square))
        p = (((t * 1.061405429 - 1.453152027) * t + 1.421413741) * t - 0.284496736) * t + 0.254829592
        tail = 0.5 * p * t * exp(-half_square)
        result[i] = 1 - tail if residual > 0 else tail


@subroutine
def _intermittent_tails(
    means: Array,
    fresh: Array,
    noises: Array,
    squares: Array,
    gas: float,
    slope: float,
    floor: float,
    result: Array,
) -> None:
    """Fill `result` with P(Z ≤ gas) for each mean of intermittent gas, made of what `parts_of_gas` says."""
    rows = np.empty((6, len(means)))
    residuals, there, of_gas, with_gas, blanks, nothings = (
        rows[0],
        rows[1],
        rows[2],
        rows[3],
        rows[4],
        rows[5],
    )
    for i in range(len(means)):
        blank, without, there[i], of_gas[i], with_gas[i] = parts_of_gas(
            means[i], fresh[i], noises[i], squares[i], slope, floor
        )
        residuals[i] = gas - (means[i] - fresh[i])
        blanks[i], nothings[i] = blank, normal_cdf(residuals[i] / math.sqrt(without))
    distributions(residuals, there, with_gas, of_gas, result)
    for i in range(len(means)):
        result[i] = blanks[i] * nothings[i] + (1 - blanks[i]) * result[i]


@subroutine
def _hits_cdf(count: float, expected: float) -> float:
    """P(K ≤ count) of a Poisson count; above 100 by the Wilson–Hilferty cube-root approximation."""
    if count < 0:
        return 0.0
    if count > 100:
        k = count + 1
        return normal_cdf(3 * math.sqrt(k) * (1 - 1 / (9 * k) - exp(log(expected / k) / 3)))
    term = exp(-expected)
    total = term
    for k in range(1, int(count) + 1):
        term *= expected / k
        total += term
    return min(total, 1.0)


@subroutine
def predictive_rank(
    means: Array,
    fresh: Array,
    squares: Array,
    derived: Array,
    weights: Array,
    gas: float,
    model: Model,
    chance: float,
) -> float:
    """Return the rank of a reading in its predictive distribution (Dawid 1984).

    It is uniform in (0, 1) if the model is right. That of a spike is near 0 or 1, but no nearer than spikes
    are rare.
    means, weights: (N,) of the particles before the reading.  fresh, squares: as of
    `log_densities`.
    derived: their columns of `plume.kernels.derive`, or empty.
    chance: a uniform draw in (0, 1) that breaks ties of discrete readings.
    """
    sensor = model.sensor
    slope, floor = sensor[1] * sensor[1], sensor[2] * sensor[2]
    gaussian = sensor[0] == GAUSSIAN_KIND
    intermittent = gaussian and is_intermittent(model.priors)
    stride = max(len(means) // (CHECK_INTERMITTENT if intermittent else CHECK_PARTICLES), 1)
    few, shares = means[::stride].copy(), weights[::stride].copy()
    count = len(few)
    noises, tails = np.ones(count), np.empty(count)
    if len(derived):
        for i in range(count):
            noises[i] = derived[NOISES, i * stride]
    if gaussian and not intermittent:
        _gaussian_tails(few, noises, gas, slope, floor, tails)
    elif intermittent:
        _intermittent_tails(
            few, fresh[::stride].copy(), noises, squares[::stride].copy(), gas, slope, floor, tails
        )
    share, total = 0.0, 0.0
    for i in range(count):
        variance = noises[i] * ((sensor[1] * few[i]) ** 2 + sensor[2] * sensor[2])
        if sensor[0] == HITS_KIND:
            expected = sensor[1] * few[i] + sensor[2]
            below = _hits_cdf(gas - 1, expected)
            tails[i] = below + chance * (_hits_cdf(gas, expected) - below)
        elif not gaussian:
            tails[i] = sensor[4] + (1 - sensor[4]) * normal_cdf(
                (max(gas, sensor[3]) - few[i]) / math.sqrt(variance)
            )
            if gas == 0.0:
                tails[i] *= chance
        if is_saturated(gas, sensor):
            tails[i] += chance * (1 - tails[i])
        share += shares[i] * tails[i]
        total += shares[i]
    rank, spikes = share / total, model.spikes[0]
    return rank + spikes * (spike_rank(gas, sensor, chance) - rank) if spikes > 0 else rank


@subroutine
def _log_factorials(gas: Array, sensor: Array) -> Array:
    """Return the logarithms of the factorials of counts (T,); zeros for a sensor that does not count."""
    result = np.zeros(len(gas))
    if sensor[0] == HITS_KIND:
        for i in range(len(gas)):
            result[i] = log_gamma(gas[i] + 1.0)
    return result


@subroutine
def _of_one_value(gas: Array, log_factorials: Array, sensor: Array) -> float:
    """Greatest log-likelihood of gas values (T,) by a sensor that shows one value plus noise, no spikes."""
    count, result = len(gas), 0.0
    if sensor[0] == HITS_KIND:
        mean = max(total_of(gas) / count, 1e-300)
        for i in range(count):
            result += gas[i] * log(mean) - mean - log_factorials[i]
        return result
    if sensor[0] == THRESHOLD_KIND or sensor[SATURATION] < math.inf:
        gas = gas[(gas != 0.0) if sensor[0] == THRESHOLD_KIND else (gas < sensor[SATURATION])]
        for n in (len(gas), count - len(gas)):
            result += n * log(max(n, 1) / count)
    if len(gas) > 0:
        offsets = gas - total_of(gas) / len(gas)
        std = max(math.sqrt(dot(offsets, offsets) / len(gas)), 1e-3)
        result -= len(gas) * (log(std) + HALF_LOG_2PI + 0.5)
    return result


@subroutine
def _greatest(gas: Array, sensor: Array, spikes: float) -> float:
    """Return what `log_likelihood_of_one_value` does for gas values (T,)."""
    result = _of_one_value(gas, _log_factorials(gas, sensor), sensor)
    if spikes == 0:
        return result
    ordered, low, high, of_spikes, kept = np.sort(gas), 0, len(gas), 0.0, log1p(-spikes)
    constants = _log_factorials(ordered, sensor)
    result += len(gas) * kept
    for _ in range(len(gas) // 2):
        middle = total_of(ordered[low:high]) / (high - low)
        if ordered[high - 1] - middle > middle - ordered[low]:
            high -= 1
            of_spikes += log(spikes * spike_density(ordered[high], sensor))
        else:
            of_spikes += log(spikes * spike_density(ordered[low], sensor))
            low += 1
        of_rest = _of_one_value(ordered[low:high], constants[low:high], sensor)
        result = max(result, of_rest + (high - low) * kept + of_spikes)
    return result


@kernel("float64(float64[:, ::1], float64[::1], float64)")
def log_likelihood_of_one_value(readings: Array, sensor: Array, spikes: float) -> float:
    """Greatest log-likelihood of readings (T, 7) by a sensor that shows one value plus noise.

    For hits: by one that counts with one mean. A threshold sensor shows 0 with one probability, and else
    one value plus noise. If a share of the readings are spikes, any of those farthest from the others are
    taken for spikes, up to half. A sensor that lags may also show one value less what is left of the reading
    before.
    """
    result = _greatest(readings[:, 5].copy(), sensor, spikes)
    if lags(sensor):
        changes = np.empty(len(readings))
        for t in range(len(readings)):
            kept = exp(-(readings[t, 10] + sensor[DWELL]) / max(sensor[RISE], sensor[DECAY]))
            saturated = is_saturated(readings[t, 5], sensor)  # which is no value to compare with others
            changes[t] = readings[t, 5] - (0.0 if saturated else kept * readings[t, 9])
        result = max(result, _greatest(changes, sensor, spikes))
    return result


@kernel("float64(float64[:, ::1])")
def one_wind_p_value(winds: Array) -> float:
    """p-value of the measured winds (T, 2), m/s, under one wind and independent errors of the anemometer.

    It is that of the correlation of neighbours' deviations from the mean, which grows if the wind depends on
    the place or wanders. Of T independent deviations it is −1/T on average, with a standard deviation of at
    most 1/√T (Moran 1948). The p-value is 1 if there are fewer than `FEWEST_WINDS`, or if they deviate
    from their mean by less than `DIFFER`.
    """
    count = len(winds)
    if count < FEWEST_WINDS:
        return 1.0
    east, north = total_of(winds[:, 0].copy()) / count, total_of(winds[:, 1].copy()) / count
    power, products = 0.0, 0.0
    for t in range(count):
        x, y = winds[t, 0] - east, winds[t, 1] - north
        power += x * x + y * y
        if t > 0:
            products += x * (winds[t - 1, 0] - east) + y * (winds[t - 1, 1] - north)
    if power <= DIFFER * DIFFER * (east * east + north * north) * count:
        return 1.0
    return normal_cdf(-(products / power + 1 / count) * math.sqrt(count))


@kernel("float64(float64[::1])")
def uniformity_p_value(ranks: Array) -> float:
    """p-value of the Anderson–Darling test that ranks (n,), n ≥ 8, are uniform in (0, 1).

    As in Marsaglia and Marsaglia 2004.
    """
    count = len(ranks)
    ordered = np.sort(ranks)
    total = 0.0
    for i in range(count):
        low = min(max(ordered[i], 1e-15), 1 - 1e-15)
        high = min(max(ordered[count - 1 - i], 1e-15), 1 - 1e-15)
        total += (2 * i + 1) * (log(low) + log1p(-high))
    z = -count - total / count
    if z > 8:  # beyond the published formula's accuracy: the asymptotic tail, continuous with it at 8
        return 0.94 * exp(-z) / math.sqrt(z)
    if z < 2:
        p = 2.00012 + (0.247105 - (0.0649821 - (0.0347962 - (0.011672 - 0.00168691 * z) * z) * z) * z) * z
        limit = exp(-1.2337141 / z) / math.sqrt(z) * p
    else:
        limit = exp(
            -exp(1.0776 - (2.30695 - (0.43424 - (0.082433 - (0.008056 - 0.0003146 * z) * z) * z) * z) * z)
        )
    if limit > 0.8:
        g = (
            -130.2137
            + (745.2337 - (1705.091 - (1950.646 - (1116.360 - 255.7844 * limit) * limit) * limit) * limit)
            * limit
        )
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
    return min(max(1 - limit, 0.0), 1.0)  # the correction may leave the range by a rounding
