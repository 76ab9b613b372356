"""Protects the parts of a prior: their areas, their octagons, and how draws are shared among them."""

import math

import numpy as np
import pytest

from plume.polygons.parts import area_of, counts, held, numbered_sides, octagon

L_SHAPE = ((0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0))


@pytest.mark.parametrize("corners", [L_SHAPE, L_SHAPE[::-1], (*L_SHAPE, L_SHAPE[0])])
def test_an_area_is_the_same_in_either_sense_and_with_a_closing_corner(corners) -> None:
    assert area_of(corners) == 6.0


def test_a_place_stands_for_the_octagon_around_it() -> None:
    corners = octagon((100.0, -20.0), 3.0)
    assert [math.dist(corner, (100.0, -20.0)) for corner in corners] == pytest.approx([3.0] * 8)
    assert area_of(corners) == pytest.approx(2 * math.sqrt(2) * 9)


def test_places_in_any_of_two_polygons_are_held_also_where_both_are() -> None:
    other = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
    places = np.array([(3.5, 0.5), (1.5, 1.5), (0.5, 0.5), (3.0, 2.0)])
    assert held(places, [L_SHAPE, other]).tolist() == [True, True, True, False]


def test_sides_have_the_number_of_their_polygon() -> None:
    triangle = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    assert numbered_sides([triangle, L_SHAPE])[:, 4].tolist() == [1.0] * 3 + [2.0] * 6


def test_draws_are_shared_to_within_one_and_none_is_lost() -> None:
    assert counts([0.5, 0.25, 0.25], 1000) == [500, 250, 250]
    thirds = counts([1 / 3] * 3, 100)
    assert sum(thirds) == 100
    assert max(thirds) - min(thirds) <= 1
    assert counts([1.0], 7) == [7]
