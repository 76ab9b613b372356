"""Instruments as compiled loops: the gas along a ray, settled readings, and the lag between two readings.

As in `plume/sensors/instruments.py`; tests hold them equal.
sensor: (SENSOR_NUMBERS,), see `plume.parameters`.
"""

import math

import numpy as np

from plume.compiled import kernel, subroutine
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array, Indices
from plume.kernels import DERIVED, derive, derived_means, is_location_only, location_means, wind_of
from plume.numerics import exp, log
from plume.parameters import CLEAN, DECAY, EAST, FACTOR, NORTH, POWER, RAY, RISE, SATURATION, UP

# Shares of a leg behind the vehicle in the middle of each of even parts of its time, where it speeds up on
# the first half and slows down on the second, as on legs up to 8 m. The gas there stands for the part.
LEG_SHARES = np.array([0.03125, 0.28125, 0.71875, 0.96875])
# Nodes and weights of Gauss and Legendre between -1 and 1; the others are their mirror images.
NODES = np.array([0.1834346424956498, 0.525532409916329, 0.7966664774136267, 0.9602898564975363])
WEIGHTS = np.array([0.362683783378362, 0.3137066458778873, 0.22238103445337448, 0.10122853629037626])


@subroutine
def lags(sensor: Array) -> bool:
    """True if a reading depends on the one before."""
    return bool(sensor[RISE] > 0 or sensor[DECAY] > 0)


@subroutine
def is_direct(sensor: Array) -> bool:
    """True if the sensor reads the gas where it is, at once, and has no greatest reading."""
    return bool(
        not lags(sensor) and sensor[RAY] == 0 and sensor[CLEAN] == 0 and not sensor[SATURATION] < math.inf
    )


@subroutine
def _inverse_sinh(x: float) -> float:
    size = abs(x)
    result = log(size + math.sqrt(size * size + 1))
    return result if x >= 0 else -result


@subroutine
def ray_means(derived: Array, count: int, reading: Array, priors: Array, sensor: Array, means: Array) -> None:
    """Fill `means` (count,) with the gas along a ray from the reading's place, times the gain, g/m².

    Each is that of a column of `plume.kernels.derive`. A place of the ray is t metres from the vehicle and r
    from the source. ∫ exp(−r/λ)/r dt becomes smooth with t + b = ρ sinh s: b is how far the vehicle is
    past the place nearest to the source, and ρ how near that is, at least the source's radius.
    """
    speed, cosine, sine = wind_of(reading, priors)
    ray, east, north, up = sensor[RAY], sensor[EAST], sensor[NORTH], sensor[UP]
    for i in range(count):
        u = speed * derived[6, i]
        c = cosine * derived[7, i] - sine * derived[8, i]
        s = sine * derived[7, i] + cosine * derived[8, i]
        dx = reading[0] - derived[0, i]
        dy = reading[1] - derived[1, i]
        dz = reading[2] - derived[2, i]
        past = dx * east + dy * north + dz * up
        aside = math.sqrt(max(dx * dx + dy * dy + dz * dz - past * past, 0.0))
        near = max(aside, SOURCE_RADIUS_M)
        low, high = _inverse_sinh(past / near), _inverse_sinh((past + ray) / near)
        drift = u * derived[4, i]
        scale = -0.5 * near * math.sqrt(derived[5, i] + drift * drift)
        along = drift * (east * c + north * s)  # by which the logarithm of the gas falls along the ray, 1/m
        start = along * past - drift * (dx * c + dy * s)
        along *= 0.5 * near
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        total = 0.0
        for node in range(len(NODES)):
            one, other = exp(middle + half * NODES[node]), exp(middle - half * NODES[node])
            first = exp(start + scale * (one + 1 / one) - along * (one - 1 / one))
            second = exp(start + scale * (other + 1 / other) - along * (other - 1 / other))
            total += WEIGHTS[node] * (first + second)
        means[i] = derived[3, i] * half * total


@subroutine
def settle(means: Array, count: int, sensor: Array) -> None:
    """Turn gas (count,) into what a sensor reads after long in it, in place."""
    if sensor[CLEAN] > 0:
        for i in range(count):
            means[i] = min(sensor[FACTOR] * exp(sensor[POWER] * log(max(means[i], 1e-300))), sensor[CLEAN])


@subroutine
def _kept(seconds: float, time_constant: float) -> float:
    return exp(-seconds / time_constant) if time_constant > 0 else 0.0


@subroutine
def kept_of(seconds: float, sensor: Array) -> tuple[float, float]:
    """Return what is left of an element's distance after some seconds in more gas, and in less."""
    return _kept(seconds, sensor[RISE]), _kept(seconds, sensor[DECAY])


@subroutine
def follow(values: Array, settled: Array, count: int, seconds: float, sensor: Array) -> None:
    """Let elements (count,) follow gas of these settled readings for some seconds, in place."""
    rise, decay = kept_of(seconds, sensor)
    falls = sensor[CLEAN] > 0  # gas lowers a metal oxide's resistance
    for i in range(count):
        grows = (settled[i] > values[i]) != falls
        values[i] = settled[i] + (values[i] - settled[i]) * (rise if grows else decay)


@subroutine
def gas_means(
    particles: Array,
    derived: Array,
    count: int,
    reading: Array,
    priors: Array,
    sensor: Array,
    means: Array,
) -> None:
    """Fill `means` (count,) with the mean gas that a sensor meets at the reading's place, g/m³ or g/m².

    derived: columns that `derive` filled; empty if only the location is unknown, of a sensor without a ray.
    """
    if len(derived) == 0:
        location_means(particles, count, reading, priors, means)
    elif sensor[RAY] > 0:
        ray_means(derived, count, reading, priors, sensor, means)
    else:
        derived_means(derived, count, reading, priors, means)


@kernel(
    "float64[:, ::1](float64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[::1])", nogil=True
)
def settled_readings(
    particles: Array, unknowns: Indices, priors: Array, readings: Array, sensor: Array
) -> Array:
    """What a sensor reads after long at the place of each reading (A, 5 or more), by particle: (A, N)."""
    count = particles.shape[1]
    result = np.empty((len(readings), count))
    only_location = is_location_only(unknowns, priors) and sensor[RAY] == 0
    derived = np.empty((0 if only_location else DERIVED, count))
    if not only_location:
        derive(particles, count, unknowns, priors, derived)
    for a in range(len(readings)):
        gas_means(particles, derived, count, readings[a], priors, sensor, result[a])
        settle(result[a], count, sensor)
    return result
