"""Protects what every aircraft refuses, simulated or real: ways through what the problem keeps out of."""

from aircraft.state import AircraftConfig
from plume.problem import Problem

HOUSE = ((10.0, 2.0), (14.0, 2.0), (14.0, 20.0), (10.0, 20.0))  # east, north
CONFIG = AircraftConfig(area=Problem(keep_out=(HOUSE,), clearance_m=3.0, start=(1.0, 1.0)).ground)


def test_a_way_through_a_building_is_refused_with_its_reason_whichever_way_it_is_flown() -> None:
    west, east = (10.0, 5.0, -5.0), (10.0, 20.0, -5.0)
    kind, reason = CONFIG.in_the_way(west, east) or ("", "")
    assert (kind, reason) == ("keep-out", "the way to (20.0, 10.0) m crosses a polygon of keep_out")
    assert CONFIG.in_the_way(east, west)
    assert CONFIG.in_the_way(west, (10.0, 12.0, -5.0))  # into it


def test_a_way_past_a_building_is_flown_even_nearer_than_the_clearance() -> None:
    """A vehicle is not exactly where its agent takes it to be: the clearance is for the difference."""
    assert CONFIG.in_the_way((10.0, 9.0, -5.0), (1.0, 9.0, -5.0)) is None
    assert CONFIG.in_the_way((1.0, 5.0, -5.0), (1.0, 20.0, -5.0)) is None


def test_in_an_open_area_no_way_is_refused() -> None:
    assert AircraftConfig().in_the_way((10.0, 5.0, -5.0), (10.0, 20.0, -5.0)) is None
