"""Protects the projection between local metres and latitude and longitude."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plume.geodesy import EARTH_RADIUS_M, to_global, to_local

HOME = (47.397742, 8.545594)


def test_home_is_the_origin():
    assert to_global(*HOME, 0.0, 0.0) == HOME
    assert to_local(*HOME, *HOME) == (0.0, 0.0)


def test_a_degree_north_is_a_360th_of_the_circumference():
    assert to_local(*HOME, HOME[0] + 1.0, HOME[1]) == pytest.approx(
        (math.pi * EARTH_RADIUS_M / 180.0, 0.0), abs=1e-6
    )


def test_east_shrinks_with_the_cosine_of_the_latitude():
    north, east = to_local(60.0, 10.0, 60.0, 10.001)
    assert east == pytest.approx(math.radians(0.001) * EARTH_RADIUS_M * 0.5, rel=1e-6)
    assert north == pytest.approx(0.0, abs=1e-3)


@given(st.floats(-80.0, 80.0), st.floats(-180.0, 180.0), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_there_and_back_is_the_same_point(lat, lon, north, east):
    assert to_local(lat, lon, *to_global(lat, lon, north, east)) == pytest.approx((north, east), abs=1e-6)


@given(st.floats(-80.0, 80.0), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_the_distance_is_the_great_circles(lat0, north, east):
    lat, lon = to_global(lat0, 0.0, north, east)
    a = (
        math.sin(math.radians(lat - lat0) / 2) ** 2
        + math.cos(math.radians(lat0)) * math.cos(math.radians(lat)) * math.sin(math.radians(lon) / 2) ** 2
    )
    assert 2.0 * EARTH_RADIUS_M * math.asin(math.sqrt(a)) == pytest.approx(math.hypot(north, east), abs=1e-5)


def test_longitude_wraps_at_the_date_line():
    assert to_global(0.0, 179.9999, 0.0, 100.0)[1] == pytest.approx(
        -180.0 + math.degrees(100.0 / EARTH_RADIUS_M) - 0.0001
    )
    assert to_local(0.0, 179.9999, 0.0, -179.9999)[1] == pytest.approx(math.radians(0.0002) * EARTH_RADIUS_M)


@given(st.sampled_from([-1.0, 1.0]), st.floats(0.0, 1e5), st.floats(-180.0, 180.0), st.floats(-0.01, 0.01))
def test_a_place_at_a_pole_is_as_far_from_home_as_it_was_flown(pole, away_m, lon, beside_m):
    home = pole * (90.0 - math.degrees(away_m / EARTH_RADIUS_M)), lon
    lat, turned = to_global(*home, pole * away_m, beside_m)
    assert abs(lat) <= 90.0
    assert abs(turned) <= 180.0
    assert to_local(*home, lat, turned) == pytest.approx((pole * away_m, beside_m), abs=0.2)
