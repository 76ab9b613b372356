"""Protects moves and planners: infotaxis against the information gain integrated numerically, by formulas of its own."""

import math

import numpy as np
import pytest

from agent.moves import moves
from agent.planners import PLANNERS, planner
from agent.planners.infotaxis import information_gain, plan
from link.messages import Belief

RATE, DIFFUSIVITY, LIFETIME, WIND = 270.0, 4.2, 10.0, (1.5, -1.0)


def belief_at(position: tuple[float, float], step: int = 0) -> Belief:
    return Belief(
        time_boot_ms=step, step=step, position=position, altitude_m=5.0, gas=0.0, wind=WIND, rate=RATE, diffusivity=DIFFUSIVITY,
        lifetime=LIFETIME, z=5.0, sensor="gaussian", unknowns=("x", "y"), means=(15.0, 15.0), stds=(1.0, 1.0), mean=(15.0, 15.0),
        covariance=(1.0, 0.0, 1.0), spread=1.4, effective_sample_size=10.0, p_value=0.5, ceased=False,
    )  # fmt: skip


def cloud(count: int, seed: int, low: float = 5.0, high: float = 25.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(low, high, (count, 2)), rng.dirichlet(np.ones(count))]).astype(np.float32)


def exact_information(particles: np.ndarray, place: np.ndarray) -> float:
    """I = H(reading) − H(reading | source), nats: entropies of a mixture and of its Gaussians, the first by quadrature."""
    entropy_of_gaussians = 0.0
    readings = np.linspace(-400.0, 900.0, 1_300_001)
    density = np.zeros_like(readings)
    for x, y, weight in particles.astype(float):
        dx, dy = place[0] - x, place[1] - y
        r = max(math.hypot(dx, dy), 0.1)
        u2 = WIND[0] ** 2 + WIND[1] ** 2
        lam = math.sqrt(DIFFUSIVITY * LIFETIME / (1 + u2 * LIFETIME / (4 * DIFFUSIVITY)))
        m = RATE / (4 * math.pi * DIFFUSIVITY * r) * math.exp(-r / lam - (dx * WIND[0] + dy * WIND[1]) / (2 * DIFFUSIVITY))
        s = math.sqrt(0.09 * m * m + 0.04)
        near = slice(*np.searchsorted(readings, (m - 10 * s, m + 10 * s)))
        density[near] += weight * np.exp(-0.5 * ((readings[near] - m) / s) ** 2) / (s * math.sqrt(2 * math.pi))
        entropy_of_gaussians += weight * 0.5 * math.log(2 * math.pi * math.e * s * s)
    inside = density > 0
    return float(-np.sum(density[inside] * np.log(density[inside])) * (readings[1] - readings[0])) - entropy_of_gaussians


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_information_gain_converges_to_the_integral(seed: int) -> None:
    particles, options = cloud(12, seed), moves((14.0, 13.0))
    exact = [exact_information(particles, place) for place in options]
    estimated = information_gain(belief_at((14.0, 13.0)), particles, options, np.random.default_rng(seed), measurements=40_000)
    # The gain of one imagined reading scatters by about 1 nat: 4 standard errors of 40,000 are 0.02.
    assert estimated == pytest.approx(exact, abs=0.02)


def test_infotaxis_goes_where_the_integral_is_greatest() -> None:
    chosen = best = average = 0.0
    for seed in range(20):
        particles, options = cloud(40, seed, 8.0, 22.0), moves((11.0, 13.0))
        exact = [exact_information(particles, place) for place in options]
        chosen += exact[plan(belief_at((11.0, 13.0)), particles, options, np.random.default_rng(seed))]
        best += max(exact)
        average += sum(exact) / 4
    # 25 imagined readings do not always find the best of four moves, but lose far less than a random move.
    assert best - chosen < 0.5 * (best - average)


def test_a_certain_belief_has_nothing_to_learn() -> None:
    particles = np.array([[20.0, 20.0, 1.0]], np.float32)
    assert information_gain(belief_at((14.0, 13.0)), particles, moves((14.0, 13.0)), np.random.default_rng(1)) == pytest.approx(np.zeros(4))


def test_moves_are_four_steps_of_a_metre() -> None:
    assert moves((14.0, 13.0)).tolist() == [[15.0, 13.0], [14.0, 14.0], [13.0, 13.0], [14.0, 12.0]]


@pytest.mark.parametrize(
    ("position", "count"), [((0.0, 0.0), 2), ((0.5, 0.5), 2), ((30.0, 15.0), 3), ((29.5, 29.5), 2), ((1.0, 1.0), 4), ((29.0, 29.0), 4)]
)
def test_no_move_leaves_the_area(position: tuple[float, float], count: int) -> None:
    options = moves(position)
    assert len(options) == count
    assert options.min() >= 0.0
    assert options.max() <= 30.0


def test_moves_are_exact_float32_values() -> None:
    options = moves((float(np.float32(3.7280619)), float(np.float32(0.21317468))))
    assert np.array_equal(options, options.astype(np.float32).astype(np.float64))


def test_random_takes_each_move_equally_often() -> None:
    options, particles = moves((14.0, 13.0)), cloud(5, 1)
    rng = np.random.default_rng(1)
    counts = np.bincount([planner("random")(belief_at((14.0, 13.0)), particles, options, rng) for _ in range(4000)])
    assert np.all(np.abs(counts - 1000) < 4 * math.sqrt(4000 * 0.25 * 0.75))  # 4 standard deviations


@pytest.mark.parametrize("name", PLANNERS)
def test_a_planner_is_a_function_of_belief_and_key(name: str) -> None:
    options, particles = moves((14.0, 13.0)), cloud(200, 1)
    choices = {planner(name)(belief_at((14.0, 13.0)), particles, options, np.random.default_rng(5)) for _ in range(5)}
    assert len(choices) == 1
