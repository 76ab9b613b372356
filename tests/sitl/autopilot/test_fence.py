"""Protects the fence: what is inside, the exact time of a breach whatever the time steps, and what is done
about it.
"""

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aircraft.state import Said
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.fence import Circle, Fence, Polygon, Rally
from sitl.autopilot.motion import Limits, Trajectory
from sitl.autopilot.vehicle import Vehicle
from tests.ground.tlog.flights import ACCEPTED, DENIED, hovering, offboard, on_the_ground, texts

SQUARE = Polygon(True, ((0.0, 0.0), (0.0, 20.0), (20.0, 20.0), (20.0, 0.0)))
"""(north, east): 20 x 20 m from home."""
ZONE = Polygon(False, ((4.0, 8.0), (4.0, 12.0), (12.0, 12.0), (12.0, 8.0)))
"""A zone that is forbidden, 8 to 12 m east."""
LIMITS = Limits(5.0, 3.0, 1.5, 3.0)
RAMP_S, RAMP_M = 5.0 / 3.0, 25.0 / 6.0  # up to 5 m/s at 3 m/s²


def fenced(*shapes, action=2):
    return VehicleConfig(fence=Fence(shapes, 7), fence_action=action)


def said(events):
    return [(event.time_s, event.text) for event in events if isinstance(event, Said)]


# ---- what is inside ----


@pytest.mark.parametrize(
    ("place", "inside"),
    [
        ((10.0, 10.0), True),
        ((20.0, 5.0), True),
        ((0.0, 0.0), True),
        ((20.001, 5.0), False),
        ((-0.001, 5.0), False),
        ((10.0, 30.0), False),
    ],
)
def test_the_edge_of_a_polygon_belongs_to_it(place, inside):
    assert SQUARE.allows(place) == inside


def test_a_notch_in_a_polygon_is_outside():
    notched = Polygon(
        True, ((0.0, 0.0), (0.0, 10.0), (10.0, 10.0), (5.0, 5.0), (10.0, 0.0))
    )  # a V is cut out of its north side
    assert [notched.allows((north, 5.0)) for north in (1.0, 4.9, 5.1, 9.0)] == [True, True, False, False]


def test_circles_and_zones_are_kept_out_of_or_in():
    inner, outer = Circle(True, (3.0, 4.0), 5.0), Circle(False, (3.0, 4.0), 5.0)
    assert [inner.allows(place) for place in ((3.0, 4.0), (0.0, 0.0), (9.0, 4.0))] == [
        True,
        True,
        False,
    ]  # home is on its edge
    assert [outer.allows(place) for place in ((3.0, 4.0), (0.0, 0.0), (9.0, 4.0))] == [False, True, True]
    assert [ZONE.allows(place) for place in ((8.0, 10.0), (4.0, 10.0), (3.0, 10.0))] == [False, True, True]


def test_every_shape_has_to_be_kept():
    fence = Fence((SQUARE, ZONE))
    assert [fence.allows((*place, -5.0)) for place in ((1.0, 1.0), (8.0, 10.0), (25.0, 1.0))] == [
        True,
        False,
        False,
    ]
    assert Fence().allows((99.0, -99.0, -5.0))


# ---- when a path leaves it ----


@pytest.mark.parametrize(
    ("edge_m", "after_s"),
    [
        (1.5, 1.0),  # 3 m/s² for 1 s
        (10.0, RAMP_S + (10.0 - RAMP_M) / 5.0),  # while it cruises
        (30.0 - 1.5, 2 * RAMP_S + (30.0 - 2 * RAMP_M) / 5.0 - 1.0),  # 1 s before it has come to rest at 30 m
    ],
)
@pytest.mark.parametrize(
    "shape",
    [
        lambda edge: Circle(True, (0.0, 0.0), edge),
        lambda edge: Polygon(False, ((-9, edge), (9, edge), (0, 99))),
    ],
)
def test_a_leg_leaves_the_fence_at_the_time_of_the_formula(shape, edge_m, after_s):
    path = Trajectory(100.0, (0.0, 0.0, -5.0)).to((0.0, 30.0, -5.0), LIMITS)
    assert Fence((shape(edge_m),)).left_s(path, 100.0, False) == pytest.approx(100.0 + after_s, abs=1e-8)


def test_a_path_that_only_touches_the_edge_or_begins_outside_does_not_leave():
    path = Trajectory(0.0, (20.0, 0.0, -5.0)).to((20.0, 20.0, -5.0), LIMITS)
    assert Fence((SQUARE,)).left_s(path, 0.0, False) == math.inf  # along its north edge
    homeward = Trajectory(0.0, (0.0, 25.0, -5.0)).to((0.0, 2.0, -5.0), LIMITS)
    assert Fence((SQUARE,)).left_s(homeward, 0.0, True) == math.inf


def test_a_path_that_comes_in_and_goes_out_again_leaves_once():
    path = Trajectory(0.0, (6.0, 0.0, -5.0)).to((6.0, 30.0, -5.0), LIMITS)
    cruise = lambda east: RAMP_S + (east - RAMP_M) / 5.0  # noqa: E731
    assert Fence((ZONE,)).left_s(path, 0.0, False) == pytest.approx(cruise(8.0), abs=1e-8)
    inside_out = Fence((ZONE._replace(inclusion=True),))
    assert inside_out.left_s(path, 0.0, True) == pytest.approx(cruise(12.0), abs=1e-8)


# ---- refusals ----


def test_a_target_outside_the_fence_is_refused_with_its_reason():
    vehicle = offboard(fenced(SQUARE))
    refused = vehicle.setpoint(10.0, (5.0, 25.0, -5.0))
    assert refused == (DENIED, "Waypoint refused: (25.0, 5.0) m is outside the fence", "outside the fence")
    assert (
        vehicle.go_to(10.0, (25.0, 5.0, -5.0)).reason == "Go-to refused: (5.0, 25.0) m is outside the fence"
    )
    assert vehicle.setpoint(10.0, (5.0, 15.0, -5.0)).code == ACCEPTED


def test_a_take_off_outside_the_fence_is_refused():
    vehicle = on_the_ground(fenced(Circle(False, (0.0, 0.0), 3.0)))
    vehicle.arm(0.0)
    assert vehicle.take_off(0.0).reason == "Take-off refused: (0.0, 0.0) m is outside the fence"


def test_a_fence_without_an_action_refuses_nothing():
    assert offboard(fenced(SQUARE, action=0)).setpoint(10.0, (5.0, 25.0, -5.0)).code == ACCEPTED


# ---- breaches ----

BREACH_S = (
    10.0 + RAMP_S + (8.0 - RAMP_M) / 5.0
)  # a leg from home to 20 m east, which begins at 10 s, comes to the zone at 8 m
ACROSS = Polygon(False, ((-4.0, 8.0), (-4.0, 12.0), (12.0, 12.0), (12.0, 8.0)))


def breaching(action):
    vehicle = offboard(fenced(ACROSS, action=action))
    assert vehicle.setpoint(10.0, (0.0, 20.0, -5.0)).accepted
    return vehicle


@pytest.mark.parametrize(
    ("action", "mode", "word"),
    [
        (1, Mode.OFFBOARD, ""),
        (2, Mode.HOLD, ": holding"),
        (3, Mode.RETURN, ": returning"),
        (5, Mode.LAND, ": landing"),
    ],
)
def test_what_a_breach_leads_to_is_px4s_gf_action(action, mode, word):
    vehicle = breaching(action)
    assert vehicle.next_event_s() == pytest.approx(BREACH_S, abs=1e-8)
    assert said(vehicle.advance(BREACH_S + 0.01)) == [
        (pytest.approx(BREACH_S, abs=1e-8), f"Fence breached at (8.00, 0.00) m{word}")
    ]
    state = vehicle.state(BREACH_S + 0.01)
    assert (state.mode, state.failsafe) == (mode, action != 1)
    assert (state.breaches.times, state.breaches.outside) == (1, True)


def test_a_hold_stops_behind_the_fence_as_soon_as_it_can():
    vehicle = breaching(2)
    vehicle.advance(60.0)
    assert vehicle.state(60.0).position == pytest.approx((0.0, 8.0 + RAMP_M, -5.0), abs=1e-7)
    assert vehicle.state(60.0).mode is Mode.HOLD


def test_a_landing_after_a_breach_ends_on_the_ground_and_a_return_at_home():
    for action, east in ((5, 8.0 + RAMP_M), (3, 0.0)):
        vehicle = breaching(action)
        vehicle.advance(120.0)
        assert vehicle.state(120.0).position == pytest.approx((0.0, east, 0.0), abs=1e-7)
        assert not vehicle.state(120.0).armed


def test_a_termination_stops_the_motors():
    vehicle = breaching(4)
    assert texts(vehicle.advance(60.0)) == [
        "Fence breached at (8.00, 0.00) m: motors stopped",
        "Motors stopped in the air",
    ]
    # It falls 5 m in sqrt(2 * 5 / g) s at 5 m/s.
    assert vehicle.state(60.0).position == pytest.approx((0.0, 8.0 + 5.0 * math.sqrt(10.0 / 9.80665), 0.0))
    assert not vehicle.state(60.0).armed


def test_every_breach_of_a_leg_is_told_when_it_is_only_warned():
    second = Polygon(False, ((-4.0, 14.0), (-4.0, 16.0), (12.0, 16.0), (12.0, 14.0)))
    vehicle = offboard(fenced(ACROSS, second, action=1))
    vehicle.setpoint(10.0, (0.0, 20.0, -5.0))
    assert texts(vehicle.advance(20.0)) == [
        "Fence breached at (8.00, 0.00) m",
        "Fence breached at (14.00, 0.00) m",
    ]


def test_a_vehicle_that_returns_already_only_warns():
    vehicle = hovering(fenced(action=2))
    vehicle.go_to(5.0, (0.0, 20.0, -5.0))
    vehicle.advance(30.0)
    vehicle.configure(30.0, fenced(ACROSS, action=2))
    vehicle.set_mode(30.0, Mode.RETURN)
    assert texts(vehicle.advance(40.0)) == ["Fence breached at (12.00, 0.00) m"]
    vehicle.advance(90.0)
    assert vehicle.state(90.0).position == (0.0, 0.0, 0.0)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.001, 3.0), max_size=60), st.sampled_from([1, 2, 3, 5]))
def test_a_breach_does_not_depend_on_the_time_steps(steps, action):
    stepped, jumped = breaching(action), breaching(action)
    events, now = [], 10.0
    for step in steps:
        now += step
        events += stepped.advance(now)
    assert events == jumped.advance(now)
    assert stepped.state(now) == jumped.state(now)


# ---- rally points ----


@pytest.mark.parametrize(("north", "goes_to"), [(4.0, (0.0, 0.0, 0.0)), (14.0, (18.0, 3.0, 0.0))])
def test_a_return_goes_to_the_nearest_of_home_and_rally_points(north, goes_to):
    vehicle = Vehicle(replace(VehicleConfig(), rally=Rally(((18.0, 3.0), (29.0, 29.0)))))
    vehicle.arm(0.0)
    vehicle.take_off(0.0)
    vehicle.advance(5.0)
    vehicle.go_to(5.0, (north, 3.0, -5.0))
    vehicle.advance(20.0)
    assert vehicle.set_mode(20.0, Mode.RETURN).accepted
    vehicle.advance(80.0)
    assert vehicle.state(80.0).position == goes_to
