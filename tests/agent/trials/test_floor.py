"""Protects the information floor: the information of a reading, and the paths found."""

import itertools
import math

import numpy as np
import pytest

from agent.trials import floor
from plume.dispersion import concentration
from plume.scenario import Scenario, draw
from plume.sensors.names import GAUSSIAN

CALM = Scenario(source=(15.0, 15.0), q=300.0, u=0.0, phi=0.0, d=4.5, tau=10.0, start=(12.0, 15.0))
WINDY = Scenario(source=(15.0, 15.0), q=300.0, u=2.0, phi=2.5, d=3.0, tau=10.0, start=(13.0, 13.5))
SHORT = [
    CALM,
    WINDY,
    Scenario(source=(14.0, 12.0), q=120.0, u=3.5, phi=5.0, d=1.5, tau=10.0, start=(13.0, 14.0)),
]
PLACES = [(13.0, 12.0), (15.4, 15.3), (17.0, 20.0), (15.02, 15.03), (4.0, 11.0)]


def mean_at(s: Scenario, position: tuple[float, float], source: np.ndarray) -> np.ndarray:
    """The concentration were the source elsewhere, g/m³."""
    return concentration(position, source, s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)


def information_at(s: Scenario, position: tuple[float, float]) -> np.ndarray:
    """The Fisher information (2, 2) of a reading there about the source's location, 1/m²."""
    share, *gradient = floor.information(*position, floor.model(s))
    return share * np.outer(gradient, gradient)


@pytest.mark.parametrize("position", PLACES)
@pytest.mark.parametrize("s", [CALM, WINDY])
def test_the_information_is_the_curvature_of_the_expected_log_likelihood(
    s: Scenario, position: tuple[float, float]
) -> None:
    # For the expectation over z ~ N(m, σ²) of log N(z; m', σ'²): −log σ' − (σ² + (m − m')²) / (2 σ'²),
    # differentiated numerically.
    mean = mean_at(s, position, np.array(s.source))
    std = GAUSSIAN.noise_std(mean)

    def expected(dx: float, dy: float) -> float:
        there = mean_at(s, position, np.add(s.source, (dx, dy)))
        std_there = GAUSSIAN.noise_std(there)
        return float(-np.log(std_there) - (std**2 + (mean - there) ** 2) / (2 * std_there**2))

    e = 1e-3
    middle = expected(0, 0)
    xx = (expected(e, 0) - 2 * middle + expected(-e, 0)) / e**2
    yy = (expected(0, e) - 2 * middle + expected(0, -e)) / e**2
    xy = (expected(e, e) - expected(e, -e) - expected(-e, e) + expected(-e, -e)) / (4 * e**2)
    assert information_at(s, position) == pytest.approx(-np.array([[xx, xy], [xy, yy]]), rel=2e-3, abs=1e-6)


def test_the_information_is_the_covariance_of_the_score() -> None:
    # 400,000 draws: the sampling error of a variance is about 0.3% of it where the score is nearly normal; 2%
    # is allowed.
    position, e = (13.0, 12.0), 1e-5
    readings = GAUSSIAN.measure(
        np.full(400_000, mean_at(WINDY, position, np.array(WINDY.source))), np.random.default_rng(1)
    )
    score = [
        (
            GAUSSIAN.log_likelihood(readings, mean_at(WINDY, position, np.array(WINDY.source) + step))
            - GAUSSIAN.log_likelihood(readings, mean_at(WINDY, position, np.array(WINDY.source) - step))
        )
        / (2 * e)
        for step in (np.array([e, 0]), np.array([0, e]))
    ]
    information = information_at(WINDY, position)
    assert np.cov(score) == pytest.approx(information, abs=0.02 * np.trace(information))


def test_in_strong_gas_without_wind_the_information_is_that_of_the_distance() -> None:
    # 1 m east of it, m = 300/(4π·4.5·1) · exp(−1/√45) = 5.305165 · 0.861495 = 4.570373;  σ² = 0.09 ·
    # 20.888309 + 0.04 = 1.919948;
    # ∂ log m/∂x_s = 1/1 + 1/√45 = 1.149071;  I = 20.888309/1.919948 · (1 + 2 · 0.0081 · 20.888309/1.919948) ·
    # 1.149071² = 16.8966
    assert information_at(CALM, (16.0, 15.0)) == pytest.approx(
        np.array([[16.8966, 0], [0, 0]]), rel=1e-4, abs=1e-12
    )


def test_the_spread_after_a_path_adds_the_information_of_all_its_readings_to_the_priors() -> None:
    north_east = math.pi / 4
    places = [(12.0, 15.0), (13.0, 15.0), (13 + math.cos(north_east), 15 + math.sin(north_east))]
    total = np.eye(2) * 12 / 30**2 + sum(information_at(CALM, place) for place in places)
    assert floor.spread_m(CALM, [0.0, north_east]) == pytest.approx(math.sqrt(np.trace(np.linalg.inv(total))))


def test_a_path_that_leaves_the_area_is_none() -> None:
    s = Scenario(source=(1.0, 1.0), q=300.0, u=1.0, phi=0.0, d=4.5, tau=10.0, start=(0.5, 0.5))
    assert floor.spread_m(s, [math.pi]) == math.inf


def test_a_straight_path_on_the_axis_of_the_plume_never_learns_the_direction_across() -> None:
    # On the wind's axis every gradient points along it: the variance across stays the prior's, 30²/12 = 75
    # m².
    s = Scenario(source=(20.0, 15.0), q=300.0, u=2.0, phi=0.0, d=4.5, tau=10.0, start=(10.0, 15.0))
    assert math.sqrt(75) < floor.spread_m(s, [0.0] * 9) < math.sqrt(75.1)


@pytest.mark.full
@pytest.mark.slow
@pytest.mark.parametrize("s", SHORT)
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_no_path_of_a_brute_force_search_leaves_less_spread_than_the_one_found(
    s: Scenario, steps: int
) -> None:
    # All paths on 40 headings: 64,000 for three steps. The search, which knows no such lattice, may be worse
    # by 3%, not more.
    headings = np.linspace(0, 2 * math.pi, 40, endpoint=False)
    brute = min(floor.spread_m(s, path) for path in itertools.product(headings, repeat=steps))
    assert floor.spread_m(s, floor.best_path(s, steps)) <= 1.03 * brute


def test_a_floor_beyond_the_budget_is_infinite() -> None:
    assert floor.floors_m(draw(1_000_000), [0.5], budget=3) == {0.5: math.inf}


def test_a_spread_that_the_prior_already_has_takes_no_step() -> None:
    # The prior's spread is sqrt(2 · 75) = 12.2 m.
    assert floor.floors_m(draw(1_000_000), [12.3]) == {12.3: 0.0}


def test_a_source_above_the_plane_is_refused() -> None:
    with pytest.raises(ValueError, match="height 2 m is not allowed"):
        floor.floors_m(
            Scenario(
                source=(15.0, 15.0), q=300.0, u=1.0, phi=0.0, d=4.5, tau=10.0, start=(1.0, 1.0), height=2.0
            ),
            [0.5],
        )
