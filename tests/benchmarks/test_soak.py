"""Protects the endurance figures: slopes of known series, and intervals that hold as often as they say."""

import math

import pytest

from benchmarks.soak import CONFIDENCE, Slope, slope
from plume.randomness import keyed


def test_a_line_has_its_slope_per_thousand_steps_whatever_its_warm_up_did() -> None:
    found = slope(
        [(step, 5.0 + 0.002 * step + (1e6 if step < 2000 else 0.0)) for step in range(0, 20_001, 10)]
    )
    assert found.value == pytest.approx(2.0, rel=1e-3)
    assert found.interval(1) == pytest.approx((2.0, 2.0), rel=1e-2)


def test_the_difference_of_two_slopes_adds_their_variances() -> None:
    left = Slope(5.0, 3.0, 18).minus(Slope(2.0, 4.0, 18))
    assert left == pytest.approx((3.0, 5.0, 625 / ((81 + 256) / 18)))
    assert left.interval(1)[0] == pytest.approx(
        3.0 - 2.0345 * 5.0, rel=1e-3
    )  # Student's t for 33.4 degrees of freedom, from a table


@pytest.mark.full
def test_of_random_walks_that_drift_one_in_twenty_is_missed() -> None:
    drift, steps, walks = 0.5, 2000, 400
    missed = 0
    for key in range(walks):
        walk = (drift + keyed(key, "soak test").normal(0.0, 1.0, steps)).cumsum()
        low, high = slope(list(enumerate(walk.tolist()))).interval(1)
        missed += not low < 1000 * drift < high
    rate = 1 - CONFIDENCE
    assert abs(missed / walks - rate) < 3 * math.sqrt(
        rate * CONFIDENCE / walks
    )  # three standard errors of 400 draws
