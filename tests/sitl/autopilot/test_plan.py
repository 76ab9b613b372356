"""Protects missions: what each item does and when, to the formula's time, and that neither depends on the
time steps.
"""

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Reached
from link.modes import Mode
from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.fence import Circle, Fence
from sitl.autopilot.plan import BadItem, Item, step
from sitl.autopilot.telemetry import Snapshot, Telemetry
from sitl.autopilot.vehicle import Vehicle
from tests.ground.tlog.flights import (
    CLIMB_S,
    CONFIG,
    GROUND,
    LANDING,
    NAN,
    REJECTED,
    TAKING_OFF,
    hovering,
    on_the_ground,
    texts,
)

TAKEOFF, WAYPOINT, LOITER, LOITER_TIME, RETURN, LAND, DELAY, JUMP, SPEED = (
    22,
    16,
    17,
    19,
    20,
    21,
    93,
    177,
    178,
)
RELATIVE, NO_FRAME = 6, 2
NONE, NOT_STARTED, ACTIVE, PAUSED, COMPLETE = 1, 2, 3, 4, 5  # MISSION_STATE
LEG_S = 10.0 / 5.0 + 5.0 / 3.0  # 10 m at 5 m/s and 3 m/s²: length / speed + speed / acceleration


def item(command, *params, east=None, north=None, up=5.0, frame=None, autocontinue=1):
    """An item at a place in m from home; without one it has no position."""
    if east is None:
        x = y = 0
    else:
        lat, lon = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, north, east)
        x, y = round(lat * 1e7), round(lon * 1e7)
    placed = command in (TAKEOFF, WAYPOINT, LOITER, LOITER_TIME, LAND)
    frame = (RELATIVE if placed else NO_FRAME) if frame is None else frame
    filled = (*params, *[NAN if placed and n == 3 else 0.0 for n in range(len(params), 4)])
    return Item(command, frame, autocontinue, filled, x, y, up)


def load(vehicle, *items, t_s=None):
    vehicle.load(
        vehicle.now_s if t_s is None else t_s,
        tuple(step(each, len(items), vehicle.config) for each in items),
        99,
    )
    return vehicle


def started(*items, vehicle=None):
    """A vehicle that hovers 5 m above home and begins a mission at 10 s."""
    vehicle = load(vehicle or hovering(), *items)
    assert vehicle.set_mode(10.0, Mode.MISSION).accepted
    return vehicle


def reached(events):
    return [(event.seq, event.time_s) for event in events if isinstance(event, Reached)]


def at(vehicle, t_s):
    north, east, down = vehicle.state(t_s).position
    return pytest.approx((east, north, -down), abs=0.02)  # 1e-7 degrees are 1.1 cm


# ---- refusals ----


def test_a_mission_mode_without_a_mission_is_refused():
    for vehicle in (on_the_ground(), hovering()):
        assert vehicle.set_mode(10.0, Mode.MISSION)[:2] == (REJECTED, "Mission refused: no mission on board")
        assert vehicle.state(10.0).mode is Mode.HOLD
        assert vehicle.state(10.0).mission.state == NONE


REFUSED = {
    "unknown command": (item(31000), mavlink.MAV_MISSION_UNSUPPORTED),
    "home cannot be set": (item(179), mavlink.MAV_MISSION_UNSUPPORTED),
    "a waypoint in a local frame": (
        item(WAYPOINT, east=1, north=1, frame=1),
        mavlink.MAV_MISSION_UNSUPPORTED_FRAME,
    ),
    "a waypoint without a frame": (
        item(WAYPOINT, east=1, north=1, frame=2),
        mavlink.MAV_MISSION_UNSUPPORTED_FRAME,
    ),
    "a negative hold time": (item(WAYPOINT, -1.0, east=1, north=1), mavlink.MAV_MISSION_INVALID_PARAM1),
    "an infinite yaw": (
        item(WAYPOINT, 0.0, 0.0, 0.0, math.inf, east=1, north=1),
        mavlink.MAV_MISSION_INVALID_PARAM4,
    ),
    "no latitude": (
        item(WAYPOINT, east=1, north=1)._replace(x=0x7FFFFFFF),
        mavlink.MAV_MISSION_INVALID_PARAM5_X,
    ),
    "no longitude": (
        item(WAYPOINT, east=1, north=1)._replace(y=0x7FFFFFFF),
        mavlink.MAV_MISSION_INVALID_PARAM6_Y,
    ),
    "no altitude": (item(WAYPOINT, east=1, north=1, up=NAN), mavlink.MAV_MISSION_INVALID_PARAM7),
    "above the ceiling": (item(WAYPOINT, east=1, north=1, up=121.0), mavlink.MAV_MISSION_INVALID_PARAM7),
    "below the ground": (
        item(WAYPOINT, east=1, north=1, up=4.0, frame=5),
        mavlink.MAV_MISSION_INVALID_PARAM7,
    ),  # 4 m above sea
    "outside the area": (item(WAYPOINT, east=31, north=1), mavlink.MAV_MISSION_INVALID_PARAM5_X),
    "a take-off to nowhere": (item(TAKEOFF, up=0.0), mavlink.MAV_MISSION_INVALID_PARAM7),
    "a delay until a time of day": (item(DELAY, -1.0, 12.0), mavlink.MAV_MISSION_INVALID_PARAM1),
    "a jump behind the end": (item(JUMP, 3.0, 1.0), mavlink.MAV_MISSION_INVALID_PARAM1),
    "a jump without end": (item(JUMP, 0.0, -1.0), mavlink.MAV_MISSION_INVALID_PARAM2),
    "a speed of climbs": (item(SPEED, 2.0, 3.0), mavlink.MAV_MISSION_INVALID_PARAM1),
    "no speed": (item(SPEED, 1.0, 0.0), mavlink.MAV_MISSION_INVALID_PARAM2),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_an_item_that_cannot_be_flown_is_refused_with_the_fitting_result(kind):
    bad, code = REFUSED[kind]
    with pytest.raises(BadItem) as refused:
        step(bad, 3, CONFIG)
    assert refused.value.code == code


def test_an_item_outside_the_fence_is_refused_and_one_inside_is_not():
    config = VehicleConfig(fence=Fence((Circle(True, (0.0, 0.0), 10.0),)))
    with pytest.raises(BadItem, match="outside the fence"):
        step(item(WAYPOINT, east=8, north=8), 1, config)
    step(item(WAYPOINT, east=5, north=5), 1, config)


def test_a_mission_that_a_later_fence_cuts_off_is_refused_at_its_start():
    vehicle = load(hovering(), item(WAYPOINT, east=5, north=5), item(WAYPOINT, east=8, north=8))
    vehicle.configure(10.0, VehicleConfig(fence=Fence((Circle(True, (0.0, 0.0), 10.0),))))
    refused = vehicle.set_mode(10.0, Mode.MISSION)
    assert refused.reason.startswith("Mission refused: item 1: ")
    assert refused.reason.endswith("is outside the fence")


def test_an_item_that_is_not_there_cannot_become_current():
    assert hovering().set_current(10.0, 0).reason == "Mission item 0 refused: no mission on board"
    vehicle = load(hovering(), item(WAYPOINT, east=1, north=1))
    assert vehicle.set_current(10.0, 1).reason == "Mission item 1 refused: allowed is 0 to 0"
    assert vehicle.set_current(10.0, -2).reason == "Mission item -2 refused: allowed is 0 to 0"


# ---- what items do, and when ----


def test_a_leg_takes_the_formulas_time_and_then_the_mission_holds():
    vehicle = started(item(WAYPOINT, east=10, north=0))
    assert vehicle.next_event_s() == pytest.approx(10.0 + LEG_S, abs=0.01)
    events = vehicle.advance(60.0)
    assert reached(events) == [(0, pytest.approx(10.0 + LEG_S, abs=0.01))]
    assert texts(events) == ["Mission finished"]
    assert at(vehicle, 60.0) == (10.0, 0.0, 5.0)
    assert (vehicle.state(60.0).mode, vehicle.state(60.0).mission.state) == (Mode.HOLD, COMPLETE)


def test_a_waypoint_is_reached_after_its_hold_time():
    vehicle = started(item(WAYPOINT, 7.0, east=10, north=0), item(WAYPOINT, east=10, north=10))
    (first, first_s), (second, second_s) = reached(vehicle.advance(60.0))
    assert (first, second) == (0, 1)
    assert first_s == pytest.approx(10.0 + LEG_S + 7.0, abs=0.01)
    assert second_s == pytest.approx(10.0 + LEG_S + 7.0 + LEG_S, abs=0.02)


def test_a_waypoint_is_reached_after_its_turn():
    vehicle = started(item(WAYPOINT, 1.0, 0.0, 0.0, 180.0, east=10, north=0))
    # 180 degrees at 45 degrees/s take 4 s, longer than the leg.
    assert reached(vehicle.advance(60.0)) == [(0, pytest.approx(10.0 + 4.0 + 1.0))]
    assert vehicle.state(60.0).yaw == pytest.approx(math.pi)


def test_without_a_yaw_the_heading_stays():
    vehicle = started(item(WAYPOINT, east=10, north=0))
    vehicle.advance(60.0)
    assert vehicle.state(60.0).yaw == 0.0


def test_altitudes_are_above_home_or_above_the_sea():
    vehicle = started(
        item(WAYPOINT, east=1, north=1, up=8.0), item(WAYPOINT, east=1, north=1, up=488.0 + 6.0, frame=5)
    )
    (_, first_s), _ = reached(vehicle.advance(60.0))
    assert vehicle.state(60.0).position[2] == pytest.approx(-6.0)
    again = started(item(WAYPOINT, east=1, north=1, up=8.0))
    again.advance(first_s)
    assert again.state(first_s).position[2] == -8.0


def test_delays_and_loiters_wait():
    vehicle = started(
        item(DELAY, 3.0),
        item(LOITER_TIME, 4.0, 0.0, 0.0, NAN, east=10, north=0),
        item(LOITER, east=10, north=10),
    )
    events = reached(vehicle.advance(12.0))
    assert vehicle.busy
    events += reached(vehicle.advance(500.0))
    assert events == [(0, 13.0), (1, pytest.approx(13.0 + LEG_S + 4.0, abs=0.01))]
    assert (vehicle.state(500.0).mode, vehicle.state(500.0).mission.state) == (Mode.MISSION, ACTIVE)
    assert at(vehicle, 500.0) == (10.0, 10.0, 5.0)
    assert not vehicle.busy


def test_a_change_of_speed_acts_on_the_items_that_follow():
    slow = 10.0 / 2.0 + 2.0 / 3.0  # 10 m at 2 m/s
    vehicle = started(
        item(SPEED, 1.0, 2.0),
        item(WAYPOINT, east=10, north=0),
        item(SPEED, 1.0, -1.0),
        item(WAYPOINT, east=0, north=0),
        item(SPEED, 1.0, -2.0),
        item(WAYPOINT, east=10, north=0),
    )
    times = [10.0, *(t_s for _, t_s in reached(vehicle.advance(90.0)))]
    assert [b - a for a, b in itertools.pairwise(times)] == pytest.approx([slow, slow, LEG_S], abs=0.02)


def test_a_jump_repeats_items_as_often_as_it_says():
    vehicle = started(
        item(WAYPOINT, east=10, north=0),
        item(WAYPOINT, east=0, north=0),
        item(JUMP, 0.0, 2.0),
        item(DELAY, 1.0),
    )
    assert [seq for seq, _ in reached(vehicle.advance(200.0))] == [0, 1, 0, 1, 0, 1, 3]


@pytest.mark.parametrize(
    "items",
    [(item(JUMP, 0.0, 1000.0),), (item(DELAY, 0.0), item(JUMP, 0.0, 1000.0), item(JUMP, 0.0, 1000.0))],
)
def test_jumps_that_lead_nowhere_end(items):
    vehicle = started(*items)
    assert texts(vehicle.advance(20.0)) == ["Mission finished"]


def test_what_is_for_a_camera_is_passed_over():
    vehicle = started(item(206, 5.0), item(2000), item(195, east=1, north=1, frame=0), item(DELAY, 1.0))
    assert reached(vehicle.advance(20.0)) == [(3, 11.0)]


def test_an_item_that_does_not_go_on_stays_until_it_is_told():
    vehicle = started(item(DELAY, 1.0, autocontinue=0), item(WAYPOINT, east=10, north=0))
    assert reached(vehicle.advance(30.0)) == [(0, 11.0)]
    assert vehicle.set_current(30.0, 1).accepted
    assert reached(vehicle.advance(60.0)) == [(1, pytest.approx(30.0 + LEG_S, abs=0.01))]


# ---- from take-off to landing ----

WHOLE = (item(TAKEOFF, up=5.0), item(WAYPOINT, east=10, north=0), item(LAND, east=10, north=10))
LANDED_S = 1.0 + 4.25 / 1.5  # 5 m down at 1.5 m/s: two ramps of 0.5 s and 0.375 m


def test_arming_in_mission_mode_flies_it_from_take_off_to_landing():
    vehicle = load(on_the_ground(), *WHOLE)
    assert vehicle.set_mode(0.0, Mode.MISSION).accepted
    vehicle.advance(1.0)
    assert (vehicle.state(1.0).landed_state, vehicle.state(1.0).mission.state) == (GROUND, NOT_STARTED)
    assert vehicle.arm(1.0).accepted
    assert vehicle.state(2.0).landed_state == TAKING_OFF
    times = [1.0 + CLIMB_S, 1.0 + CLIMB_S + LEG_S, 1.0 + CLIMB_S + 2 * LEG_S + LANDED_S]
    events = vehicle.advance(times[2] - 0.5)
    assert vehicle.state(times[2] - 0.5).landed_state == LANDING
    events += vehicle.advance(60.0)
    assert reached(events) == [(seq, pytest.approx(t_s, abs=0.02)) for seq, t_s in enumerate(times)]
    assert at(vehicle, 60.0) == (10.0, 10.0, 0.0)
    assert not vehicle.state(60.0).armed
    assert vehicle.state(60.0).mission.state == COMPLETE


def test_a_take_off_with_a_position_climbs_first():
    vehicle = load(on_the_ground(), item(TAKEOFF, east=10, north=0, up=5.0))
    vehicle.arm(0.0)
    vehicle.set_mode(0.0, Mode.MISSION)
    vehicle.advance(CLIMB_S)
    assert at(vehicle, CLIMB_S) == (0.0, 0.0, 5.0)
    assert reached(vehicle.advance(60.0)) == [(0, pytest.approx(CLIMB_S + LEG_S, abs=0.01))]


def test_a_mission_that_begins_with_a_waypoint_climbs_straight_up_first():
    vehicle = load(on_the_ground(), item(WAYPOINT, east=10, north=0, up=2.0))
    vehicle.arm(0.0)
    vehicle.set_mode(0.0, Mode.MISSION)
    vehicle.advance(CLIMB_S)
    assert at(vehicle, CLIMB_S) == (0.0, 0.0, 5.0)  # the take-off altitude
    vehicle.advance(60.0)
    assert at(vehicle, 60.0) == (10.0, 0.0, 2.0)


def test_a_return_in_a_mission_is_the_return_mode():
    vehicle = started(item(WAYPOINT, east=10, north=0), item(RETURN))
    vehicle.advance(10.0 + LEG_S + 0.1)
    assert vehicle.state(10.0 + LEG_S + 0.1).mode is Mode.RETURN
    assert vehicle.state(10.0 + LEG_S + 0.1).mission.state == COMPLETE
    vehicle.advance(60.0)
    assert (vehicle.state(60.0).position, vehicle.state(60.0).armed) == ((0.0, 0.0, 0.0), False)


# ---- pause, resume, change ----


def test_a_pause_holds_and_a_resume_goes_on_with_the_current_item():
    vehicle = started(item(WAYPOINT, east=10, north=0), item(WAYPOINT, east=10, north=10))
    vehicle.advance(15.0)
    assert vehicle.state(15.0).mission[:5] == (1, 2, ACTIVE, True, 99)
    assert vehicle.set_mode(15.0, Mode.HOLD).accepted
    assert reached(vehicle.advance(40.0)) == []
    assert vehicle.state(40.0).mission[:5] == (1, 2, PAUSED, False, 99)
    assert vehicle.set_mode(40.0, Mode.MISSION).accepted
    assert [seq for seq, _ in reached(vehicle.advance(60.0))] == [1]
    assert at(vehicle, 60.0) == (10.0, 10.0, 5.0)


def test_a_finished_mission_begins_again():
    vehicle = started(item(DELAY, 1.0), item(DELAY, 1.0))
    vehicle.advance(20.0)
    assert vehicle.set_mode(20.0, Mode.MISSION).accepted
    assert reached(vehicle.advance(30.0)) == [(0, 21.0), (1, 22.0)]


def test_another_current_item_is_flown_at_once():
    vehicle = started(item(WAYPOINT, east=10, north=0), item(WAYPOINT, east=0, north=10))
    assert vehicle.set_current(10.5, 1).accepted
    assert [seq for seq, _ in reached(vehicle.advance(60.0))] == [1]


def test_a_mission_that_is_replaced_or_cleared_in_flight_is_not_flown_on():
    vehicle = started(item(WAYPOINT, east=10, north=0))
    load(vehicle, item(WAYPOINT, east=0, north=10), t_s=11.0)
    vehicle.advance(40.0)
    assert at(vehicle, 40.0) == (0.0, 10.0, 5.0)
    load(vehicle, item(LOITER, east=10, north=0), t_s=40.0)
    vehicle.set_mode(40.0, Mode.MISSION)
    load(vehicle, t_s=41.0)
    assert texts(vehicle.advance(42.0)) == ["Mission cleared: holding"]
    assert vehicle.state(42.0).mode is Mode.HOLD


def test_an_empty_battery_ends_a_mission_by_landing():
    vehicle = load(Vehicle(VehicleConfig(endurance_s=20.0)), item(TAKEOFF), item(LOITER, east=10, north=0))
    vehicle.set_mode(0.0, Mode.MISSION)
    vehicle.arm(0.0)
    vehicle.advance(60.0)
    assert (vehicle.state(60.0).landed_state, vehicle.state(60.0).armed) == (GROUND, False)


def test_that_an_item_is_done_is_told_for_a_second():
    vehicle = load(on_the_ground(), item(TAKEOFF), item(LOITER, east=10, north=0))
    vehicle.set_mode(0.0, Mode.MISSION)
    vehicle.arm(0.0)
    ((_, done_s),) = reached(vehicle.advance(60.0))
    telemetry = Telemetry(
        lambda t_s: Snapshot(vehicle.config, vehicle.state(60.0)._replace(time_s=t_s), (0.0, 0.0), None)
    )
    told = [
        telemetry.build(mavlink.MAVLINK_MSG_ID_MISSION_ITEM_REACHED, done_s + after_s)
        for after_s in (0.0, 0.5, 1.0, 1.1)
    ]
    assert [message and message.seq for message in told] == [0, 0, 0, None]


# ---- determinism ----


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0.001, 5.0), max_size=60))
def test_a_mission_with_a_fence_does_not_depend_on_the_time_steps(steps):
    def flight():
        vehicle = Vehicle(VehicleConfig(fence=Fence((Circle(False, (5.0, 10.0), 2.0),)), fence_action=1))
        load(
            vehicle,
            item(TAKEOFF),
            item(SPEED, 1.0, 3.0),
            item(WAYPOINT, 1.0, 0.0, 0.0, 90.0, east=10, north=0),
            item(WAYPOINT, east=10, north=10),
            item(JUMP, 2.0, 1.0),
            item(RETURN),
        )
        vehicle.set_mode(0.0, Mode.MISSION)
        vehicle.arm(0.0)
        return vehicle

    stepped, jumped = flight(), flight()
    events, now = [], 0.0
    for each in steps:
        now += each
        events += stepped.advance(now)
    assert events == jumped.advance(now)
    assert stepped.state(now) == jumped.state(now)
