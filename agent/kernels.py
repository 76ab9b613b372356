"""The planners' fused loops, compiled by numba and cached. Plain IEEE arithmetic in a fixed order: the same bits on every run."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit("float64[::1](float64[:, ::1], float64[:, ::1], float64[::1], int64[::1], float64[::1])", cache=True)
def expected_divergence(mean: Array, std: Array, weights: Array, imagined: NDArray[np.int64], noise: Array) -> Array:
    """Mean over imagined readings of KL(posterior ‖ prior), nats, for each move (A,).

    mean, std: (A, N) of the reading at each move under each particle.  weights: (N,), sum one.  Imagined reading k of a move is
    the one of particle imagined[k] with noise[k] standard deviations: a draw from the predictive density.
    """
    moves, count = mean.shape
    gains = np.empty(moves)
    log_std = np.empty(count)
    inverse_std = np.empty(count)
    for a in range(moves):
        lowest = math.inf
        for i in range(count):
            log_std[i] = math.log(std[a, i])
            inverse_std[i] = 1 / std[a, i]
            lowest = min(lowest, log_std[i])
        gain = 0.0
        for k in range(len(imagined)):
            reading = mean[a, imagined[k]] + std[a, imagined[k]] * noise[k]
            total = 0.0
            weighted = 0.0
            for i in range(count):
                residual = (reading - mean[a, i]) * inverse_std[i]
                log_likelihood = -0.5 * residual * residual - (log_std[i] - lowest)  # at most zero: no overflow
                likelihood = weights[i] * math.exp(log_likelihood)
                total += likelihood
                weighted += likelihood * log_likelihood
            gain += weighted / total - math.log(total)
        gains[a] = gain / len(imagined)
    return gains
