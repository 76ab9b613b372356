"""Protects the figures of a sweep: shares and means by hand, intervals by their known values."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from agent.trials.figures import Interval, MissionRow, bootstrap, figures, wilson
from agent.trials.sweep import Sweep, fly, row_of
from estimator.criterion import Criterion
from estimator.filter import Config
from link.bus.messages import Belief


def flown(seed: int, ceased: bool, error_m: float, distance_m: float) -> MissionRow:
    return MissionRow(
        policy="greedy",
        particles=100,
        threshold_m=0.5,
        seed=seed,
        budget=300,
        headings=4,
        step_m=1.0,
        measurements=25,
        ceased=ceased,
        located=ceased and error_m <= 1,
        estimate_x=0.0,
        estimate_y=0.0,
        source_x=error_m,
        source_y=0.0,
        error_m=error_m,
        spread_m=0.4,
        nees=2.0 * seed,
        steps=int(distance_m),
        distance_m=distance_m,
        floor_m=distance_m / 2 if seed else 25.0,
        search_time_s=0.5,
        decision_ms=2.0,
        update_ms=1.0,
    )


def test_figures_are_those_of_the_words() -> None:
    said = figures(
        [
            flown(0, True, 0.5, 30.0),
            flown(1, True, 1.5, 50.0),
            flown(2, True, 0.2, 40.0),
            flown(3, False, 9.0, 300.0),
        ]
    )
    assert (said["missions"], said["particles"], said["threshold_m"]) == (4, 100, 0.5)
    assert said["ceased"] == 0.75
    assert said["located"] == 0.5  # of all missions
    assert said["false_stop"] == pytest.approx(1 / 3)  # of those that ceased
    assert said["mtd_m"] == 40.0  # the one that never ceased does not count
    assert said["floor_m"] == pytest.approx((25 + 25 + 20) / 3)
    assert said["mtd_floors"] == pytest.approx(
        (30 + 50 + 40) / (25 + 25 + 20)
    )  # of the means, not the mean of multiples
    assert said["nees_mean"] == 2.0
    assert (said["decision_ms"], said["update_ms"]) == (2.0, 1.0)
    assert said["mtd_m_interval"] == [
        30.0,
        50.0,
    ]  # 27 equally likely resamples: either end is drawn in 1 of 27, more than 2.5%


def test_without_floors_there_is_no_multiple() -> None:
    said = figures([replace(flown(0, True, 0.5, 30.0), floor_m=None)])
    assert said["floor_m"] is said["mtd_floors"] is said["mtd_floors_interval"] is None
    assert said["mtd_m"] == 30.0


def test_the_share_of_false_stops_that_a_warning_preceded_is_of_those_alone() -> None:
    rows = [
        flown(0, True, 0.5, 30.0),
        flown(1, True, 1.5, 50.0),
        flown(2, True, 3.0, 40.0),
        flown(3, False, 9.0, 300.0),
    ]
    assert figures(rows[:1])["false_stop_warned"] is figures(rows[:1])["false_stop_warned_interval"] is None
    assert figures(rows)["false_stop_warned"] == 0.0
    warned = [
        replace(row, warned=row.seed != 2) for row in rows
    ]  # a good stop, a false one and a mission without a stop
    said = figures(warned)
    assert said["false_stop_warned"] == 0.5
    assert said["false_stop_warned_interval"] == pytest.approx(
        [0.0945, 0.9055], abs=1e-4
    )  # 1 of 2: ½ ± ½ √(z²/(2 + z²)), z = 1.96


def test_figures_of_no_find_are_none_not_nan() -> None:
    said = figures([flown(0, False, 9.0, 300.0)])
    assert (said["ceased"], said["located"]) == (0.0, 0.0)
    assert (
        said["false_stop"]
        is said["mtd_m"]
        is said["mtd_floors"]
        is said["nees_mean"]
        is said["mtd_m_interval"]
        is None
    )


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (1, 1, 0.2065, 1.0)],
)
def test_wilsons_interval_has_its_published_values(hits: int, of: int, low: float, high: float) -> None:
    # 81 of 263: Newcombe 1998, table I. The rest by z²/(n + z²).
    assert wilson(hits, of) == Interval(
        hits / of, pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4)
    )


def test_a_bootstrap_interval_is_about_two_standard_errors_to_each_side() -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    said = bootstrap(values)
    error = values.std() / math.sqrt(400)
    # 1,000 resamples know a 2.5% quantile to about a tenth of a standard error.
    assert said.low == pytest.approx(values.mean() - 1.96 * error, abs=0.3 * error)
    assert said.high == pytest.approx(values.mean() + 1.96 * error, abs=0.3 * error)
    assert math.isnan(bootstrap(np.array([])).value)


@pytest.mark.parametrize(
    ("source", "covariance", "nees"),
    [
        # Errors (1, 2) and (1, −2): the inverse of (2 1; 1 2) is ⅓ (2 −1; −1 2), so ⅓ (2 ∓ 4 + 8); of (4 0; 0
        # 1) it is ¼ + 4.
        ((0.0, 0.0), (2.0, 1.0, 2.0), 2.0),
        ((0.0, 4.0), (2.0, 1.0, 2.0), 14 / 3),
        ((0.0, 0.0), (4.0, 0.0, 1.0), 4.25),
        ((1.0, 2.0), (4.0, 0.0, 1.0), 0.0),
    ],
)
def test_the_nees_of_a_mission_is_its_error_in_terms_of_what_was_believed(
    source: tuple[float, float], covariance: tuple[float, float, float], nees: float
) -> None:
    last = Belief(
        time_boot_ms=0,
        step=7,
        position=(0.0, 0.0),
        altitude_m=5.0,
        gas=0.0,
        wind=(1.0, 0.0),
        rate=300.0,
        diffusivity=4.0,
        lifetime=10.0,
        z=5.0,
        sensor="gaussian",
        unknowns=("x", "y"),
        means=(1.0, 2.0),
        stds=(1.0, 1.0),
        mean=(1.0, 2.0),
        covariance=covariance,
        spread=1.5,
        effective_sample_size=10.0,
        p_value=0.5,
        ceased=False,
    )
    sweep, flight = Sweep(("greedy",), range(3)), ("greedy", 100, 1, "as-modelled")
    row = row_of(sweep, flight, Config(100), True, False, last, source, 9.0, 2, 3.0, [0.25, 0.75], [0.5])
    assert row.nees == pytest.approx(nees)
    assert row.error_m == pytest.approx(math.dist((1.0, 2.0), source))
    assert row.located == (source == (1.0, 2.0))
    assert (row.search_time_s, row.decision_ms, row.update_ms) == (1.5, 500.0, 500.0)


def test_no_mission_of_a_sweep_ends_before_its_third_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("estimator.belief.CLEAR", -math.inf)  # so that only the number of readings counts
    stops = (Criterion(50.0), Criterion(100.0))
    (rows,) = fly(
        Sweep(("greedy",), range(7, 8), particles=(100,), stops=stops, budget=9),
        [("greedy", 100, 7, "as-modelled")],
    )
    assert [(row.ceased, row.steps) for row in rows] == [(True, 2), (True, 2)]
    assert rows[0].distance_m == pytest.approx(2.0, abs=1e-5)
