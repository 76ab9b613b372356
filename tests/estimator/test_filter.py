"""Protects the filter: it is held against the exact posterior on a grid, computed here by a formula of its own."""

import math

import numpy as np
import pytest

from estimator import kernels
from estimator.belief import belief
from estimator.filter import Config, Posterior, assimilate, prior
from link.mavlink import Reading
from plume.scenario import Scenario, draw
from plume.world import World

CELLS = 400
AXIS = (np.arange(CELLS) + 0.5) * 30.0 / CELLS
X, Y = np.meshgrid(AXIS, AXIS, indexing="ij")


def exact_log_likelihood(reading: Reading, s: Scenario) -> np.ndarray:
    """The paper's model again, in polar form: bearing and distance from each cell to the reading."""
    east, north = reading.position[0] - X, reading.position[1] - Y
    r = np.maximum(np.sqrt(east**2 + north**2), 0.1)
    wind_x, wind_y = reading.wind
    u = math.hypot(wind_x, wind_y)
    along = np.hypot(east, north) * np.cos(np.arctan2(north, east) - math.atan2(wind_y, wind_x))  # upwind part of the offset
    lam = math.sqrt(s.d * s.tau / (1 + u * u * s.tau / (4 * s.d)))
    mean = s.q / (4 * math.pi * s.d * r) * np.exp(-r / lam - along * u / (2 * s.d))
    std = np.sqrt((0.3 * mean) ** 2 + 0.2**2)
    return -0.5 * ((reading.gas - mean) / std) ** 2 - np.log(std)


def config_for(s: Scenario, seed: int, particles: int = 4000) -> Config:
    return Config(particles=particles, seed=seed, rate=s.q, diffusivity=s.d, lifetime=s.tau)


def spiral(seed: int, steps: int) -> list[tuple[float, float]]:
    """A path over the area that no belief has chosen."""
    rng = np.random.default_rng(seed)
    place, heading, path = np.array([2.0, 2.0]), 0.8, []
    for _ in range(steps):
        path.append((float(np.float32(place[0])), float(np.float32(place[1]))))
        heading += rng.normal(0, 0.5)
        ahead = place + np.array([math.cos(heading), math.sin(heading)])
        if ahead.min() < 0 or ahead.max() > 30:
            heading += math.pi / 2
        place = np.clip(place + np.array([math.cos(heading), math.sin(heading)]), 0, 30)
    return path


@pytest.fixture(scope="module")
def comparison() -> np.ndarray:
    """(steps, 3): |mean difference| in posterior standard deviations, spread ratio and exact spread, over 12 missions."""
    rows = []
    for seed in range(1_000_100, 1_000_112):
        s = draw(seed)
        world = World(s, seed)
        config = config_for(s, seed)
        posterior = prior(config)
        log_density = np.zeros((CELLS, CELLS))
        for step, position in enumerate(spiral(seed, 60)):
            reading = Reading(step, position, 5.0, world.wind, world.gas(position, step))
            posterior = assimilate(posterior, reading, config)
            log_density += exact_log_likelihood(reading, s)
            p = np.exp(log_density - log_density.max())
            p /= p.sum()
            mean = np.array([(p * X).sum(), (p * Y).sum()])
            spread = math.sqrt((p * (X - mean[0]) ** 2).sum() + (p * (Y - mean[1]) ** 2).sum())
            if spread < 0.4:
                break  # finer than the grid can tell, and past the stop
            summary, _ = belief(posterior, reading, config)
            rows.append((math.dist(summary.mean, mean) / spread, summary.spread / spread, spread))
    return np.array(rows)


def test_the_mean_is_that_of_the_exact_posterior(comparison: np.ndarray) -> None:
    assert len(comparison) > 300
    # 4,000 independent draws would differ by a median of about 0.013 standard deviations; correlated ones by a few times that.
    assert np.median(comparison[:, 0]) < 0.05
    assert comparison[:, 0].max() < 0.5


def test_the_spread_is_that_of_the_exact_posterior(comparison: np.ndarray) -> None:
    ratio = comparison[:, 1]
    assert np.mean((ratio > 0.95) & (ratio < 1.05)) > 0.85
    assert ratio.min() > 0.5
    assert abs(np.median(ratio) - 1) < 0.01


def test_the_prior_is_uniform_over_the_area() -> None:
    posterior = prior(Config(particles=4000, seed=3))
    counts, _, _ = np.histogram2d(*posterior.particles.T, bins=5, range=[[0, 30], [0, 30]])
    assert counts.sum() == 4000
    # A lattice of low discrepancy is evener than chance: 160 expected in each cell, 12 would be one standard deviation of chance.
    assert np.abs(counts - 160).max() < 12


def test_a_reading_that_would_crush_the_weights_is_taken_in_stages() -> None:
    s = Scenario(source=(20.0, 20.0), q=5000.0, u=1.0, phi=0.3, d=0.5, tau=10.0, start=(0.0, 0.0))
    world = World(s, 1)
    config = config_for(s, 1, 1000)
    position = (19.5, 19.875)
    row = np.array([*position, *world.wind, world.gas(position, 0)])
    crushed = kernels.effective_sample_size(kernels.log_likelihoods(prior(config).particles, row, config.model()))
    assert crushed < 20  # what plain reweighting would be left with, of 1,000
    reading = Reading(0, position, 5.0, world.wind, world.gas(position, 0))
    posterior = assimilate(prior(config), reading, config)
    assert kernels.effective_sample_size(posterior.log_weights) >= 500
    assert len(np.unique(posterior.particles, axis=0)) > 500
    p = exact_log_likelihood(reading, s)
    p = np.exp(p - p.max()) / np.exp(p - p.max()).sum()
    mean = np.array([(p * X).sum(), (p * Y).sum()])
    spread = math.sqrt((p * (X - mean[0]) ** 2).sum() + (p * (Y - mean[1]) ** 2).sum())
    summary, _ = belief(posterior, reading, config)
    assert summary.spread == pytest.approx(spread, rel=0.15)
    assert math.dist(summary.mean, mean) < 0.2 * spread


@pytest.mark.parametrize("gas", [3e38, -3e38, 1e6])
def test_an_absurd_reading_neither_hangs_the_filter_nor_breaks_its_numbers(gas: float) -> None:
    s = draw(4)
    config = config_for(s, 1, 300)
    posterior = prior(config)
    for step, value in enumerate((0.5, gas, 0.5)):
        posterior = assimilate(posterior, Reading(step, (3.0, 3.0), 5.0, (1.0, 1.0), value), config)
    summary, particles = belief(posterior, Reading(2, (3.0, 3.0), 5.0, (1.0, 1.0), 0.5), config)
    assert np.isfinite(particles).all()
    assert math.isfinite(summary.spread)
    assert particles[:, :2].min() >= 0.0
    assert particles[:, :2].max() <= 30.0


def test_the_same_readings_and_seed_give_the_same_bits_and_another_seed_does_not() -> None:
    s = draw(4)
    world = World(s, 4)

    def final(seed: int) -> Posterior:
        config = config_for(s, seed, 500)
        posterior = prior(config)
        for step, position in enumerate(spiral(4, 30)):
            posterior = assimilate(posterior, Reading(step, position, 5.0, world.wind, world.gas(position, step)), config)
        return posterior

    assert final(1).particles.tobytes() == final(1).particles.tobytes()
    assert final(1).particles.tobytes() != final(2).particles.tobytes()


def test_what_is_published_is_what_the_particles_say() -> None:
    posterior = Posterior(np.array([[1.0, 2.0], [3.0, 2.0]]), np.log([0.75, 0.25]), np.zeros(2), np.zeros((1, 5)))
    reading = Reading(77, (1.0, 2.0), 5.0, (1.0, 0.0), 0.5)
    summary, particles = belief(posterior, reading, Config(threshold_m=0.9))
    # mean 1.5, variance 0.75·0.25 + 0.25·2.25 = 0.75
    assert summary.mean == pytest.approx((1.5, 2.0))
    assert summary.spread == pytest.approx(math.sqrt(0.75))
    assert summary.ceased
    assert not belief(posterior, reading, Config(threshold_m=0.8))[0].ceased
    assert particles.tolist() == [[1.0, 2.0, 0.75], [3.0, 2.0, 0.25]]
    assert (summary.time_boot_ms, summary.step) == (77, 0)
