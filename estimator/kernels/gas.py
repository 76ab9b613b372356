"""What the hypotheses say of the gas itself: how much it comes and goes downwind of the source."""

import math

import numba
import numpy as np

from estimator.kernels.densities import MODEL, Model
from plume.compiled import kernel
from plume.elementary import Array
from plume.kernels import DERIVED, derive, squares_of_puffs, wind_of


@kernel(numba.float64[::1](numba.float64[:, ::1], numba.float64[::1], numba.float64, MODEL))
def cvs_downwind(particles: Array, reading: Array, distance_m: float, model: Model) -> Array:
    """Return the coefficient of variation of the gas at a distance downwind of the source: (N,).

    particles: (D, N).  reading: a row of `Config.row`, for the wind.
    """
    count = particles.shape[1]
    derived, squares = np.empty((DERIVED, count)), np.empty(count)
    derive(particles, count, model.unknowns, model.priors, derived)
    _, cosine, sine = wind_of(reading, model.priors)
    for i in range(count):  # the source is moved upwind of the reading's place
        derived[0, i] = reading[0] + distance_m * (cosine * derived[7, i] - sine * derived[8, i])
        derived[1, i] = reading[1] + distance_m * (sine * derived[7, i] + cosine * derived[8, i])
        derived[2, i] = reading[2]
    squares_of_puffs(derived, count, reading, model.priors, model.sensor, squares)
    for i in range(count):
        squares[i] = math.sqrt(squares[i])
    return squares
