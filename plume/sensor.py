"""The gas sensor: a Gaussian reading whose noise grows with the concentration; simulator and likelihood share it."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

SENSOR_NOISE = 0.3
"""α: standard deviation as a share of the concentration."""
ENVIRONMENT_NOISE = 0.2
"""β: standard deviation in clean air, g/m³."""


def noise_std(mean: ArrayLike) -> NDArray[np.float64]:
    """σ(m) = sqrt((α m)² + β²): two independent noises add in quadrature."""
    return np.sqrt(np.square(SENSOR_NOISE * np.asarray(mean, np.float64)) + ENVIRONMENT_NOISE**2)


def measure(mean: ArrayLike, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a reading z = m + v, v ~ N(0, σ(m)²), for each mean concentration."""
    mean = np.asarray(mean, np.float64)
    return np.asarray(mean + noise_std(mean) * rng.standard_normal(mean.shape))


def log_likelihood(reading: ArrayLike, mean: ArrayLike) -> NDArray[np.float64]:
    """log N(z; m, σ(m)²) with its normaliser, which differs between hypotheses because σ depends on m."""
    std = noise_std(mean)
    residual = np.asarray(reading, np.float64) - np.asarray(mean, np.float64)
    return np.asarray(-0.5 * np.square(residual / std) - np.log(std) - 0.5 * np.log(2 * np.pi))
