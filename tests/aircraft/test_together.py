"""Protects where several vehicles may stand before they search together: their ways to their starts keep
apart, also if nobody knows of another's home.
"""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET
from msgspec.structs import replace

from aircraft.remote.preflight import farthest_m
from aircraft.together import Berth, Joining, Together
from link.bus.messages import Join, Latecomer, LeftAt, RoundReading
from plume.problem import AREA
from tests.system.test_view import belief as one_belief

APART_M = 3.0
coordinates = st.floats(-40.0, 60.0)
places = st.tuples(coordinates, coordinates)


def berth(own: tuple[float, float], other: tuple[float, float]) -> Berth:
    return Berth(own, [other], APART_M)


def gap_m(one: tuple, other: tuple) -> float:
    """The distance of two straight ways, by many points on each."""
    shares = np.linspace(0.0, 1.0, 101)[:, None]
    on_one, on_other = (np.array(way[0]) + shares * np.subtract(way[1], way[0]) for way in (one, other))
    return float(np.linalg.norm(on_one[:, None] - on_other[None], axis=-1).min())


@given(places, places, places, places)
def test_ways_from_homes_that_are_allowed_keep_apart(
    home: tuple[float, float],
    start: tuple[float, float],
    other_home: tuple[float, float],
    other_start: tuple[float, float],
) -> None:
    if math.dist(start, other_start) < APART_M:
        return  # a fleet has no such starts
    if berth(start, other_start).crowded(home) or berth(other_start, start).crowded(other_home):
        return
    assert gap_m((home, start), (other_home, other_start)) >= APART_M - 1e-6


def test_homes_at_the_wrong_corners_are_not_allowed() -> None:
    assert berth((2.0, 2.0), (28.0, 28.0)).crowded((0.0, 0.0)) is None
    assert berth((28.0, 28.0), (2.0, 2.0)).crowded((0.0, 0.0)) == (2.0, 2.0)
    assert berth((28.0, 28.0), (2.0, 2.0)).crowded((15.0, 15.0)) == (2.0, 2.0)
    assert berth((28.0, 28.0), (2.0, 2.0)).crowded((17.0, 17.0)) is None


def test_a_home_far_from_the_area_is_not_allowed() -> None:
    own = berth((2.0, 2.0), (28.0, 28.0))
    assert own.misplaced((-29.0, -29.0), AREA) == ""
    said = own.misplaced((-31.0, -31.0), AREA)
    assert said.startswith("home is 44 m from the area, (-31, -31) m from its origin; wanted at most 42 m")


def test_how_far_a_vehicle_flies_from_home_is_by_its_own_home() -> None:
    assert farthest_m(AREA) == math.hypot(30.0, 30.0)
    assert farthest_m(AREA, (30.0, 0.0)) == math.hypot(30.0, 30.0)
    assert farthest_m(AREA, (15.0, 15.0)) == math.hypot(15.0, 15.0)


def test_who_has_left_is_not_waited_for_and_takes_no_part_from_then_on() -> None:
    together = Together(3)
    assert together.services >= {"estimator", "agent", "uav/1", "uav/2", "uav/3"}
    together.leaves(2, 4)
    together.leaves(2, 1)  # said again, as it was not
    assert "uav/2" not in together.services
    assert (together.here(3), together.here(4)) == ([1, 2, 3], [1, 3])


def test_one_that_comes_late_is_not_waited_for_and_takes_part_from_its_round_on() -> None:
    together = Together(3, number=2)
    together.comes_late(Latecomer(3))
    assert "uav/3" not in together.services
    assert (together.here(7), together.begin) == ([1, 2], 0)
    together.comes_late(Latecomer(3, (2.0, 3.0), 4, 6))
    together.comes_late(Latecomer(3, (2.0, 3.0), 4))  # said again, as it was before
    assert (together.here(5), together.here(6)) == ([1, 2], [1, 2, 3])
    assert "uav/3" not in together.services  # the search has begun


def test_a_latecomer_takes_off_once_the_others_are_told_to_keep_clear_and_are() -> None:
    """By the separation and 1 m, as far as it may stand from its start."""
    joining = Joining(2, berth((10.0, 10.0), (28.0, 28.0)))
    assert joining.asks == Join((10.0, 10.0))
    told = (LeftAt(2, (10.0, 10.0), (10.0, 10.0)),)
    for place, left_at, clear in (
        ((14.1, 10.0), UNSET, False),
        ((13.9, 10.0), told, False),
        ((14.1, 10.0), (LeftAt(3, (10.0, 10.0), (10.0, 10.0)),), False),
        ((14.1, 10.0), told, True),
        ((13.9, 10.0), told, False),  # as of the newest belief
        (
            (14.1, 10.0),
            (*told, LeftAt(3, (10.0, 13.1), (10.0, 14.1))),
            True,
        ),  # one that has left, clear of it
        ((14.1, 10.0), (*told, LeftAt(3, (10.0, 13.1), (10.0, 13.9))), False),  # hovers too near
        ((14.1, 10.0), (*told, LeftAt(3, (10.0, 12.9), (10.0, 14.1))), False),  # stands too near
    ):
        reading = RoundReading(1, 1, 5, place, 5.0, 0.1)
        joining.hear(replace(one_belief(3), readings=(reading,), left_at=left_at))
        assert joining.asks == Join((10.0, 10.0), clear)
