"""Protects the scenarios: the ranges of Table 1, and a source that depends on the seed alone."""

import math

import numpy as np
import pytest

from plume.scenario import Scenario, draw

SEEDS = range(1_000_000, 1_004_000)


@pytest.fixture(scope="module")
def scenarios() -> list[Scenario]:
    return [draw(seed) for seed in SEEDS]


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("x", 10, 25),
        ("y", 10, 25),
        ("q", 100, 500),
        ("u", 1, 4),
        ("phi", 0, 2 * math.pi),
        ("d", 1, 8),
        ("start_x", 0, 5),
        ("start_y", 0, 5),
    ],
)
def test_every_quantity_is_uniform_over_its_range_of_table_1(
    scenarios: list[Scenario], name: str, low: float, high: float
) -> None:
    pick = {
        "x": lambda s: s.source[0],
        "y": lambda s: s.source[1],
        "start_x": lambda s: s.start[0],
        "start_y": lambda s: s.start[1],
    }.get(name, lambda s: getattr(s, name))
    values = np.sort([(pick(s) - low) / (high - low) for s in scenarios])
    assert values[0] >= 0.0
    assert values[-1] <= 1.0
    # Kolmogorov–Smirnov distance to the uniform; it exceeds 1.95/√n by chance once in a thousand.
    distance = np.abs(values - (np.arange(len(values)) + 0.5) / len(values)).max()
    assert distance < 1.95 / math.sqrt(len(values))


def test_a_seed_always_gives_the_same_scenario_and_another_seed_another_one() -> None:
    assert draw(7) == draw(7)
    assert draw(7).source != draw(8).source


def test_the_wind_vector_points_to_where_the_wind_comes_from() -> None:
    s = Scenario(source=(0, 0), q=1, u=2.0, phi=math.pi / 2, d=1, tau=10, start=(0, 0))
    assert s.wind == pytest.approx((0.0, 2.0))
