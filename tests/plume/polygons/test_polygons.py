"""Protects polygons: what is inside, which ways are free, and how long the ways around are."""

import math

import numpy as np
import pytest

from plume.polygons.obstacles import HAIR_M, Obstacles
from plume.polygons.polygons import enclosed, grown_corners, sides_of

HOUSE = ((10.0, 10.0), (20.0, 10.0), (20.0, 20.0), (10.0, 20.0))
YARD = ((0.0, 0.0), (30.0, 0.0), (30.0, 10.0), (10.0, 10.0), (10.0, 30.0), (0.0, 30.0))  # an L


def obstacles(*keep_out: tuple, keep_in: tuple = (), clearance_m: float = 1.0) -> Obstacles:
    return Obstacles(keep_out, keep_in, clearance_m, (0.0, 0.0), (30.0, 30.0))


def way(*ends: tuple[float, float]) -> np.ndarray:
    return np.array(ends)


@pytest.mark.parametrize("corners", [HOUSE, HOUSE[::-1], (*HOUSE, HOUSE[0])])
def test_a_place_is_inside_a_polygon_whichever_way_around_its_corners_are(corners: tuple) -> None:
    places = np.array([[15.0, 15.0], [9.9, 15.0], [15.0, 20.1], [19.9, 10.1], [25.0, 20.0], [5.0, 10.0]])
    assert enclosed(places, sides_of(corners)).tolist() == [True, False, False, True, False, False]


def test_a_place_in_two_polygons_at_once_is_inside() -> None:
    shifted = tuple((x + 5, y + 5) for x, y in HOUSE)
    assert obstacles(HOUSE, shifted[::-1]).enclose(
        np.array([[17.0, 17.0], [22.0, 22.0], [11.0, 22.0]])
    ).tolist() == [
        True,
        True,
        False,
    ]


def test_a_way_is_free_if_it_stays_further_from_all_sides_than_the_clearance() -> None:
    ways = {
        ((5.0, 5.0), (25.0, 5.0)): True,
        ((5.0, 15.0), (25.0, 15.0)): False,  # through it
        ((5.0, 8.99), (25.0, 8.99)): True,
        ((5.0, 9.0), (25.0, 9.0)): False,  # as near as the clearance
        ((14.0, 15.0), (16.0, 15.0)): False,  # inside it
        ((5.0, 15.0), (9.5, 15.0)): False,  # towards it
        ((9.2, 9.2), (5.0, 5.0)): True,  # 1.13 m from its corner
        ((9.4, 9.4), (5.0, 5.0)): False,  # 0.85 m
    }
    assert obstacles(HOUSE).are_free(np.array([*ways])).tolist() == [*ways.values()]


def test_without_a_clearance_a_way_must_not_even_touch() -> None:
    here = obstacles(HOUSE, clearance_m=0.0)
    assert here.are_free(way((5.0, 9.999), (25.0, 9.999)))
    assert not here.are_free(way((5.0, 10.0), (25.0, 10.0)))


def test_ways_stay_inside_the_polygon_to_keep_in() -> None:
    here = obstacles(keep_in=YARD)
    assert here.are_free(way((5.0, 5.0), (25.0, 5.0)))
    assert not here.are_free(way((5.0, 25.0), (25.0, 5.0)))  # across the bend
    assert not here.are_free(way((20.0, 20.0), (21.0, 20.0)))  # outside
    assert not here.are_free(way((0.5, 5.0), (5.0, 5.0)))  # from its edge


@pytest.mark.parametrize("corners", [HOUSE, ((5.0, 5.0), (25.0, 6.0), (5.0, 7.0))])
def test_lines_between_grown_corners_are_the_margin_away(corners: tuple) -> None:
    """A square has four for each corner, a splinter more at its sharp ends."""
    sides = sides_of(corners)
    grown, _ = grown_corners(sides, 2.0)
    assert len(grown) == (16 if corners == HOUSE else 24)
    assert not enclosed(grown, sides).any()
    around = np.stack([grown, np.roll(grown, -1, axis=0)], axis=1)
    grazing = Obstacles([corners], (), 2.0 - 1e-9, (0.0, 0.0), (30.0, 30.0))
    assert grazing.are_free(around).all()
    assert not Obstacles([corners], (), 2.0 + 1e-9, (0.0, 0.0), (30.0, 30.0)).are_free(around).any()


def test_the_way_between_corners_goes_around_the_house() -> None:
    here = obstacles(HOUSE)
    off = 1.0 + HAIR_M
    half = off * math.tan(math.radians(22.5 / 2))  # of a piece of the way round a corner
    places = ((10 - half, 10 - off), (20 + half, 10 - off), (20 + off, 20 + half))
    a, b, c = (int(np.argmin(np.square(here.corners - place).sum(axis=1))) for place in places)
    assert here.corners[[a, b, c]] == pytest.approx(np.array(places))
    assert here.between[a, b] == pytest.approx(10 + 2 * half)
    assert here.between[a, c] == pytest.approx(2 * (10 + 2 * half) + 3 * 2 * half)
    assert (here.between == here.between.T).all()


def test_a_way_turns_only_at_the_corners_that_it_grazes() -> None:
    """Seen from the west, a house hides behind its two western corners; from the south-west, behind two others."""
    here = obstacles(HOUSE)
    for place, south, north in (((2.0, 15.0), (10, 10), (10, 20)), ((5.0, 5.0), (20, 10), (10, 20))):
        found = here.past(np.array(place))
        seen = found[here.are_free(np.stack(np.broadcast_arrays(np.array(place), found), axis=1))]
        assert len(seen) == 2
        for corner, of in zip(seen[np.argsort(seen[:, 1])], (south, north), strict=True):
            assert math.dist(corner, of) < 1.04


def test_the_way_in_a_bent_yard_turns_at_its_inner_corner() -> None:
    here = obstacles(keep_in=YARD)
    off = np.sqrt(np.square(here.corners - 10).sum(axis=1))
    assert len(off) == 4
    assert ((off > 1) & (off < 1.04)).all()
    assert (here.corners < 10).all()


def test_a_wall_across_leaves_no_way_and_a_gap_in_it_does() -> None:
    start, goal = np.array([[5.0, 5.0]]), np.array([[5.0, 25.0]])
    wall = ((-1.0, 14.0), (31.0, 14.0), (31.0, 15.0), (-1.0, 15.0))
    short = ((-1.0, 14.0), (25.0, 14.0), (25.0, 15.0), (-1.0, 15.0))
    assert obstacles(wall).join(start, goal).tolist() == [False]
    assert obstacles(short).join(start, goal).tolist() == [True]
    assert obstacles(short, clearance_m=6.0).join(start, goal).tolist() == [False]


def test_many_ways_are_judged_as_one_at_a_time_is() -> None:
    rng = np.random.default_rng(5)
    ways = rng.random((500, 2, 2)) * 30
    here = obstacles(HOUSE, ((2.0, 2.0), (5.0, 2.0), (4.0, 6.0)))
    assert here.are_free(ways).tolist() == [bool(here.are_free(each)) for each in ways]
    sampled = [
        all(not here.enclose(start + share * (end - start)) for share in np.linspace(0, 1, 200))
        for start, end in ways
    ]
    assert not (here.are_free(ways) & ~np.array(sampled)).any()  # no free way has a place inside
    assert 0.1 < here.are_free(ways).mean() < 0.9
    assert math.isfinite(here.between.max())
