"""Protects the table of how near vehicles come: distances by hand, and what is counted of rows."""

import math

import pytest

from benchmarks.apart import SEPARATION_M, Searched, Sky, table
from link.modes import Mode


def test_the_sky_measures_the_least_distance_of_what_flies_in_it() -> None:
    """Two fly past each other, 3 m aside, and stop 1 m further on; then one of them climbs, and flies away."""
    sky = Sky([(0.0, 3.0), (20.0, 0.0)])
    sky.take_off(range(2))
    assert sky.least_m["searching"] == pytest.approx(math.hypot(20.0, 3.0))
    sky.goes(0, (10.0, 3.0))
    sky.goes(1, (9.0, 0.0))
    sky.stands_still([0, 1])
    assert sky.least_m["searching"] == pytest.approx(3.0, abs=0.01)
    sky.phase = "home"
    sky.changes(1, Mode.RETURN)
    sky.passes(40.0)
    assert sky.least_m["home"] == pytest.approx(math.hypot(1.0, 3.0), abs=0.01)
    assert math.isinf(sky.least_m["left"])


def test_the_table_has_the_least_distance_and_the_missions_below_the_separation() -> None:
    rows = [
        Searched("lands", 1, "edge", 9, 3.2, 2.5, 3.0),
        Searched("lands", 2, "edge", 9, 3.1, math.inf, SEPARATION_M - 0.5),
        Searched("none", 3, "edge", 9, 3.3, math.inf, 3.4),
    ]
    lines = table(rows).splitlines()
    assert "| lands | 2 | 3.10 | 0 | 2.50 | 1 | 2.50 | 1 |" in lines
    assert "| none | 1 | 3.30 | 0 |  |  | 3.40 | 0 |" in lines
