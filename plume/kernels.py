"""The plume as compiled loops over source hypotheses; tests hold them equal to `concentration`.

Plain IEEE arithmetic in a fixed order, exp included: results are bit-identical alone, in a batch and on any number of threads.

particles: (D, N), one row per unknown.  unknowns: (D,) indices into `PARAMETERS`.
priors: (8, 2 or more), one row per parameter: its kind and, if that is KNOWN, its value.
readings: (T, 5 or more) rows of x, y, height (same origin as z), wind_x, wind_y.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from plume.compiled import kernel
from plume.dispersion import SOURCE_RADIUS_M
from plume.numerics import exp
from plume.parameters import MEASURED, PHI, TAU, D, Q, U, X, Y, Z

Array = NDArray[np.float64]

DERIVED = 9
"""Number of rows that `derive` fills: x, y, z, q/(4π d), 1/(2d), 1/(d τ), u, cos φ, sin φ."""


@numba.njit(error_model="numpy")
def is_location_only(unknowns: NDArray[np.int64], priors: Array) -> bool:
    """True if only x and y are unknown and the wind is measured: the paper's case, which has a faster loop."""
    return len(unknowns) == 2 and unknowns[0] == X and unknowns[1] == Y and priors[U, 0] == MEASURED and priors[PHI, 0] == MEASURED


@numba.njit(error_model="numpy")
def location_means(particles: Array, count: int, reading: Array, priors: Array, means: Array) -> None:
    """Fill `means` (count,) with the concentration at the reading's place, g/m³, for sources at particles (2, count); all else is known."""
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
def derive(particles: Array, count: int, unknowns: NDArray[np.int64], priors: Array, derived: Array) -> None:
    """Fill `derived` (DERIVED, count) from particles (D, count) and the known parameters."""
    values = np.empty(8)
    for parameter in range(8):  # assigning the whole row takes five times as long to compile
        values[parameter] = priors[parameter, 1]
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
def derived_means(derived: Array, count: int, reading: Array, priors: Array, means: Array) -> None:
    """Fill `means` (count,) with the concentration at the reading's place, g/m³, for each column of `derived`.

    A measured wind is taken from the reading.
    """
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


@kernel("float64[:, ::1](float64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1])", nogil=True)
def mean_concentrations(particles: Array, unknowns: NDArray[np.int64], priors: Array, readings: Array) -> Array:
    """Concentration at the place of each reading (A, 5 or more) under each particle, g/m³: (A, N)."""
    count = particles.shape[1]
    result = np.empty((len(readings), count))
    only_location = is_location_only(unknowns, priors)
    derived = np.empty((0 if only_location else DERIVED, count))
    if not only_location:
        derive(particles, count, unknowns, priors, derived)
    for a in range(len(readings)):
        if only_location:
            location_means(particles, count, readings[a], priors, result[a])
        else:
            derived_means(derived, count, readings[a], priors, result[a])
    return result
