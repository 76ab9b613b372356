"""Protects the sensor: the moments of its noise and the normaliser of its likelihood."""

import math

import numpy as np
import pytest

from plume.sensor import log_likelihood, measure, noise_std

DRAWS = 200_000


@pytest.mark.parametrize(("mean", "std"), [(0.0, 0.2), (1.0, math.sqrt(0.13)), (10.0, math.sqrt(9.04))])
def test_the_noise_has_the_moments_that_the_two_noises_add_up_to(mean: float, std: float) -> None:
    readings = measure(np.full(DRAWS, mean), np.random.default_rng(1))
    # Margins of 4 standard errors: of the mean σ/√n, of the standard deviation σ/√(2n).
    assert readings.mean() == pytest.approx(mean, abs=4 * std / math.sqrt(DRAWS))
    assert readings.std() == pytest.approx(std, abs=4 * std / math.sqrt(2 * DRAWS))


def test_the_noise_is_gaussian() -> None:
    readings = (measure(np.full(DRAWS, 3.0), np.random.default_rng(2)) - 3.0) / math.sqrt(0.81 + 0.04)
    # Standard errors of skewness √(6/n) and of the excess kurtosis √(24/n); 4 of them are allowed.
    assert (readings**3).mean() == pytest.approx(0.0, abs=4 * math.sqrt(15 / DRAWS))
    assert (readings**4).mean() == pytest.approx(3.0, abs=4 * math.sqrt(96 / DRAWS))


def test_the_likelihood_is_a_density() -> None:
    readings = np.linspace(-60.0, 80.0, 2_000_001)
    for mean in (0.0, 0.5, 10.0):
        density = np.exp(log_likelihood(readings, mean))
        assert np.trapezoid(density, readings) == pytest.approx(1.0, abs=1e-9)


def test_the_likelihood_equals_the_hand_worked_value() -> None:
    # m = 2, z = 3: σ² = 0.36 + 0.04 = 0.4;  log p = −1/0.8 − ½ log(0.4) − ½ log(2π) = −1.25 + 0.4581454 − 0.9189385
    assert log_likelihood(3.0, 2.0) == pytest.approx(-1.7107932, abs=1e-7)
    assert noise_std(2.0) == pytest.approx(math.sqrt(0.4))
