"""Protects intermittent gas: draws, likelihood and compiled loops share one definition, inverse Gaussian gas
plus normal noise.
"""

import itertools
import math

import numpy as np
import pytest
from numba import njit

from plume import intermittency
from plume.randomness import Abreast, Keyed, inverse_gaussian, keyed
from plume.scenario import draw
from plume.sensors.sensor import Gaussian, Threshold, fluctuating
from plume.worlds.world import World, readings_of

CVS = (0.02, 0.04, 0.075, 0.13, 0.33, 0.71, 1.0, 1.2, 1.6, 2.1, 3.0, 4.7, 8.0, 14.0, 30.0)
"""From nearly steady gas to the rarest puffs."""
PROBABLE = -60.0
"""Log-densities above this matter: no filter can tell e^-60 from 0."""


def exact(gas: float, mean: float, std: float, cv: float) -> float:
    """Log of ∫ IG(c; m, m/cv²) N(z − c; 0, σ²) dc by adaptive quadrature over x = log(c/m), in pieces that
    end where the gas near 0, its mean or the noise may have a peak.
    """
    from scipy import integrate

    lam = 1 / cv**2  # of the gas in units of its mean

    def exponent(x: float) -> float:
        # In x, the inverse Gaussian density is √(λ/2π) e^(−x/2) exp(−λ (cosh x − 1)).
        return -0.5 * x - 2 * lam * math.sinh(x / 2) ** 2 - 0.5 * ((gas - mean * math.exp(x)) / std) ** 2

    far = math.acosh(1 + 120 / lam)
    knots = {-far, far, 0.0, math.log(math.hypot(1.0, 1.5 / lam) - 1.5 / lam)}
    for sigmas in (-8.0, -3.0, -1.0, 0.0, 1.0, 3.0, 8.0):
        if gas + sigmas * std > 0:
            knots.add(math.log((gas + sigmas * std) / mean))
    ends = np.array(sorted(knot for knot in knots if -far <= knot <= far))
    pieces = list(
        itertools.pairwise(np.interp(np.linspace(0, 1, 4 * len(ends)), np.linspace(0, 1, len(ends)), ends))
    )
    top = max(exponent(x) for piece in pieces for x in np.linspace(*piece, 20))
    total = sum(
        integrate.quad(lambda x: math.exp(exponent(x) - top), *piece, epsabs=1e-12, limit=200)[0]
        for piece in pieces
    )
    return top + math.log(total) + 0.5 * math.log(lam) - math.log(2 * math.pi * std)


@njit
def kernel_densities(gas: np.ndarray, mean: np.ndarray, variance: np.ndarray, cv: np.ndarray) -> np.ndarray:
    result = np.empty(len(gas))
    for i in range(len(gas)):
        result[i] = intermittency.density(gas[i], mean[i], variance[i], cv[i] * cv[i])
    return result


@njit
def kernel_distributions(
    gas: np.ndarray, mean: np.ndarray, variance: np.ndarray, cv: np.ndarray
) -> np.ndarray:
    result = np.empty((2, len(gas)))
    intermittency.distributions(gas, mean, variance, cv * cv, result[0])
    for i in range(len(gas)):
        result[1, i] = intermittency.exceeding(gas[i], mean[i], variance[i], cv[i] * cv[i])
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


@pytest.mark.one_in(3)
@pytest.mark.parametrize("cv", CVS)
def test_the_compiled_density_is_the_integral_over_the_gas(cv: float) -> None:
    gas, mean, std, cvs = cases(cv)
    expected = np.array([exact(*row) for row in cases(cv).T.tolist()])
    probable = expected > PROBABLE
    assert probable.sum() > 140
    found = np.log(kernel_densities(gas, mean, std**2, cvs)[probable])
    error = np.abs(found - expected[probable])
    # The table is linear between its nodes. Gas in puffs piles up near 0, and between that and the gas of the
    # reading the factor bends sharply: a few readings there err more, all others hardly.
    assert error.max() < (0.002 if cv < 0.4 else 0.005 if cv < 2 else 0.03 if cv < 9 else 0.08)
    assert np.quantile(error, 0.95) < (0.001 if cv < 0.4 else 0.003 if cv < 5 else 0.013)


@pytest.mark.parametrize("step", [12, pytest.param(1, marks=pytest.mark.full)])
def test_the_files_table_is_what_quadrature_gives_to_the_last_bit(step: int) -> None:
    rows = range(0, intermittency.SQUARE_CELLS + 1, step)
    computed = np.array([intermittency.correction_row(row) for row in rows])
    assert np.array_equal(np.load(intermittency.CORRECTIONS_FILE)[::step], computed), (
        "after a change of the law: numpy.save(CORRECTIONS_FILE, all rows of correction_row)"
    )


def test_without_noise_the_integral_is_scipys_inverse_gaussian_density() -> None:
    from scipy import stats

    for cv, mean, gas in ((0.3, 2.0, 1.5), (1.0, 2.0, 1.0), (5.0, 1.0, 0.05), (30.0, 1.0, 3.0)):
        expected = stats.invgauss.logpdf(gas, cv**2, scale=mean / cv**2)
        # The noise's variance times half the density's second derivative by the density: below 1e-5.
        assert exact(gas, mean, 1e-4, cv) == pytest.approx(expected, abs=2e-5)


def test_the_parts_of_a_reading_worked_by_hand() -> None:
    # cv = 1, m = 2, α = 0.3, β = 0.2: b = 0.4 · 1/2 = 0.2. The gas of the other readings has the mean 2/0.8 =
    # 2.5 and E c² = 2² · 2/0.8 = 10, so its squared cv is 10/6.25 − 1 = 0.6. α² E c² = 0.09 · 6.25 · 1.6 = 0.9
    # is the variance of noise α c ε. Of its part 0.09 · 6.25 = 0.5625 the share 0.09/0.69 = 0.130435 is normal,
    # 0.0733696, and 0.0733696 + 0.04 = 0.1133696 with β². The rest, 0.8266304, goes with the gas: its squared
    # cv becomes 0.6 + 0.8266304/6.25 = 0.7322609.
    gas = fluctuating(np.array(2.0), 1.0, 0.3, 0.2)
    assert gas.blank == pytest.approx(0.2)
    assert gas.mean == pytest.approx(2.5)
    assert gas.square == pytest.approx(0.7322609, rel=1e-6)
    assert gas.std == pytest.approx(math.sqrt(0.1133696), rel=1e-6)
    # A blank has the noise of the mean: z = 1 has the density exp(−1/0.8)/√(2π · 0.4) = 0.1807223.
    there = math.exp(exact(1.0, 2.5, math.sqrt(0.1133696), math.sqrt(0.7322609)))
    assert Gaussian(cv=1.0).log_likelihood(1.0, 2.0) == pytest.approx(
        math.log(0.2 * 0.1807223 + 0.8 * there), abs=1e-5
    )


def mixture(gas: float, mean: float, cv: float, slope: float, floor: float) -> float:
    """Log-density of a reading, from the moments of the gas: see the case worked by hand."""
    blank = 0.4 * cv**2 / (1 + cv**2)
    there, mean_square = mean / (1 - blank), mean**2 * (1 + cv**2) / (1 - blank)
    own = mean_square / there**2 - 1
    normal = slope**2 * there**2 * slope**2 / (slope**2 + own)
    of_gas = own * there**2 + slope**2 * mean_square - normal
    nothing = -0.5 * gas**2 / (slope**2 * mean**2 + floor**2)
    nothing -= 0.5 * math.log(2 * math.pi * (slope**2 * mean**2 + floor**2))
    something = exact(gas, there, math.sqrt(normal + floor**2), math.sqrt(of_gas) / there)
    return float(np.logaddexp(math.log(blank) + nothing, math.log(1 - blank) + something))


@pytest.mark.parametrize("cv", [0.1, 0.7, 1.0, 2.0, 3.0])
def test_the_sensors_likelihood_is_that_of_blanks_and_of_gas(cv: float) -> None:
    for factor in (1.0, 3.0):
        slope, floor = 0.3 * factor, 0.2 * factor
        for mean in (1e-3, 0.1, 1.0, 20.0, 1000.0):
            std = factor * math.hypot(0.3 * mean, 0.2)
            gas = np.array([-2 * std, 0.0, 0.5 * mean, mean, 3 * mean + std])
            expected = [mixture(z, mean, cv, slope, floor) for z in gas.tolist()]
            assert Gaussian(slope, floor, cv).log_likelihood(gas, mean) == pytest.approx(expected, abs=1e-4)


def test_nearly_steady_gas_is_steady_gas() -> None:
    mean = np.repeat(np.geomspace(1e-4, 1e3, 8), 5)
    std = Gaussian().noise_std(mean)
    gas = mean + np.tile([-3.0, -1.0, 0.0, 1.0, 3.0], 8) * std
    steady = Gaussian().log_likelihood(gas, mean)
    # The gas's own variance, cv² m², is at most 1e-4/0.09 of the noise's: at 3 standard deviations ½ (9 − 1)
    # of that, its skew, and 0.001 of the table.
    assert np.log(kernel_densities(gas, mean, std**2, np.zeros(40))) == pytest.approx(steady, abs=0.006)
    # With cv = 0.003, 4e-6 of the readings are blank, and the noise that goes with the gas hardly skews it.
    assert Gaussian(cv=0.003).log_likelihood(gas, mean) == pytest.approx(steady, abs=0.006)
    assert Gaussian(cv=0.0).log_likelihood(gas, mean) == pytest.approx(steady, abs=0)


@pytest.mark.parametrize("cv", [0.3, 1.0, 2.0, 3.0, 8.0, 30.0])
def test_the_compiled_distribution_is_the_integral_over_the_noise(cv: float) -> None:
    """P(c + v ≤ z) = E over v of the inverse Gaussian's own distribution function at z − v."""
    from scipy import stats

    noise = np.linspace(-8.0, 8.0, 20_001)
    weight = np.exp(-0.5 * noise**2)
    weight /= weight.sum()
    law = stats.invgauss(cv**2, scale=1 / cv**2)
    for mean in (0.01, 0.3, 1.0, 20.0):
        std = math.hypot(0.3 * mean, 0.2)
        gas = np.array([-2 * std, 0.0, 0.5 * mean, mean, 2 * mean, mean + 3 * math.hypot(std, cv * mean)])
        expected = np.array([weight @ law.cdf((z - std * noise) / mean) for z in gas])
        ones = np.ones(len(gas))
        below, above = kernel_distributions(gas, mean * ones, std**2 * ones, cv * ones)
        assert below == pytest.approx(expected, abs=0.01)
        assert above == pytest.approx(1 - expected, abs=0.01)


def test_the_probability_to_exceed_keeps_the_digits_of_small_ones() -> None:
    """Far above, the gas's own tail; far above in weak gas, the noise's: 3e-7 at 5 standard deviations."""
    from scipy import stats

    ones = np.ones(1)
    for cv in (0.5, 1.0, 3.0, 8.0):
        for beyond in (1e-2, 1e-3):
            gas = ones * stats.invgauss.isf(beyond, cv**2, scale=20 / cv**2)
            # Of the tail, cells are halved each time: between a half and twice.
            assert 0.5 < kernel_distributions(gas, 20 * ones, 0.01 * ones, cv * ones)[1, 0] / beyond < 2
    above = kernel_distributions(5 * ones, 1e-9 * ones, ones, 0.5 * ones)[1, 0]
    assert above == pytest.approx(stats.norm.sf(5.0), rel=1e-6)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("mean", [0.0, 0.5, 8.0])
@pytest.mark.parametrize("cv", [0.3, 1.0, 2.5])
def test_readings_follow_the_density(cv: float, mean: float) -> None:
    sensor, count = Gaussian(cv=cv), 100_000
    readings = sensor.measure(np.full(count, mean), np.random.default_rng(3))
    # The gas has the variance cv² m². Noise α c ε of it has α² E c² = α² m² (1 + cv²). A blank has the noise
    # of the mean on top, α² m², and all readings have β².
    blank = 0.4 * cv**2 / (1 + cv**2)
    variance = (cv * mean) ** 2 + (0.3 * mean) ** 2 * (1 + cv**2 + blank) + 0.04
    # 4 standard errors; that of the variance is of the squares, as drawn.
    assert readings.mean() == pytest.approx(mean, abs=4 * math.sqrt(variance / count))
    squares = np.square(readings - mean)
    assert readings.var() == pytest.approx(variance, abs=4 * squares.std() / math.sqrt(count))
    assert squares.std() / math.sqrt(count) < 0.06 * variance  # so that this says something
    edges = np.quantile(readings, np.linspace(0.02, 0.98, 25))
    for low, high in itertools.pairwise(edges):
        z = np.linspace(low, high, 41)
        share = np.trapezoid(np.exp(sensor.log_likelihood(z, mean)), z)
        # Each of 24 shares is 4% of the draws; 5 standard errors, with both edges estimated.
        assert share == pytest.approx(0.04, abs=5 * math.sqrt(0.04 / count) + 1e-4)


def test_a_factor_on_the_noise_is_that_of_a_sensor_with_so_much_more() -> None:
    usual, doubled = Gaussian(0.3, 0.2, 1.5), Gaussian(0.6, 0.4, 1.5)
    means = np.full(1000, 2.0)
    one = usual.measure(means, np.random.default_rng(4), noise=2.0)
    assert one == pytest.approx(doubled.measure(means, np.random.default_rng(4)), rel=1e-12)
    each = usual.measure(means, np.random.default_rng(4), noise=np.full(1000, 2.0))
    assert each == pytest.approx(one, rel=1e-12)


@pytest.mark.parametrize("square", [0.01, 0.7, 5.0, 100.0])
def test_drawn_gas_is_inverse_gaussian(square: float) -> None:
    from scipy import stats

    count = 100_000
    drawn = inverse_gaussian(square, np.random.default_rng(6), (count,))
    law = stats.invgauss(square, scale=1 / square)
    assert drawn.min() > 0
    # Its fourth cumulant is 15 S³, so a variance errs by √((2 S² + 15 S³)/n); 4 standard errors.
    assert drawn.mean() == pytest.approx(1.0, abs=4 * math.sqrt(square / count))
    assert drawn.var() == pytest.approx(square, abs=4 * math.sqrt((2 * square**2 + 15 * square**3) / count))
    assert stats.kstest(drawn, law.cdf).pvalue > 0.001
    # The lower tail, which the roots of the quadratic could lose to rounding.
    assert np.mean(drawn < law.ppf(0.01)) == pytest.approx(0.01, abs=4 * math.sqrt(0.01 / count))


def test_the_simulated_sensor_reads_the_gas_that_it_is_told() -> None:
    gas = np.array([1.0, 5.0])
    said = Gaussian(1e-9, 1e-9, 1.0).measure(np.full(2, 3.0), np.random.default_rng(1), gas)
    assert said == pytest.approx(gas, abs=1e-6)
    assert Threshold(0.5, 0.0, 1e-9, 1e-9).measure(
        np.full(2, 3.0), np.random.default_rng(1), gas
    ) == pytest.approx(gas, abs=1e-6)


def test_variables_side_by_side_are_those_drawn_alone() -> None:
    keys = [(11, "sensor", 4), (12, "sensor", 4), (11, "sensor", 5)]
    abreast = Abreast(Keyed(), keys)
    noise, gas = abreast.standard_normal((3,)), abreast.standard_gamma(0.25, (3,))
    puffs = inverse_gaussian(0.7, abreast, (3,))
    for i, key in enumerate(keys):
        alone = keyed(*key)
        assert (noise[i], gas[i]) == (alone.standard_normal(), alone.standard_gamma(0.25))
        assert puffs[i] == inverse_gaussian(0.7, alone, (1,))[0]


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
