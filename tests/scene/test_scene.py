"""Protects what all pictures share: the ellipse of a covariance, the true plume, the threshold of a stop."""

import math

import pytest

from plume.dispersion import concentration
from plume.problem import AREA
from scene.scene import Backdrop, Measurement, Release, Scene, ellipse, judged, turns


def test_the_ellipse_of_a_turned_covariance_has_two_standard_deviations_as_half_axes() -> None:
    # Standard deviations 3 m along 30° and 1 m across it: covariance = R diag(9, 1) Rᵀ.
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    covariance = (9 * c * c + s * s, 8 * c * s, 9 * s * s + c * c)
    assert ellipse(covariance) == pytest.approx((6.0, 2.0, math.radians(30)))


def test_a_covariance_along_north_points_up_and_one_without_width_has_none() -> None:
    assert ellipse((1.0, 0.0, 4.0)) == pytest.approx((4.0, 2.0, math.pi / 2))
    assert ellipse((0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)
    longer, shorter, _ = ellipse((1.0, 1.0 + 1e-12, 1.0))  # rounding may make a variance negative
    assert (longer, shorter) == (pytest.approx(2 * math.sqrt(2)), 0.0)


def test_the_true_plume_has_its_rows_from_south_to_north_and_its_gas_downwind() -> None:
    release = Release(
        (10.0, 20.0), (3.0, 0.0), 300.0, 4.0, 10.0, height=1.0
    )  # wind from the east: gas lies in the west
    gas = release.gas(AREA, 60)
    assert gas.shape == (60, 60)
    assert gas[40, 10] > 10 * gas[40, 29]  # y = 20.25: x = 5.25, downwind, and x = 14.75
    at = concentration(
        (5.25, 20.25, 0.0), (10.0, 20.0, 1.0), (3.0, 0.0), rate=300.0, diffusivity=4.0, lifetime=10.0
    )
    assert gas[40, 10] == pytest.approx(float(at), rel=1e-6)


def test_only_a_spread_has_a_threshold() -> None:
    assert Scene(Backdrop("uav/1"), stop="spread:0.4").threshold_m == 0.4
    for other in ("", "spread", "spread:x", "within:1,0.99"):
        assert Scene(Backdrop("uav/1"), stop=other).threshold_m is None


def test_a_stop_outside_the_area_says_so_and_one_near_either_source_is_right() -> None:
    release = Release((31.0, 20.0), (2.0, 0.0), q=300.0, d=2.0, tau=10.0)
    told = judged(40, (33.0, 20.0), 2.5, 0.96, release)
    assert told.verdict == "outside"
    assert told.text == (
        "source outside, to the east (96%), near (33.00, 20.00) ± 2.50 m after 40 steps; error 2.00 m"
    )
    assert judged(40, (33.0, 20.0), 2.5, 0.9, release).verdict == "FALSE STOP"
    two = Release((11.0, 20.0), (2.0, 0.0), q=300.0, d=2.0, tau=10.0, second=(20.0, 5.0))
    assert judged(40, (20.5, 5.0), 0.4, 0.0, two).verdict == "located"
    single = [Release(place, (2.0, 0.0), q=300.0, d=2.0, tau=10.0) for place in two.sources]
    assert two.gas(AREA, 12) == pytest.approx(sum(each.gas(AREA, 12) for each in single), rel=1e-5)


def in_winds(*from_deg: float, speed_mps: float = 2.0) -> list[Measurement]:
    """Readings in winds from these directions, ccw from east."""
    return [
        Measurement(
            step,
            float(step),
            (float(step), 0.0),
            0.0,
            1.0,
            (0.0, 0.0),
            (1.0, 0.0, 1.0),
            measured_wind=(
                speed_mps * math.cos(math.radians(degrees)),
                speed_mps * math.sin(math.radians(degrees)),
            ),
        )
        for step, degrees in enumerate(from_deg)
    ]


def test_a_turn_of_the_wind_is_where_it_turns_with_both_winds() -> None:
    (turn,) = turns(in_winds(*[10] * 6, *[100] * 5))
    assert (turn.step, turn.place) == (6, (6.0, 0.0))
    assert turn.degrees == pytest.approx(90)
    assert math.degrees(math.atan2(turn.before[1], turn.before[0])) == pytest.approx(10)
    assert math.degrees(math.atan2(turn.after[1], turn.after[0])) == pytest.approx(100)


def test_each_of_two_turns_is_told_also_through_south() -> None:
    first, second = turns(in_winds(*[170] * 5, *[-150] * 6, *[90] * 5))
    assert (first.step, second.step) == (5, 11)
    assert first.degrees == pytest.approx(40)
    assert second.degrees == pytest.approx(120)


@pytest.mark.parametrize(
    "winds",
    [
        in_winds(*[10] * 12),
        in_winds(*[0, 20] * 6),  # gusty, around one direction
        in_winds(*[10] * 6, 60, *[10] * 6),  # one gust
        in_winds(*[10] * 6, *[100] * 2),  # has not lasted yet
        in_winds(*[10] * 6, *[100] * 6, speed_mps=0.3),  # too weak to have a direction
        in_winds(),
    ],
)
def test_a_steady_wind_has_no_turn(winds: list[Measurement]) -> None:
    assert turns(winds) == []
