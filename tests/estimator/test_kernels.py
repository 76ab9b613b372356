"""Protects the compiled kernels: each equals the readable formula, and the moves leave the posterior invariant."""

import math
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from estimator.filter import Config
from estimator.kernels.checks import uniformity_p_value
from estimator.kernels.densities import log_likelihoods, log_priors
from estimator.kernels.draws import key_of, uniform
from estimator.kernels.moves import metropolis
from estimator.kernels.weights import effective_sample_size, moments, systematic
from estimator.priors import Gamma, Normal, Prior, Uniform
from plume import numerics
from plume.dispersion import concentration
from plume.sensor import GAUSSIAN, Hits, Sensor, Threshold

CONFIG = Config(rate=270.0, diffusivity=4.2)
READING = np.array([14.0, 13.0, 0.0, 1.9, 2.6, 3.75])
EIGHT: dict[str, Prior] = {
    "z": Uniform(0.0, 5.0), "q": Gamma(2.0, 150.0), "u": Normal(2.5, 0.5), "phi": Normal(1.0, 0.2), "d": Uniform(1.0, 8.0),
    "tau": Uniform(5.0, 20.0),
}  # fmt: skip


def draws(config: Config, count: int, seed: int = 1) -> np.ndarray:
    """Particles (D, count) spread widely over the unknowns."""
    ranges = {"x": (0, 30), "y": (0, 30), "z": (0, 5), "q": (50, 900), "u": (0.5, 4), "phi": (-7, 7), "d": (1, 8), "tau": (5, 20)}
    rng = np.random.default_rng(seed)
    return np.array([rng.uniform(*ranges[name], count) for name in config.unknowns])


def readable(config: Config, particles: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Log-likelihoods by the formulas of plume/."""
    value = dict(zip(config.unknowns, particles, strict=True))
    x, y, z = np.broadcast_arrays(value["x"], value["y"], value.get("z", 0.0))
    speed = value.get("u", math.hypot(reading[3], reading[4]))
    direction = value.get("phi", math.atan2(reading[4], reading[3]))
    wind = np.stack(np.broadcast_arrays(speed * np.cos(direction), speed * np.sin(direction)), axis=-1)
    mean = concentration(
        reading[:3], np.stack([x, y, z], axis=-1), wind, rate=value.get("q", config.rate), diffusivity=value.get("d", config.diffusivity),
        lifetime=value.get("tau", config.lifetime),
    )  # fmt: skip
    return config.sensor.log_likelihood(reading[5], mean)


@njit
def exp_and_log(values: np.ndarray) -> np.ndarray:
    """e^v and ln |v| as the kernels compute them."""
    result = np.empty((2, len(values)))
    for i in range(len(values)):
        result[0, i] = numerics.exp(values[i])
        result[1, i] = numerics.log(abs(values[i]))
    return result


@njit
def uniforms(seed: int, step: int, count: int) -> np.ndarray:
    """The first draws of a sequence."""
    key = key_of(np.uint64(seed), step, 0, 0)
    result = np.empty(count)
    for i in range(count):
        result[i] = uniform(key, i)
    return result


def fused(config: Config, particles: np.ndarray, reading: np.ndarray) -> np.ndarray:
    return log_likelihoods(particles, config.unknown_indices, config.prior_rows, config.sensor_row, reading)


def test_the_polynomials_are_exp_and_log() -> None:
    values = np.concatenate([np.linspace(-700, 700, 200_001), np.geomspace(1e-300, 1e300, 100_001), -np.geomspace(1e-12, 1, 10_001)])
    exp, log = exp_and_log(values)
    inside = np.abs(values) <= 700
    assert np.abs(exp[inside] / np.exp(values[inside]) - 1).max() < 4.5e-16  # two units in the last place
    nonzero = values != 0
    expected = np.log(np.abs(values[nonzero]))
    assert np.all(np.abs(log[nonzero] - expected) <= 4.5e-16 * np.maximum(np.abs(expected), 1))


def test_what_is_drawn_is_uniform_and_uncorrelated() -> None:
    draws = uniforms(5, 7, 1_000_000)
    assert 0 < draws.min() < draws.max() < 1
    counts = np.histogram(draws, 1000, (0, 1))[0]
    chi_square = np.sum((counts - 1000) ** 2 / 1000)
    assert abs(chi_square - 999) < 4 * math.sqrt(2 * 999)  # 4 standard deviations
    for lag in (1, 2, 4):
        assert abs(np.corrcoef(draws[:-lag], draws[lag:])[0, 1]) < 4 / 1000
    other = uniforms(5, 8, 1_000_000)
    assert abs(np.corrcoef(draws, other)[0, 1]) < 4 / 1000


@pytest.mark.parametrize("priors", [{}, {"q": Gamma(2.0, 150.0)}, {"u": Normal(2.5, 0.5)}, {"phi": Uniform(0, 6.2)}, EIGHT], ids=len)
@pytest.mark.parametrize(("sensor", "gas"), [(GAUSSIAN, 3.75), (Threshold(), 3.75), (Threshold(), 0.0), (Hits(), 11.0), (Hits(), 0.0)])
def test_the_fused_likelihood_equals_the_readable_one(priors: dict[str, Prior], sensor: Sensor, gas: float) -> None:
    config = Config(rate=270.0, diffusivity=4.2, priors=priors, sensor=sensor)
    particles = draws(config, 5000)
    reading = np.array([14.0, 13.0, 5.0 if "z" in priors else 0.0, 1.9, 2.6, gas])
    assert fused(config, particles, reading) == pytest.approx(readable(config, particles, reading), rel=1e-11, abs=1e-11)


def test_the_fused_likelihood_clamps_the_distance_too() -> None:
    at_the_source = np.array([[14.0, 14.0], [13.0, 13.1]])
    assert fused(CONFIG, at_the_source, READING) == pytest.approx(readable(CONFIG, at_the_source, READING), rel=1e-12)


def test_effective_sample_size_counts_equal_weights_and_ignores_a_common_factor() -> None:
    assert effective_sample_size(np.full(8, 1e-200) ** 0.5) == pytest.approx(8.0)
    assert effective_sample_size(np.array([0.5, 0.5, 1e-300])) == pytest.approx(2.0)
    assert effective_sample_size(np.array([8.0, 2.0])) == pytest.approx(1 / (0.64 + 0.04))


def test_moments_equal_the_hand_worked_values() -> None:
    particles = np.array([[0.0, 4.0, 0.0], [0.0, 0.0, 2.0]])
    mean, covariance = moments(particles, np.array([2.0, 1.0, 1.0]))
    # mean (1, 0.5);  xx = 4 − 1, xy = 0 − 0.5, yy = 1 − 0.25
    assert mean == pytest.approx([1.0, 0.5])
    assert covariance == pytest.approx(np.array([[3.0, -0.5], [-0.5, 0.75]]))


@pytest.mark.parametrize("count", [1, 7, 8, 1001])
def test_moments_of_any_number_of_particles_equal_numpys(count: int) -> None:
    rng = np.random.default_rng(6)
    particles, weights = rng.normal(5, 2, (3, count)), rng.random(count)
    mean, covariance = moments(particles, weights)
    assert mean == pytest.approx(np.average(particles, axis=1, weights=weights))
    assert covariance == pytest.approx(np.cov(particles, aweights=weights, ddof=0).reshape(3, 3), abs=1e-12)


def test_systematic_resampling_copies_each_particle_its_expected_number_of_times_rounded() -> None:
    weights = np.random.default_rng(2).dirichlet(np.full(50, 0.3))
    for offset in (0.0, 0.25, 0.999):
        copies = np.bincount(systematic(3 * weights, offset), minlength=50)
        assert copies.sum() == 50
        assert np.all(np.abs(copies - 50 * weights) < 1)


def test_systematic_resampling_is_exact_at_its_edges() -> None:
    assert systematic(np.array([0.25, 0.25, 0.25, 0.25]), 0.0).tolist() == [0, 1, 2, 3]
    assert systematic(np.array([0.0, 0.0, 1.0]), 0.0).tolist() == [2, 2, 2]
    assert systematic(np.array([1.0, 0.0, 0.0]), 0.999).tolist() == [0, 0, 0]


READINGS = np.array([[8.0, 8.0, 0.0, 1.9, 2.6, 0.9, 1.0], [12.0, 9.0, 0.0, 1.9, 2.6, 2.5, 1.0], [11.0, 12.0, 0.0, 1.9, 2.6, 1.1, 1.0]])


Shares = tuple[float, float, float]
WHOLE: Shares = (1.0, 1.0, 1.0)
"""The exponents of the likelihoods of READINGS."""


def grid_density(shares: Shares, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Cell centres (2, M) and probabilities of the exact posterior, from the readable formulas."""
    axis = (np.arange(cells) + 0.5) * 30.0 / cells
    places = np.stack(np.meshgrid(axis, axis, indexing="ij")).reshape(2, -1)
    log_density = np.zeros(places.shape[1])
    for share, row in zip(shares, READINGS, strict=True):
        log_density += share * readable(CONFIG, places, row)
    density = np.exp(log_density - log_density.max())
    return places, density / density.sum()


def moved(start: np.ndarray, config: Config, shares: Shares, sweeps: int, seed: int = 9) -> tuple[np.ndarray, float]:
    """Particles after Metropolis sweeps over READINGS, and the share of accepted moves."""
    targets = log_priors(start, config.unknown_indices, config.prior_rows)
    for share, row in zip(shares, READINGS, strict=True):
        targets += share * fused(config, start, row)
    particles, readings = start.copy(), READINGS.copy()
    readings[:, 6] = shares
    taken = metropolis(particles, targets, readings, config.unknown_indices, config.prior_rows, config.sensor_row, seed, 2, 0, sweeps)
    return particles, taken / (sweeps * start.shape[1])


@pytest.mark.parametrize("shares", [WHOLE, (1.0, 1.0, 0.4), (0.3, 1.0, 0.6)], ids=str)
def test_moves_leave_the_posterior_given_all_readings_invariant(shares: Shares) -> None:
    places, probability = grid_density(shares, 600)
    rng = np.random.default_rng(3)
    count = 20_000
    start = places[:, rng.choice(places.shape[1], count, p=probability)] + rng.uniform(-0.025, 0.025, (2, count))  # exact draws
    particles, rate = moved(start, CONFIG, shares, 20)
    assert 0.05 < rate < 0.95
    assert particles.min() >= 0.0
    assert particles.max() <= 30.0
    mean = places @ probability
    std = np.sqrt(places**2 @ probability - mean**2)
    # 20,000 independent chains: 4 standard errors of the mean and of the standard deviation (the latter doubled for heavy tails).
    assert np.all(np.abs(particles.mean(axis=1) - mean) < 4 * std / math.sqrt(count))
    assert np.all(np.abs(particles.std(axis=1) - std) < 4 * std * 2 / math.sqrt(2 * count))


@pytest.mark.parametrize("prior", [Normal(250.0, 80.0), Gamma(2.0, 150.0), Uniform(100.0, 500.0)], ids=lambda prior: type(prior).__name__)
def test_moves_leave_a_posterior_with_an_unknown_rate_invariant(prior: Prior) -> None:
    """x fixed, y and q unknown: the exact posterior on a grid of y and q."""
    from estimator.priors import Fixed

    config = Config(diffusivity=4.2, priors={"x": Fixed(13.0), "q": prior})
    y, q = np.meshgrid((np.arange(400) + 0.5) * 30 / 400, (np.arange(800) + 0.5) * 1600 / 800, indexing="ij")
    grid = np.stack([y.ravel(), q.ravel()])
    match prior:
        case Normal(a, b):
            log_density = -0.5 * ((grid[1] - a) / b) ** 2
        case Gamma(a, b):
            log_density = (a - 1) * np.log(grid[1]) - grid[1] / b
        case Uniform(a, b):
            log_density = np.where((grid[1] > a) & (grid[1] < b), 0.0, -np.inf)
    for row in READINGS:
        mean = concentration(
            row[:2], np.stack([np.full(len(grid[0]), 13.0), grid[0]], axis=-1), row[3:5], rate=grid[1], diffusivity=4.2, lifetime=10.0
        )
        log_density = log_density + GAUSSIAN.log_likelihood(row[5], mean)
    probability = np.exp(log_density - log_density.max())
    probability /= probability.sum()
    rng = np.random.default_rng(4)
    count = 20_000
    start = grid[:, rng.choice(grid.shape[1], count, p=probability)] + rng.uniform(-1, 1, (2, count)) * [[0.0375], [1.0]]
    particles, rate = moved(start, config, WHOLE, 20)
    assert 0.05 < rate < 0.95
    mean = grid @ probability
    std = np.sqrt(grid**2 @ probability - mean**2)
    assert np.all(np.abs(particles.mean(axis=1) - mean) < 4 * std / math.sqrt(count))
    assert np.all(np.abs(particles.std(axis=1) - std) < 4 * std * 2 / math.sqrt(2 * count))


def test_moves_from_a_wrong_start_reach_the_posterior() -> None:
    places, probability = grid_density(WHOLE, 600)
    start = np.random.default_rng(5).uniform(0, 30, (2, 4000))
    particles, _ = moved(start, CONFIG, WHOLE, 100)
    mean = places @ probability
    std = np.sqrt(places**2 @ probability - mean**2)
    # Steps depend on the population, so the chains are not quite independent: twice the 4 standard errors.
    assert np.all(np.abs(particles.mean(axis=1) - mean) < 8 * std / math.sqrt(4000))


def test_a_rank_is_uniform_where_the_model_is_right() -> None:
    """Anderson–Darling p-values of uniform ranks are uniform, and small if ranks pile up."""
    rng = np.random.default_rng(7)
    for count in (8, 30):
        p_values = np.array([uniformity_p_value(rng.random(count)) for _ in range(20_000)])
        for level in (0.5, 0.1, 0.01, 0.001):
            margin = 4 * math.sqrt(level * (1 - level) / 20_000) + 0.003 * (level > 0.05)  # 4 standard deviations, the formula's own error
            assert np.mean(p_values < level) == pytest.approx(level, abs=margin)
    assert uniformity_p_value(np.full(30, 0.5)) < 1e-4
    assert uniformity_p_value(np.linspace(0.9, 1.0, 30)) < 1e-6


CACHE_MISSES = """
import numba, sys
from estimator import batch
rooms = [module for name, module in sys.modules.items() if name.startswith(("estimator.kernels.", "plume.kernels"))]
compiled = {id(f): f for room in rooms for f in vars(room).values() if isinstance(f, numba.core.dispatcher.Dispatcher)}.values()
print(sum(sum(f.stats.cache_hits.values()) for f in compiled), sum(sum(f.stats.cache_misses.values()) for f in compiled))
"""


def test_a_second_start_compiles_nothing() -> None:
    run = [sys.executable, "-c", CACHE_MISSES]
    subprocess.run(run, check=True, capture_output=True, timeout=100)
    hits, misses = subprocess.run(run, check=True, capture_output=True, text=True, timeout=100).stdout.split()
    assert int(hits) > 5
    assert misses == "0"
