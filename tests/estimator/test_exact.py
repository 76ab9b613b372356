"""Protects the filter: over 200 missions, each belief of 100, 1,000 and 4,000 particles is compared with
the exact posterior.
"""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading
from plume.scenario import Scenario, draw
from plume.worlds.world import World
from tests.estimator.exact import GridPosterior, log_likelihood

pytestmark = pytest.mark.slow

STEPS = 45
WANDERING = 20
NARROW_M = 5.0
"""Above this spread a posterior is close to the prior. Its lattice of particles is more even than chance
and would flatter the filter.
"""


def readings(s: Scenario, seed: int) -> Iterator[Reading]:
    """A flight that no belief has chosen: it wanders, then heads for the source, not quite straight."""
    world, rng = World(s, seed), np.random.default_rng(seed)
    place, heading = np.array(world.start), rng.uniform(0, math.pi / 2)
    for step in range(STEPS):
        position = (float(np.float32(place[0])), float(np.float32(place[1])))
        yield Reading(step, position, 5.0, world.wind, world.gas(position, step))
        if step < WANDERING:
            heading += rng.normal(0, 0.4)
            ahead = place + np.array([math.cos(heading), math.sin(heading)])
            heading += math.pi / 2 * bool(ahead.min() < 0 or ahead.max() > 30)
        else:
            heading = math.atan2(s.source[1] - place[1], s.source[0] - place[0]) + rng.normal(0, 0.5)
        place = np.clip(place + np.array([math.cos(heading), math.sin(heading)]), 0, 30)


def compare(seeds: range, particle_counts: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Exact spread (steps,), the filter's error of mean (in spreads) and of covariance (relative), and
    ratio of spreads (counts, steps).
    """
    spreads, rows = [], []
    for seed in seeds:
        s = draw(seed)
        grid = GridPosterior(s.q, s.d, s.tau)
        configs = [
            Config(particles=n, seed=seed, rate=s.q, diffusivity=s.d, lifetime=s.tau) for n in particle_counts
        ]
        posteriors = [prior(config) for config in configs]
        for reading in readings(s, seed):
            grid.add(reading.position, reading.wind, reading.gas)
            posteriors = [
                assimilate(posterior, reading, config)
                for posterior, config in zip(posteriors, configs, strict=True)
            ]
            spreads.append(grid.spread)
            for posterior, config in zip(posteriors, configs, strict=True):
                said, _ = belief(posterior, reading, config)
                xx, xy, yy = said.covariance
                covariance_error = np.linalg.norm(
                    np.array([[xx, xy], [xy, yy]]) - grid.covariance
                ) / np.linalg.norm(grid.covariance)
                rows.append(
                    (
                        math.dist(said.mean, grid.mean) / grid.spread,
                        covariance_error,
                        said.spread / grid.spread,
                    )
                )
    return np.array(spreads), *np.array(rows).reshape(len(spreads), len(particle_counts), 3).transpose(
        2, 1, 0
    )


@pytest.mark.parametrize(
    "first_seed",
    [1_000_000, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1_000_050, 1_000_200, 50))],
)
def test_every_belief_is_the_exact_posterior_to_within_what_its_particles_can_tell(first_seed: int) -> None:
    counts = (100, 1000, 4000)
    spread, *errors = compare(range(first_seed, first_seed + 50), counts)
    assert len(spread) == 50 * STEPS
    narrow = spread < NARROW_M
    assert narrow.sum() > 500
    assert spread.min() < 0.2
    for n, mean_error, covariance_error, ratio in zip(counts, *errors, strict=True):
        # Resampling and moves correlate the particles: n of them must be worth at least n/10 independent
        # draws.
        # n/10 draws of a round Gaussian miss its mean by a median of 0.83/√(n/10) spreads (Rayleigh): 0.04 at
        # 4,000.
        assert np.median(mean_error[narrow]) < 2.6 / math.sqrt(n), n
        # n/10 draws along a line miss their variance by a median of 0.67 √2/√(n/10): 0.05 at 4,000.
        assert np.median(covariance_error[narrow]) < 3.0 / math.sqrt(n), n
        # The bound for 4,000 particles, widened as 1/√n for fewer: 5% becomes 10% at 1,000 and 32% at 100.
        assert np.mean(np.abs(ratio[narrow] - 1) < 0.05 * math.sqrt(4000 / n)) > 0.9, n
        # Random errors cancel. An honest filter's bias falls as 1/n and is 2% at 100; the bound is 1% at
        # 4,000 and 6% at 100.
        assert abs(np.median(ratio[narrow]) - 1) < 0.01 * math.sqrt(4000 / n), n
        # False stops begin with a spread of less than half the true one, or a mean more than one spread away.
        # A hundred particles
        # sometimes lose a distant mode: in 0.6% of their steps.
        lost = (ratio < 0.5) | (mean_error > 1)
        assert np.mean(lost) <= (0.02 if n == 100 else 0), n


def test_a_likelihood_worked_by_hand() -> None:
    # d = 1, wind 3 from the east: |v| = 1.5; τ = 1/4: k = √(1.5² + 4) = 2.5. With q = 4π, 1 m downwind m =
    # exp(-2.5 + 1.5), upwind exp(-4).
    x, y = np.array([[11.0], [9.0]]), np.array([[10.0]])
    down, up = log_likelihood(x, y, (10.0, 10.0, 3.0, 0.0, 0.5), 4 * math.pi, 1.0, 0.25)[:, 0]
    assert down == pytest.approx(-0.5 * ((0.5 - 0.367879) / 0.228430) ** 2 - math.log(0.228430), abs=1e-5)
    assert up == pytest.approx(-0.5 * ((0.5 - 0.018316) / 0.200075) ** 2 - math.log(0.200075), abs=1e-5)


def test_before_any_reading_the_grid_knows_the_area_alone() -> None:
    grid = GridPosterior(300.0, 4.0, 10.0)
    assert grid.mean == pytest.approx([15, 15])
    assert grid.covariance == pytest.approx(np.diag([75, 75]), abs=0.03)  # 30²/12


@pytest.mark.parametrize("repeats", [1, 40])
def test_readings_at_one_place_in_still_air_leave_a_ring(repeats: int) -> None:
    # An integral over the distance alone remains: E r² = ∫ r³ L(r) dr / ∫ r L(r) dr; the variances along x
    # and y are half of it each.
    grid = GridPosterior(300.0, 4.0, 10.0)
    for _ in range(repeats):
        grid.add((13.3, 14.2), (0.0, 0.0), 1.3)
    r = np.arange(0.0005, 12, 0.001)
    m = 300 / (16 * math.pi * np.maximum(r, 0.1)) * np.exp(-np.maximum(r, 0.1) / math.sqrt(40))
    ring = r * np.exp(-0.5 * repeats * ((1.3 - m) ** 2 / (0.09 * m**2 + 0.04) + np.log(0.09 * m**2 + 0.04)))
    expected = ring @ r**2 / ring.sum()
    assert grid.mean == pytest.approx([13.3, 14.2], abs=1e-3)
    assert grid.covariance == pytest.approx(np.eye(2) * expected / 2, rel=1e-3, abs=1e-3 * expected)


# Down to 0.04 m, within the source itself; a thin ridge.
@pytest.mark.full
@pytest.mark.parametrize("seed", [1_000_000, pytest.param(1_000_032, marks=pytest.mark.full)])
def test_the_zooming_grid_agrees_with_a_fine_one_over_the_whole_area(seed: int) -> None:
    s = draw(seed)
    zooming = GridPosterior(s.q, s.d, s.tau)
    axis = (np.arange(1500) + 0.5) * 30 / 1500
    log_density = np.zeros((1500, 1500))
    for step, reading in enumerate(readings(s, seed)):
        zooming.add(reading.position, reading.wind, reading.gas)
        for rows in range(0, 1500, 20):  # strips that fit the cache
            strip = slice(rows, rows + 20)
            values = (*reading.position, *reading.wind, reading.gas)
            log_density[strip] += log_likelihood(axis[strip, None], axis[None, :], values, s.q, s.d, s.tau)
        if step % 4:
            continue
        p = np.exp(log_density - log_density.max())
        p /= p.sum()
        mean = np.array([p.sum(axis=1) @ axis, p.sum(axis=0) @ axis])
        dx, dy = axis - mean[0], axis - mean[1]
        xx, xy, yy = p.sum(axis=1) @ dx**2, dx @ p @ dy, p.sum(axis=0) @ dy**2
        assert math.dist(zooming.mean, mean) < 0.005 * math.sqrt(xx + yy)
        assert zooming.spread == pytest.approx(math.sqrt(xx + yy), rel=0.005)
        assert zooming.covariance == pytest.approx(
            np.array([[xx, xy], [xy, yy]]), rel=0, abs=0.01 * (xx + yy)
        )  # the fine grid's own error
