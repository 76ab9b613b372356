"""The plume as compiled loops over source hypotheses; tests hold them equal to `concentration`.

Plain IEEE arithmetic in a fixed order, exp included: results are bit-identical alone, in a batch and on
any number of threads.

particles: (D, N), one row per unknown.  unknowns: (D,) indices into `PARAMETERS`.
priors: (15, 2 or more), one row per parameter: its kind and, if that is KNOWN, its value.
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
    EAST,
    GAIN,
    KNOWN,
    MEASURED,
    NOISE,
    NORTH,
    PHI,
    PUFF_RATE,
    PUFF_SHARE,
    RAY,
    TAU,
    UP,
    WIND_DIRECTION,
    WIND_SPEED,
    D,
    Q,
    U,
    X,
    Y,
    Z,
)

# Rows of `derive` for the noise, the square of its factor; and for the gas's intermittency: the square of the
# cv that it has everywhere, the strength of its puffs, and 1/(2 − share) of them.
NOISES, CVS, PUFFS, WIDTHS = 9, 10, 11, 12
MOST_SQUARE = 900.0  # greatest square of a coefficient of variation
RADIANS = math.pi / 180
ONE_BY_PI_ROOT_2 = 1 / (math.pi * math.sqrt(2.0))
# Number of rows that `derive` fills: x, y, z, gain q/(4π d), 1/(2d), 1/(d τ), u, cos φ, sin φ, noise², and
# those of the gas's intermittency.
#
# If the wind is measured, u is the factor on its speed and φ the offset of its direction.
DERIVED = 13


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
    return bool(priors[NOISE, 0] == KNOWN and priors[NOISE, 1] == 1 and not is_intermittent(priors))


@subroutine
def is_intermittent(priors: Array) -> bool:
    """True if the gas is not taken to be steady."""
    even = priors[CV, 0] == KNOWN and priors[CV, 1] == 0
    return not (even and priors[PUFF_RATE, 0] == KNOWN and priors[PUFF_RATE, 1] == math.inf)


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
    values = np.empty((len(priors), count))
    for parameter in range(len(priors)):
        for i in range(count):
            values[parameter, i] = priors[parameter, 1]
    for row in range(len(unknowns)):
        for i in range(count):
            values[unknowns[row], i] = particles[row, i]
    # A loop for each row: LLVM does not vectorise one loop over so many rows.
    for i in range(count):
        derived[0, i] = values[X, i]
    for i in range(count):
        derived[1, i] = values[Y, i]
    for i in range(count):
        derived[2, i] = values[Z, i]
    for i in range(count):
        derived[3, i] = values[GAIN, i] * values[Q, i] / (4 * math.pi * values[D, i])
    for i in range(count):
        derived[4, i] = 0.5 / values[D, i]
    for i in range(count):
        derived[5, i] = 1 / (values[D, i] * values[TAU, i])
    speeds = values[WIND_SPEED] if priors[U, 0] == MEASURED else values[U]
    for i in range(count):
        derived[6, i] = speeds[i]
    angles, unit = (values[WIND_DIRECTION], RADIANS) if priors[PHI, 0] == MEASURED else (values[PHI], 1.0)
    for i in range(count):
        derived[7, i], derived[8, i] = cosine_and_sine(angles[i] * unit)
    for i in range(count):
        derived[NOISES, i] = values[NOISE, i] * values[NOISE, i]
    for i in range(count):
        derived[CVS, i] = values[CV, i] * values[CV, i]
    for i in range(count):
        share = values[PUFF_SHARE, i]
        strength = math.sqrt((1 - 0.5 * share) / (share * share * share))
        derived[PUFFS, i] = ONE_BY_PI_ROOT_2 * values[D, i] * strength / values[PUFF_RATE, i]
    for i in range(count):
        derived[WIDTHS, i] = 1 / (2 - values[PUFF_SHARE, i])


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


@subroutine
def squares_of_puffs(
    derived: Array, count: int, reading: Array, priors: Array, sensor: Array, squares: Array
) -> None:
    """Fill `squares` (count,) with the squared coefficient of variation of the gas at the reading's place.

    Gas in puffs of the variance 2 s d a at age a, at random times and displaced so that their mean is the
    plume, has by Campbell's theorem the variance q²/rate ∫ e^(−2a/τ) N(r + w a; 0, 2 (1 − s/2) d a) (8π s d
    a)^(−3/2) da. The integral is a Bessel function, z² e^z K₂(z) ≈ √(4 + 8z + 5.9z² + πz³/2). By the squared
    mean that is strength · √(…)/r² · e^(2r/λ − z + …); docs/physics.md has all of it.
    Along a ray it is that of the place nearest to the source.
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
        along = min(max(-(dx * east + dy * north + dz * up), 0.0), ray)
        dx += along * east
        dy += along * north
        dz += along * up
        square = max(dx * dx + dy * dy + dz * dz, SOURCE_RADIUS_M * SOURCE_RADIUS_M)
        distance = math.sqrt(square)
        drift, width = u * derived[4, i], derived[WIDTHS, i]
        inverse_length = math.sqrt(derived[5, i] + drift * drift)
        z = 2 * distance * math.sqrt(width * (derived[5, i] + width * drift * drift))
        exponent = 2 * (distance * inverse_length + (1 - width) * drift * (dx * c + dy * s)) - z
        bessel = math.sqrt(4 + z * (8 + z * (5.9 + z * (0.5 * math.pi))))
        puffs = derived[PUFFS, i] * bessel / square * exp(exponent)
        squares[i] = min(derived[CVS, i] + puffs, MOST_SQUARE)
