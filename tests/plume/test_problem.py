"""Protects the problem: Table 1 is its default to the last bit, and what it does not allow is said in a line."""

import math
from typing import Any

import numpy as np
import pytest

from plume.problem import AREA, PAPER, Area, Problem, square
from plume.scenario import draw

WIDE = Area((-50.0, 0.0), (150.0, 80.0))


def test_the_default_problem_draws_what_table_1_draws() -> None:
    assert [draw(seed, Problem()) for seed in range(300)] == [draw(seed) for seed in range(300)]
    assert PAPER.text == "paper"


def test_scenarios_are_drawn_from_the_problem() -> None:
    problem = Problem(area=WIDE, prior=Area((0, 10), (60, 70)), q=250.0, tau=(5.0, 15.0), start=(1.0, 2.0))
    drawn = [draw(seed, problem) for seed in range(400)]
    places = np.array([each.source for each in drawn])
    assert places.min(axis=0) == pytest.approx([0.0, 10.0], abs=1.0)
    assert places.max(axis=0) == pytest.approx([60.0, 70.0], abs=1.0)
    assert {(each.q, each.start) for each in drawn} == {(250.0, (1.0, 2.0))}
    lifetimes = [each.tau for each in drawn]
    assert pytest.approx((min(lifetimes), max(lifetimes)), abs=0.2) == (5.0, 15.0)


def test_without_a_prior_sources_are_drawn_from_the_whole_area_of_another_problem() -> None:
    places = np.array([draw(seed, Problem(area=WIDE)).source for seed in range(400)])
    assert places.min(axis=0) == pytest.approx([-50.0, 0.0], abs=2.0)
    assert places.max(axis=0) == pytest.approx([150.0, 80.0], abs=2.0)


def test_a_search_begins_in_the_south_western_sixth_of_its_area() -> None:
    starts = np.array([draw(seed, Problem(area=WIDE)).start for seed in range(400)])
    assert (starts >= (-50.0, 0.0)).all()
    assert (starts <= (-50.0 + 200 / 6, 80 / 6)).all()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"step_m": 11.0}, "step_m: 11.0 is not allowed; wanted above 0 up to 10 m"),
        ({"step_m": math.nan}, "step_m: nan is not allowed; wanted above 0 up to 10 m"),
        ({"area": Area((0, 0), (0.5, 3))}, "area: .* is not allowed; wanted sides of at least 1 m"),
        (
            {"start": (40.0, 2.0)},
            r"start: \[40, 2\] is not allowed; wanted a place or a rectangle in the area",
        ),
        ({"prior": Area((20, 20), (40, 40))}, r"prior: \[20, 40\] x \[20, 40\] m is not allowed; wanted"),
        ({"source": (math.inf, 2.0)}, r"source: \[inf, 2\] is not allowed; wanted"),
        ({"q": (5.0, 1.0)}, r"q: \[5, 1\] is not allowed; wanted a number, or the least and the greatest"),
        ({"u": math.nan}, "u: nan is not allowed"),
        ({"budget": 0}, "budget: 0 is not allowed; wanted a whole number from 1"),
        ({"altitude_m": 0.0}, "altitude_m: 0.0 is not allowed; wanted above 0 up to 120 m"),
        ({"dwell_s": -1.0}, "dwell_s: -1.0 is not allowed; wanted 0 to 600 s"),
        ({"stop": "soon"}, "stop: 'soon' is not allowed; wanted spread:Z"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_what_is_not_allowed_is_said_in_a_line(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Problem(**fields)
    with pytest.raises(ValueError, match=said):
        PAPER.changed(**fields)


@pytest.mark.parametrize("high", [(0.0, 5.0), (-1.0, 5.0), (math.nan, 5.0), (1e6, 5.0)])
def test_an_area_has_its_second_corner_in_the_north_east(high: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"high: .* is not allowed; wanted"):
        Area((0.0, 0.0), high)


def test_an_area_says_beyond_which_edges_a_place_is() -> None:
    places = {"": (0, 0), "north": (0, 81), "south-west": (-51, -1), "east": (151, 40)}
    assert {WIDE.beyond(place): place for place in places.values()} == places
    assert WIDE.clipped([(-60.0, 90.0), (1.0, 2.0)]).tolist() == [[-50.0, 80.0], [1.0, 2.0]]
    assert WIDE.held(np.array([(-50.0, 80.0), (-50.1, 3.0)])).tolist() == [True, False]


def test_what_goes_on_the_wire_stays_in_the_area() -> None:
    """A waypoint is float32: the nearest one to 0.1 m is beyond it."""
    assert AREA.on_the_wire() == AREA
    inner = Area((0.1, -0.1), (2.1, 2.7)).on_the_wire()
    for axis, (low, high) in enumerate(((0.1, 2.1), (-0.1, 2.7))):
        assert low <= inner.low[axis] == float(np.float32(inner.low[axis]))
        assert high >= inner.high[axis] == float(np.float32(inner.high[axis]))


def test_the_side_of_a_square_is_exact() -> None:
    sides = [0.1 * number for number in range(11, 3000, 7)]
    assert [square(side).side_m for side in sides] == sides
