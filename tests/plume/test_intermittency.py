"""Protects intermittent gas: draws, likelihood and compiled loops share one definition, gamma gas plus
normal noise.
"""

import itertools
import math

import numpy as np
import pytest
from numba import njit

from plume import intermittency
from plume.randomness import Abreast, Keyed, keyed
from plume.scenario import draw
from plume.sensor import Gaussian, Threshold
from plume.worlds.world import World, readings_of

CVS = (0.02, 0.04, 0.075, 0.13, 0.33, 0.71, 1.0, 1.1, 1.6, 2.1, 2.625, 2.975, 3.0)
"""From nearly steady to the strongest; several lie between the rows of the kernel's table."""
PROBABLE = -60.0
"""Log-densities above this matter: no filter can tell e^-60 from 0."""


def exact(gas: float, mean: float, std: float, cv: float) -> float:
    """Log of ∫ Gamma(c; k, m/k) N(z − c; 0, σ²) dc by adaptive quadrature over log c, from its one mode
    outwards.
    """
    from scipy import integrate, optimize

    k = 1 / cv**2

    def exponent(log_c: float) -> float:
        return k * log_c - k * math.exp(log_c) / mean - 0.5 * ((gas - math.exp(log_c)) / std) ** 2

    def slope(log_c: float) -> float:
        return k - k * math.exp(log_c) / mean + (gas - math.exp(log_c)) * math.exp(log_c) / std**2

    mode = optimize.brentq(slope, -500.0, math.log(1e3 * (mean + abs(gas) + std)), xtol=1e-13)
    total = 0.0
    for side in (-1, 1):
        far = 1e-6
        while exponent(mode + side * far) > exponent(mode) - 40 and far < 600:
            far *= 1.6
        total += integrate.quad(
            lambda off, side=side: math.exp(exponent(mode + side * off) - exponent(mode)),
            0,
            far,
            epsabs=0,
            limit=300,
        )[0]
    return (
        exponent(mode)
        + math.log(total)
        - math.lgamma(k)
        - k * math.log(mean / k)
        - math.log(std * math.sqrt(2 * math.pi))
    )


@njit
def kernel_densities(gas: np.ndarray, mean: np.ndarray, variance: np.ndarray, cv: np.ndarray) -> np.ndarray:
    result = np.empty(len(gas))
    for i in range(len(gas)):
        result[i] = intermittency.log_density(gas[i], mean[i], variance[i], cv[i])
    return result


@njit
def kernel_distributions(
    gas: np.ndarray, mean: np.ndarray, variance: np.ndarray, cv: np.ndarray
) -> np.ndarray:
    result, cells = np.empty(len(gas)), np.empty(intermittency.BODY + intermittency.TAIL)
    for i in range(len(gas)):
        result[i] = intermittency.distribution(gas[i], mean[i], variance[i], cv[i], cells)
    return result


def cases(cv: float) -> np.ndarray:
    """(4, M): gas, mean, std, cv; means over seven decades, noise a third, one and three times the
    sensor's, readings on all sides.
    """
    rows = []
    for mean in np.geomspace(1e-4, 1e3, 8).tolist():
        for factor in (0.3, 1.0, 3.0):
            std = factor * math.hypot(0.3 * mean, 0.2)
            both = math.hypot(std, cv * mean)
            rows += [(x * std, mean, std, cv) for x in (-10.0, -2.0, 0.0)] + [
                (mean + x * both, mean, std, cv) for x in (-3.0, 0.0, 1.0, 5.0, 12.0)
            ]
    return np.array(rows).T


@pytest.mark.parametrize("cv", CVS)
def test_the_compiled_density_is_the_integral_over_the_gas(cv: float) -> None:
    gas, mean, std, cvs = cases(cv)
    expected = np.array([exact(*row) for row in cases(cv).T.tolist()])
    error = np.abs(kernel_densities(gas, mean, std**2, cvs) - expected)
    probable = expected > PROBABLE
    assert probable.sum() > 100
    # The table is linear between its nodes. What it interpolates bends with the intermittency: the error
    # grows with the fourth power.
    assert error[probable].max() < (0.005 if cv > 2 else 0.0015 if cv > 1.2 else 0.0003)


@pytest.mark.parametrize("cv", [0.1, 0.7, 1.0, 2.0, 3.0])
def test_the_sensors_likelihood_is_the_same_integral(cv: float) -> None:
    for factor in (1.0, 3.0):
        sensor = Gaussian(0.3 * factor, 0.2 * factor, cv)
        for mean in (1e-3, 0.1, 1.0, 20.0, 1000.0):
            std = factor * math.hypot(0.3 * mean, 0.2)
            gas = np.array([-2 * std, 0.0, 0.5 * mean, mean, 3 * mean + std])
            expected = [exact(z, mean, std, cv) for z in gas.tolist()]
            assert sensor.log_likelihood(gas, mean) == pytest.approx(expected, abs=1e-3)


def test_nearly_steady_gas_is_steady_gas() -> None:
    mean = np.repeat(np.geomspace(1e-4, 1e3, 8), 5)
    std = Gaussian().noise_std(mean)
    gas = mean + np.tile([-3.0, -1.0, 0.0, 1.0, 3.0], 8) * std
    steady = Gaussian().log_likelihood(gas, mean)
    # The gas's own variance, cv² m², is at most 1e-4/0.09 of the noise's: at 3 standard deviations ½ (9 − 1)
    # of that, and its skew.
    assert kernel_densities(gas, mean, std**2, np.zeros(40)) == pytest.approx(steady, abs=0.006)
    assert Gaussian(cv=0.0).log_likelihood(gas, mean) == pytest.approx(steady, abs=0)


def test_the_worked_case_of_exponential_gas() -> None:
    # cv = 1: gas is exponential with mean m. Completing the square, p(z) = Φ(z/σ − σ/m) exp(σ²/(2m²) −
    # z/m)/m. With m = 2, z = 1:
    # σ² = 0.36 + 0.04 = 0.4; z/σ − σ/m = 1.581139 − 0.316228 = 1.264911; Φ = 0.8970484; exp(0.05 − 0.5)/2 =
    # 0.3188141.
    assert Gaussian(cv=1.0).log_likelihood(1.0, 2.0) == pytest.approx(
        math.log(0.8970484 * 0.3188141), abs=1e-4
    )
    assert exact(1.0, 2.0, math.sqrt(0.4), 1.0) == pytest.approx(math.log(0.8970484 * 0.3188141), abs=1e-6)


@pytest.mark.parametrize("cv", [0.3, 1.0, 2.0, 3.0])
def test_the_compiled_distribution_is_the_integral_over_the_noise(cv: float) -> None:
    """P(c + v ≤ z) = E over v of the gamma's own distribution function at z − v."""
    from scipy import stats

    noise = np.linspace(-8.0, 8.0, 20_001)
    weight = np.exp(-0.5 * noise**2)
    weight /= weight.sum()
    for mean in (0.01, 0.3, 1.0, 20.0):
        std = math.hypot(0.3 * mean, 0.2)
        gas = np.array([-2 * std, 0.0, 0.5 * mean, mean, 2 * mean, mean + 3 * math.hypot(std, cv * mean)])
        expected = [weight @ stats.gamma.cdf(z - std * noise, 1 / cv**2, scale=mean * cv**2) for z in gas]
        ones = np.ones(len(gas))
        assert kernel_distributions(gas, mean * ones, std**2 * ones, cv * ones) == pytest.approx(
            expected, abs=0.01
        )


@pytest.mark.parametrize("mean", [0.0, 0.5, 8.0])
@pytest.mark.parametrize("cv", [0.3, 1.0, 2.5])
def test_readings_follow_the_density(cv: float, mean: float) -> None:
    sensor, count = Gaussian(cv=cv), 100_000
    readings = sensor.measure(np.full(count, mean), np.random.default_rng(3))
    std = math.hypot(cv * mean, math.hypot(0.3 * mean, 0.2))  # of the gas and of the noise, independent
    # 4 standard errors. A gamma variable's fourth moment is (3 + 6 cv²) std⁴, so a variance errs by √((2 + 6
    # cv²)/n).
    assert readings.mean() == pytest.approx(mean, abs=4 * std / math.sqrt(count))
    assert readings.var() == pytest.approx(std**2, rel=4 * math.sqrt((2 + 6 * cv**2) / count))
    noise = math.hypot(0.3 * mean, 0.2)
    edges = np.quantile(readings, np.linspace(0.02, 0.98, 25))
    for low, high in itertools.pairwise(edges):
        z = np.linspace(low, high, 41)
        share = np.trapezoid(np.exp(sensor.log_likelihood(z, mean)), z)
        # Each of 24 shares is 4% of the draws; 5 standard errors, with both edges estimated.
        assert share == pytest.approx(0.04, abs=5 * math.sqrt(0.04 / count) + 1e-4)
    if mean > 0:
        below = np.mean(readings <= 0.5 * mean)
        expected = kernel_distributions(
            np.array([0.5 * mean]), np.array([mean]), np.array([noise**2]), np.array([cv])
        )[0]
        assert below == pytest.approx(expected, abs=4 * 0.5 / math.sqrt(count) + 0.01)


def test_the_simulated_sensor_reads_the_gas_that_it_is_told() -> None:
    gas = np.array([1.0, 5.0])
    said = Gaussian(1e-9, 1e-9, 1.0).measure(np.full(2, 3.0), np.random.default_rng(1), gas)
    assert said == pytest.approx(gas, abs=1e-6)
    assert Threshold(0.5, 0.0, 1e-9, 1e-9).measure(
        np.full(2, 3.0), np.random.default_rng(1), gas
    ) == pytest.approx(gas, abs=1e-6)


def test_gamma_variables_side_by_side_are_those_drawn_alone() -> None:
    keys = [(11, "sensor", 4), (12, "sensor", 4), (11, "sensor", 5)]
    abreast = Abreast(Keyed(), keys)
    noise, gas = abreast.standard_normal((3,)), abreast.standard_gamma(0.25, (3,))
    for i, key in enumerate(keys):
        alone = keyed(*key)
        assert (noise[i], gas[i]) == (alone.standard_normal(), alone.standard_gamma(0.25))


def test_worlds_in_intermittent_gas_read_the_same_together_as_alone() -> None:
    worlds = [World(draw(seed), seed, Gaussian(cv=1.5)) for seed in (3, 4, 5)]
    places = np.array([[12.0, 15.0], [14.0, 13.0], [20.0, 20.0]])
    together = readings_of(worlds, places, [7, 8, 9], np.zeros(3), Keyed())[0]
    alone = [
        world.gas((x, y), step)
        for world, (x, y), step in zip(worlds, places.tolist(), (7, 8, 9), strict=True)
    ]
    assert together.tolist() == alone
    steady = [
        World(draw(seed), seed).gas((x, y), step)
        for seed, (x, y), step in zip((3, 4, 5), places.tolist(), (7, 8, 9), strict=True)
    ]
    assert together.tolist() != steady
