"""The plume as compiled loops over source hypotheses; tests hold them equal to `concentration`.

Plain IEEE arithmetic in a fixed order, exp included: results are bit-identical alone, in a batch and on
any number of threads.

particles: (D, N), one row per unknown.  unknowns: (D,) indices into `PARAMETERS`.
priors: (13, 2 or more), one row per parameter: its kind and, if that is KNOWN, its value.
readings: (T, 5 or more) rows of x, y, height (same origin as z), wind_x, wind_y.
"""

import math

import numpy as np

from plume.compiled import subroutine
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array, Indices
from plume.numerics import cosine_and_sine, exp
from plume.parameters import (
    CV,
    GAIN,
    KNOWN,
    MEASURED,
    NOISE,
    PHI,
    TAU,
    WIND_DIRECTION,
    WIND_SPEED,
    D,
    Q,
    U,
    X,
    Y,
    Z,
)

NOISES, CVS = 9, 10  # rows of `derive` for the noise: the square of its factor, and the gas's intermittency
RADIANS = math.pi / 180
# Number of rows that `derive` fills: x, y, z, gain q/(4π d), 1/(2d), 1/(d τ), u, cos φ, sin φ, noise², cv.
#
# If the wind is measured, u is the factor on its speed and φ the offset of its direction.
DERIVED = 11


@subroutine
def is_location_only(unknowns: Indices, priors: Array) -> bool:
    """True if only x and y are unknown and the wind is measured: the paper's case has a faster loop."""
    exact = priors[WIND_DIRECTION, 1] == 0 and priors[WIND_SPEED, 1] == 1 and priors[GAIN, 1] == 1
    place = len(unknowns) == 2 and unknowns[0] == X and unknowns[1] == Y
    return bool(
        place and exact and is_plain(priors) and priors[U, 0] == MEASURED and priors[PHI, 0] == MEASURED
    )


@subroutine
def is_plain(priors: Array) -> bool:
    """True if the sensor's noise is known and the gas is steady."""
    return bool(
        priors[NOISE, 0] == KNOWN and priors[NOISE, 1] == 1 and priors[CV, 0] == KNOWN and priors[CV, 1] == 0
    )


@subroutine
def location_means(particles: Array, count: int, reading: Array, priors: Array, means: Array) -> None:
    """Fill `means` (count,) with the concentration at the reading's place, g/m³.

    Sources are at particles (2, count); all else is known.
    """
    diffusivity, lifetime = priors[D, 1], priors[TAU, 1]
    wind_x, wind_y = reading[3], reading[4]
    inverse_length = math.sqrt(
        1 / (diffusivity * lifetime) + (wind_x * wind_x + wind_y * wind_y) / (4 * diffusivity * diffusivity)
    )
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


@subroutine
def derive(particles: Array, count: int, unknowns: Indices, priors: Array, derived: Array) -> None:
    """Fill `derived` (DERIVED, count) from particles (D, count) and the known parameters."""
    values = np.empty(len(priors))
    for parameter in range(len(priors)):  # assigning the whole row takes five times as long to compile
        values[parameter] = priors[parameter, 1]
    speed_measured, direction_measured = priors[U, 0] == MEASURED, priors[PHI, 0] == MEASURED
    for i in range(count):
        for row in range(len(unknowns)):
            values[unknowns[row]] = particles[row, i]
        angle = values[WIND_DIRECTION] * RADIANS if direction_measured else values[PHI]
        derived[0, i] = values[X]
        derived[1, i] = values[Y]
        derived[2, i] = values[Z]
        derived[3, i] = values[GAIN] * values[Q] / (4 * math.pi * values[D])
        derived[4, i] = 0.5 / values[D]
        derived[5, i] = 1 / (values[D] * values[TAU])
        derived[6, i] = values[WIND_SPEED] if speed_measured else values[U]
        derived[7, i], derived[8, i] = cosine_and_sine(angle)
        derived[NOISES, i] = values[NOISE] * values[NOISE]
        derived[CVS, i] = values[CV]


@subroutine
def wind_of(reading: Array, priors: Array) -> tuple[float, float, float]:
    """Return the measured speed, m/s, and the direction's (cos, sin): 1 and 0° where they have a prior."""
    speed = math.sqrt(reading[3] * reading[3] + reading[4] * reading[4])
    cosine, sine = (reading[3] / speed, reading[4] / speed) if speed > 0 else (1.0, 0.0)
    if priors[U, 0] != MEASURED:
        speed = 1.0
    if priors[PHI, 0] != MEASURED:
        cosine, sine = 1.0, 0.0
    return speed, cosine, sine


@subroutine
def derived_means(derived: Array, count: int, reading: Array, priors: Array, means: Array) -> None:
    """Fill `means` (count,) with the concentration at the reading's place, times the gain, g/m³.

    Each is that of a column of `derived`. A measured wind is taken from the reading, with the column's error.
    """
    x, y, height = reading[0], reading[1], reading[2]
    speed, cosine, sine = wind_of(reading, priors)
    for i in range(count):
        u = speed * derived[6, i]
        c = cosine * derived[7, i] - sine * derived[8, i]
        s = sine * derived[7, i] + cosine * derived[8, i]
        dx = x - derived[0, i]
        dy = y - derived[1, i]
        dz = height - derived[2, i]
        distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), SOURCE_RADIUS_M)
        drift = u * derived[4, i]
        inverse_length = math.sqrt(derived[5, i] + drift * drift)
        means[i] = derived[3, i] / distance * exp(-distance * inverse_length - drift * (dx * c + dy * s))
