"""Protects the problem: Table 1 is its default to the last bit, and what it does not allow is said in a line."""

import math
import re
from typing import Any

import numpy as np
import pytest

from plume.problem import AREA, PAPER, Area, Problem, square
from plume.problems.names import named
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


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (
            {"area": ((0, 0), (60, 40))},
            "area: ((0, 0), (60, 40)) is not allowed; wanted where the search flies",
        ),
        ({"area": {"low": (0, 0)}}, "area: high is missing; wanted its north-east corner"),
        ({"area": {"low": (0, 0), "high": (0, 9)}}, "area.high: [0, 9] is not allowed; wanted a corner"),
        ({"area": None}, "area: None is not allowed; wanted where the search flies"),
        ({"sensor": 5}, "sensor: 5 is not allowed; wanted the gas sensor"),
        ({"q": (1, 2, 3)}, "q: (1, 2, 3) is not allowed; wanted release rate, or its least and greatest"),
        ({"q": True}, "q: True is not allowed; wanted release rate"),
        ({"q": ("a", 3)}, "q[0]: 'a' is not allowed; wanted a number"),
        ({"u": None}, "u: None is not allowed; wanted wind speed"),
        ({"start": (1, 2, 3)}, "start: (1, 2, 3) is not allowed; wanted where searches begin"),
        ({"source": (1,)}, "source: (1,) is not allowed; wanted where it is"),
        ({"source": "here"}, "source: 'here' is not allowed; wanted where it is"),
        ({"prior": 3}, "prior: 3 is not allowed; wanted where the estimator expects the source"),
        ({"prior": {"low": (0, 0)}}, "prior: high is missing; wanted its north-east corner"),
        ({"step_m": True}, "step_m: True is not allowed; wanted length of a move"),
        ({"step_m": "1"}, "step_m: '1' is not allowed; wanted length of a move"),
        ({"step_m": 10**400}, "step_m: 1000000"),
        ({"home": (1, 2, 3)}, "home: (1, 2, 3) is not allowed; wanted latitude and longitude of home"),
        ({"home": ()}, "home: () is not allowed; wanted latitude and longitude of home"),
        ({"source_inside": "yes"}, "source_inside: 'yes' is not allowed; wanted whether the source"),
        ({"budget": 3.5}, "budget: 3.5 is not allowed; wanted most moves of a mission"),
        ({"stop": 5}, "stop: 5 is not allowed; wanted the stop criterion"),
        ({"world": None}, "world: None is not allowed; wanted how gas moves"),
        ({"keep_out": 3}, "keep_out: 3 is not allowed; wanted polygons that no way may enter"),
        ({"keep_out": [(1, 2)]}, "keep_out[0][0]: 1 is not allowed; wanted (x, y) m"),
        (
            {"keep_in": [(1, 2, 3)] * 3},
            "keep_in[0]: (1, 2, 3) is not allowed; wanted (x, y) m",
        ),
        (
            {"keep_out": [[(k, 1), (k + 1, 1), (k, 2)] for k in range(51)]},
            "keep_out: 51 polygons are not allowed; wanted up to 50",
        ),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_a_field_of_a_wrong_kind_is_refused_as_in_a_file(fields: dict[str, Any], said: str) -> None:
    for refuse in (lambda: Problem(**fields), lambda: PAPER.changed(**fields), lambda: named(fields)):
        with pytest.raises(ValueError, match=f"^{re.escape(said)}") as refusal:
            refuse()
        assert "\n" not in str(refusal.value)


def test_lists_dicts_and_numpys_numbers_are_taken() -> None:
    field = {"low": [0, 0], "high": [60, 40]}
    given = Problem(
        area=field,  # type: ignore[arg-type]
        prior=field,  # type: ignore[arg-type]
        q=[100, 200],  # type: ignore[arg-type]
        u=(np.float64(1.5), np.float64(2.5)),
        step_m=np.float64(2.0),
        budget=np.int64(9),  # type: ignore[arg-type]
        start=np.array([1.0, 2.0]),  # type: ignore[arg-type]
        keep_out=[np.array([[20, 20], [24, 20], [24, 24]])],  # type: ignore[arg-type]
    )
    area = Area((0, 0), (60, 40))
    triangle = ((20.0, 20.0), (24.0, 20.0), (24.0, 24.0))
    same = Problem(
        area=area,
        prior=area,
        q=(100, 200),
        u=(1.5, 2.5),
        step_m=2,
        budget=9,
        start=(1, 2),
        keep_out=(triangle,),
    )
    assert given == same
    assert hash(given) == hash(same)
    assert given.text == same.text


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


HOUSES = (
    ((8.0, 8.0), (12.0, 8.0), (12.0, 12.0), (8.0, 12.0)),
    ((18.0, 15.0), (24.0, 15.0), (24.0, 21.0), (18.0, 21.0)),
)


def test_sources_and_starts_are_never_drawn_in_a_polygon_to_keep_out_of() -> None:
    hut = ((1.0, 1.0), (3.0, 1.0), (3.0, 3.0), (1.0, 3.0))
    usual, problem = Problem(), Problem(keep_out=(*HOUSES, hut), clearance_m=0.5)
    moved = 0
    for seed in range(400):
        was, drawn = draw(seed, usual), draw(seed, problem)
        assert not (18 < drawn.source[0] < 24 and 15 < drawn.source[1] < 21)
        off = [max(1 - along, 0.0, along - 3) for along in drawn.start]
        assert math.dist(off, (0, 0)) >= 0.5
        assert all(0 <= part <= 5 for part in drawn.start)
        assert (drawn.q, drawn.u, drawn.phi, drawn.d) == (was.q, was.u, was.phi, was.d)
        moved += drawn.source != was.source
        if not ((18 < was.source[0] < 24 and 15 < was.source[1] < 21) or 8 < max(was.source) < 12):
            assert drawn.source == was.source  # a seed whose source is free keeps it
        assert draw(seed, problem) == drawn
    assert moved > 20
    told = Problem(keep_out=HOUSES, source_inside=True)
    assert all(draw(seed, told).source == draw(seed).source for seed in range(100))


def test_polygons_are_told_in_text_and_to_services_without_the_source() -> None:
    problem = Problem(keep_out=[[[8, 8], [12, 8], [12, 12]]], clearance_m=1, source=(20.0, 20.0))  # type: ignore[list-item]
    assert named(problem.text) == problem
    assert named(problem.told.text).ground == problem.ground
    assert "20.0" not in problem.told.text.replace("30.0", "")
    assert Problem().text == "paper"


def test_a_corner_given_twice_in_a_row_is_one() -> None:
    (hall, _), doubled = HOUSES, [corner for corner in HOUSES[0] for _ in range(2)]
    twice, once = Problem(keep_out=[doubled]), Problem(keep_out=(hall,))  # type: ignore[arg-type]
    assert (twice.ground.obstacles.walls == once.ground.obstacles.walls).all()  # type: ignore[union-attr]
    assert Problem(prior=doubled).expected.text == Problem(prior=hall).expected.text  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"keep_out\[0\]: 2 corners are not allowed; wanted at least 3"):
        Problem(keep_out=[[(5, 5), (5, 5), (9, 9), (9, 9)]])  # type: ignore[list-item]


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"keep_out": [[(5, 5), (9, 9)]]}, r"keep_out\[0\]: 2 corners are not allowed; wanted at least 3"),
        (
            {"keep_out": [[(9, 9), (12, 12), (12, 9), (9, 12)]]},
            r"keep_out\[0\]: its sides 1 and 3 meet; wanted the corners in order",
        ),
        (
            {"keep_out": [[(math.nan, 0), (9, 9), (9, 0)]]},
            r"keep_out\[0\]: the corner \[nan, 0\] is not allowed",
        ),
        ({"keep_in": [(0, 0), (30, 0)]}, "keep_in: 2 corners are not allowed"),
        (
            {"keep_out": [[(k, k * k) for k in range(201)]]},
            "keep_out: 201 corners are not allowed; wanted up to 200",
        ),
        ({"keep_out": HOUSES, "clearance_m": -1.0}, "clearance_m: -1.0 is not allowed; wanted 0 to 1000 m"),
        (
            {"keep_out": HOUSES, "start": (10.0, 10.0)},
            r"start: \[10, 10\] is in keep_out, out of keep_in, within",
        ),
        ({"keep_out": HOUSES, "start": (7.0, 7.0)}, r"start: \[7, 7\] is in keep_out, .* within 2 m of a"),
        (
            {"keep_out": HOUSES, "prior": Area((19.0, 16.0), (23.0, 20.0))},
            r"prior: \[19, 23\] x \[16, 20\] m is inside keep_out, where no source is; wanted",
        ),
        ({"keep_out": HOUSES, "source": (20.0, 20.0)}, r"source: \[20, 20\] is inside keep_out"),
        (
            {"keep_out": [[(-1, 6), (31, 6), (31, 7), (-1, 7)]], "prior": Area((0, 10), (30, 30))},
            "keep_out: it leaves no way from all of the start, .*, to where the source is expected",
        ),
    ],
)
def test_polygons_that_are_none_or_leave_no_search_are_refused_in_one_line(
    fields: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said) as refusal:
        Problem(**fields)
    assert "\n" not in str(refusal.value)
