"""Protects the check that the measured winds are one wind: its p-value, its false alarms, and that it warns."""

import math

import numpy as np
import pytest

from estimator.belief import belief, one_wind, warning
from estimator.filter import Config, Posterior
from estimator.kernels.checks import one_wind_p_value
from estimator.priors import Normal, Uniform
from link.bus.mavlink import Reading
from plume.scenario import draw
from plume.worlds.world import World

READING = Reading(77, (1.0, 2.0), 5.0, (1.0, 0.0), 0.5)
TURNED = np.array([[3.0, 0.0]] * 4 + [[1.0, 0.0]] * 4)
# To and fro through the yard of the shipped buildings: four rows, each of 15 steps of a metre.
ROWS = [
    (10.0 + (step if row % 2 == 0 else 14 - step), y)
    for row, y in enumerate((10.0, 15.0, 20.0, 25.0))
    for step in range(15)
]


def posterior_of(winds: np.ndarray, gas: float = 50.0) -> Posterior:
    """Two equal particles, 0.2 m apart, after readings of these winds that one value does not explain."""
    readings = np.zeros((len(winds), 7))
    readings[:, 3:5], readings[:, 5] = winds, np.linspace(0.0, gas, len(winds))
    config = Config(assume="field")
    particles = np.ones((len(config.unknowns), 2))
    particles[:2] = [[1.0, 1.2], [2.0, 2.0]]
    ranks = np.linspace(0.03, 0.97, len(winds)).reshape(2, -1).T.ravel()  # one low, one high: no two alike
    return Posterior(particles, np.zeros(2), np.ones(2), np.full(2, 50.0), readings, ranks)


def by_hand(z: float) -> float:
    return 0.5 * math.erfc(z / math.sqrt(2))


def test_the_p_value_is_that_of_the_correlation_of_neighbours() -> None:
    # Deviations 1, 1, 1, 1, -1, -1, -1, -1: products of neighbours add up to 6 - 1, squares to 8.
    assert one_wind_p_value(TURNED) == pytest.approx(by_hand((5 / 8 + 1 / 8) * math.sqrt(8)), rel=1e-6)
    # To and fro: -7 by 8.
    fro = np.array([[3.0, 0.0], [1.0, 0.0]] * 4)
    assert one_wind_p_value(fro) == pytest.approx(by_hand((-7 / 8 + 1 / 8) * math.sqrt(8)), rel=1e-6)
    # Its four quarters from four sides; deviations are the winds: 4 pairs each in 8 of 11 steps, 0 in the others.
    around = np.repeat([[2.0, 0.0], [0.0, 2.0], [-2.0, 0.0], [0.0, -2.0]], 3, axis=0)
    assert one_wind_p_value(around) == pytest.approx(by_hand((8 / 12 + 1 / 12) * math.sqrt(12)), rel=1e-6)


def test_neither_unit_nor_compass_matters() -> None:
    turned = TURNED @ np.array([[0.6, 0.8], [-0.8, 0.6]])
    assert one_wind_p_value(7 * turned) == pytest.approx(one_wind_p_value(TURNED), rel=1e-9)


def test_few_winds_and_winds_that_hardly_differ_are_one() -> None:
    assert one_wind_p_value(TURNED[:7]) == 1.0
    assert one_wind_p_value(np.full((50, 2), 2.0)) == 1.0
    assert one_wind_p_value(np.zeros((50, 2))) == 1.0
    half = np.repeat([1.0, -1.0], 25)[:, None] * np.array([[0.0, 1.0]])
    assert one_wind_p_value(np.array([1.0, 0.0]) + 0.299 * half) == 1.0
    assert one_wind_p_value(np.array([1.0, 0.0]) + 0.301 * half) < 1e-9


@pytest.mark.parametrize("count", [8, 30, 100])
def test_independent_errors_of_an_anemometer_are_no_other_wind(count: int) -> None:
    """30° and 30% of the speed: so much that all winds differ enough.

    The variance in the test is the greatest possible one, so a p-value comes at most as often as it says;
    the margin is 4 standard deviations.
    """
    rng = np.random.default_rng(count)
    turns = rng.normal(0, math.radians(30), (20_000, count))
    speeds = rng.normal(1, 0.3, (20_000, count))
    winds = np.stack([speeds * np.cos(turns), speeds * np.sin(turns)], axis=-1)
    p_values = np.array([one_wind_p_value(np.ascontiguousarray(some)) for some in winds])
    for level in (0.1, 0.01, 0.001):
        assert np.mean(p_values < level) < level + 4 * math.sqrt(level * (1 - level) / 20_000)
    assert np.mean(p_values < 0.1) > 0.01  # and it is no test that never finds anything


def test_fewer_than_one_search_in_a_hundred_is_warned_of_in_one_wind() -> None:
    """Each looks after every reading, 100 of them, whether p < 1e-4; 3,000 searches, the errors as above."""
    rng = np.random.default_rng(5)
    alarms = 0
    for _ in range(3_000):
        turns, speeds = rng.normal(0, math.radians(30), 100), rng.normal(1, 0.3, 100)
        winds = np.stack([speeds * np.cos(turns), speeds * np.sin(turns)], axis=-1)
        alarms += any(one_wind_p_value(winds[: t + 1]) < 1e-4 for t in range(7, 100))
    assert alarms < 0.01 * 3_000


def winds_of(name: str, seed: int) -> np.ndarray:
    world = World(draw(seed), seed, name=name)
    return np.array([world.measure(place, step)[1] for step, place in enumerate(ROWS)], float)


def test_the_wind_among_buildings_is_found_and_that_in_the_open_is_one() -> None:
    """Along rows in the yard, for the winds of ten seeds."""
    assert all(one_wind_p_value(winds_of("walls:file=courtyard", seed)) < 1e-4 for seed in range(10))
    for name in ("as-modelled", "puffs", "wind-30", "wind-noisy"):
        assert {one_wind_p_value(winds_of(name, seed)) for seed in range(10)} == {1.0}


def test_the_wind_of_a_wander_by_30_degrees_is_found() -> None:
    """An Ornstein–Uhlenbeck process with a correlation time of 20 s, 60 readings 1.15 s apart, is in nine of ten."""
    rng, kept, found = np.random.default_rng(3), math.exp(-1.15 / 20), 0
    for _ in range(200):
        turn, winds = rng.normal(), np.empty((60, 2))
        for t in range(60):
            winds[t] = math.cos(math.radians(30 * turn)), math.sin(math.radians(30 * turn))
            turn = kept * turn + math.sqrt(1 - kept * kept) * rng.normal()
        found += one_wind_p_value(winds) < 1e-4
    assert found > 150


def test_a_second_wind_is_warned_of_and_the_stop_is_not_withheld() -> None:
    config = Config(threshold_m=0.5, assume="field")
    winds = np.repeat(TURNED, 5, axis=0)
    said, _ = belief(posterior_of(winds), READING, config)
    assert said.wind_p_value == one_wind_p_value(winds) < 1e-4
    assert said.ceased
    told = warning(said, config)
    assert told is not None
    assert told[0].startswith("the wind is not the same at all readings (p = ")
    said, _ = belief(posterior_of(winds[::-1] * 0 + 1.0), READING, config)
    assert (said.wind_p_value, said.ceased, warning(said, config)) == (1.0, True, None)


def test_winds_that_the_model_does_not_take_from_the_readings_are_not_looked_at() -> None:
    posterior = posterior_of(np.repeat(TURNED, 5, axis=0))
    assert one_wind(posterior, Config(assume="field")) < 1e-4
    assert one_wind(posterior, Config()) == 1.0
    for priors in ({"u": Normal(2.0, 1.0)}, {"phi": Uniform(0.0, math.tau)}):
        assert one_wind(posterior, Config(assume="field", priors=priors)) == 1.0
