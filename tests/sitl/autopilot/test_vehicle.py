"""Protects the autopilot: refusals and their reasons, flight and its timing, and that neither depends on
the time steps.
"""

import dataclasses
import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aircraft.state import Arrived, Said
from link.modes import Mode
from plume.problem import Problem
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import GRAVITY_MPS2
from sitl.autopilot.setpoint import Setpoint
from sitl.autopilot.vehicle import Vehicle
from tests.ground.tlog.flights import (
    ACCEPTED,
    CLIMB_S,
    DENIED,
    GROUND,
    IN_AIR,
    LANDING,
    NAN,
    REJECTED,
    TAKING_OFF,
    fly_on,
    hovering,
    offboard,
    on_the_ground,
    places,
    texts,
)

EMERGENCY, CRITICAL, WARNING = 0, 2, 4  # MAV_SEVERITY

# ---- refusals ----


def test_takeoff_is_refused_in_the_air():
    assert hovering().take_off(10.0)[:2] == (REJECTED, "Take-off refused: already in the air")


@pytest.mark.parametrize("altitude", [121.0, 0.0, -88.0, math.inf, NAN])
def test_takeoff_is_refused_to_below_the_ground_or_above_the_ceiling(altitude):
    vehicle = on_the_ground()
    vehicle.arm(0.0)
    code, reason, _ = vehicle.take_off(0.0, altitude)
    assert code == DENIED
    assert "up to 120 m" in reason


def test_disarm_is_refused_in_the_air():
    vehicle = hovering()
    assert vehicle.disarm(10.0)[:2] == (REJECTED, "Disarm refused: in the air")
    assert vehicle.state(10.0).armed


@pytest.mark.parametrize(
    ("mode", "reason"),
    [(Mode.RETURN, "Return refused: on the ground"), (Mode.LAND, "Land refused: on the ground")],
)
def test_land_and_return_are_refused_on_the_ground(mode, reason):
    assert on_the_ground().set_mode(1.0, mode)[:2] == (REJECTED, reason)


def test_offboard_is_refused_without_a_setpoint():
    assert hovering().set_mode(10.0, Mode.OFFBOARD)[:2] == (
        REJECTED,
        "Offboard refused: no setpoint received yet",
    )


def test_offboard_is_refused_when_the_setpoint_is_stale():
    vehicle = hovering()
    vehicle.setpoint(10.0, (1.0, 1.0, -5.0))
    assert vehicle.set_mode(41.0, Mode.OFFBOARD)[:2] == (
        REJECTED,
        "Offboard refused: no setpoint in the last 30 s",
    )


def test_go_to_is_refused_disarmed_on_the_ground_and_outside_the_fence():
    vehicle = on_the_ground()
    assert vehicle.go_to(1.0, (10.0, 31.0, -5.0))[:2] == (REJECTED, "Go-to refused: disarmed")
    vehicle.arm(1.0)
    assert vehicle.go_to(1.0, (10.0, 31.0, -5.0))[:2] == (REJECTED, "Go-to refused: on the ground")
    vehicle = hovering()
    refused = vehicle.go_to(10.0, (10.0, 31.0, -5.0))
    assert refused[:2] == (DENIED, "Go-to refused: (31.0, 10.0) m is outside the area [0, 30] x [0, 30] m")
    assert not vehicle.moving


REFUSED_WAYPOINTS = {
    "outside the area": (
        (4.0, 31.0, -5.0),
        "Waypoint refused: (31.0, 4.0) m is outside the area [0, 30] x [0, 30] m",
    ),
    "outside the altitudes": ((4.0, 4.0, -121.0), "Waypoint refused: altitude 121.0 m is outside [0, 120] m"),
    "not finite": ((NAN, 4.0, -5.0), "Waypoint refused: (4.0, nan) m at 5.0 m is not finite"),
}


@pytest.mark.parametrize("kind", REFUSED_WAYPOINTS)
def test_a_waypoint_that_makes_no_sense_is_refused_with_its_reason_and_changes_nothing(kind):
    target, reason = REFUSED_WAYPOINTS[kind]
    vehicle = offboard()
    before, expiry = vehicle.state(10.0), vehicle.next_event_s()
    assert vehicle.setpoint(10.0, target) == (DENIED, reason, kind)
    assert vehicle.state(10.0) == before
    assert vehicle.next_event_s() == expiry  # a refused setpoint does not reset the timeout either


@pytest.mark.parametrize(
    "target", [(-1e-6, 0.0, -5.0), (30.000002, 0.0, -5.0), (0.0, 0.0, 1e-6), (0.0, 0.0, -math.inf)]
)
def test_the_fence_is_exact(target):
    code, reason, _ = offboard().setpoint(10.0, target)
    assert code == DENIED
    assert reason.startswith("Waypoint refused: ")


def test_a_waypoint_with_a_yaw_that_is_no_number_is_refused():
    refused = offboard().setpoint(10.0, Setpoint((1.0, 1.0, -5.0), yaw_rad=NAN))
    assert refused == (DENIED, "Waypoint refused: yaw nan is not finite", "not finite")


def test_time_does_not_run_backwards():
    vehicle = hovering()
    with pytest.raises(ValueError, match="backwards"):
        vehicle.advance(1.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"sysid": 0},
        {"speed_mps": NAN},
        {"takeoff_altitude_m": 121.0},
        {"home_lat_deg": 91.0},
    ],
)
def test_a_configuration_that_cannot_fly_is_refused_by_field_and_value(wrong):
    ((field, value),) = wrong.items()
    with pytest.raises(ValueError, match=f"{field} is {value}.*allowed"):
        VehicleConfig(**wrong)


# ---- flight ----


def test_it_takes_off_when_armed_and_then_holds():
    vehicle = on_the_ground()
    assert vehicle.arm(1.0).code == ACCEPTED
    assert vehicle.take_off(1.0).code == ACCEPTED
    assert (vehicle.state(2.0).mode, vehicle.state(2.0).landed_state) == (Mode.TAKEOFF, TAKING_OFF)
    assert vehicle.next_event_s() == pytest.approx(1.0 + CLIMB_S)
    vehicle.advance(10.0)
    state = vehicle.state(10.0)
    assert (state.mode, state.landed_state, state.position, state.velocity) == (
        Mode.HOLD,
        IN_AIR,
        (0.0, 0.0, -5.0),
        (0.0, 0.0, 0.0),
    )


def test_a_command_repeated_because_its_answer_was_lost_is_accepted_again():
    vehicle = on_the_ground()
    for command, times in ((vehicle.arm, (1.0, 1.5)), (vehicle.take_off, (2.0, 2.5))):
        assert [command(t).code for t in times] == [ACCEPTED, ACCEPTED]
    assert vehicle.next_event_s() == pytest.approx(2.0 + CLIMB_S)


def test_a_take_off_before_arming_waits_and_flies_when_it_is_armed():
    vehicle = on_the_ground()
    assert vehicle.take_off(1.0, 8.0).accepted
    assert (vehicle.state(1.0).mode, vehicle.state(1.0).armed, vehicle.moving) == (Mode.TAKEOFF, False, False)
    assert vehicle.arm(5.0).accepted
    assert vehicle.state(6.0).landed_state == TAKING_OFF
    vehicle.advance(20.0)
    assert (vehicle.state(20.0).mode, vehicle.state(20.0).position) == (Mode.HOLD, (0.0, 0.0, -8.0))


def test_a_take_off_that_is_not_armed_for_10_s_is_given_up():
    vehicle = on_the_ground()
    assert vehicle.set_mode(1.0, Mode.TAKEOFF).accepted
    assert vehicle.take_off(4.0).accepted  # again: the wait begins anew
    assert vehicle.next_event_s() == 14.0
    assert vehicle.advance(20.0) == [Said(14.0, 6, "Take-off given up: not armed for 10 s")]
    assert vehicle.state(20.0).mode is Mode.HOLD
    vehicle.arm(20.0)
    assert texts(vehicle.advance(40.0)) == ["Disarmed: no take-off for 10 s"]


def test_a_take_off_before_arming_can_be_taken_back_or_changed():
    vehicle = on_the_ground()
    vehicle.take_off(1.0)
    assert vehicle.set_mode(2.0, Mode.HOLD).accepted
    assert vehicle.advance(50.0) == []
    vehicle.take_off(50.0, 3.0)
    vehicle.take_off(51.0, 6.0)
    assert vehicle.take_off(52.0, 121.0).code == DENIED
    vehicle.arm(53.0)
    vehicle.advance(70.0)
    assert vehicle.state(70.0).position == (0.0, 0.0, -6.0)


def test_an_empty_or_falling_vehicle_does_not_take_off():
    vehicle = hovering()
    vehicle.disarm(10.0, force=True)
    assert vehicle.take_off(10.1)[:2] == (REJECTED, "Take-off refused: falling")
    vehicle = on_the_ground(VehicleConfig(endurance_s=5.0))
    vehicle.arm(0.0)
    vehicle.advance(6.0)
    assert vehicle.take_off(7.0)[:2] == (REJECTED, "Take-off refused: battery empty")


def test_landing_ends_on_the_ground_disarmed():
    vehicle = hovering()
    assert vehicle.set_mode(10.0, Mode.LAND).code == ACCEPTED
    assert vehicle.state(11.0).landed_state == LANDING
    # 5 m down at 1.5 m/s: two ramps of 0.5 s and 0.375 m, and 4.25 m of cruise.
    touchdown = 10.0 + 1.0 + 4.25 / 1.5
    assert vehicle.next_event_s() == pytest.approx(touchdown)
    vehicle.advance(touchdown - 0.01)
    assert vehicle.state(touchdown - 0.01).landed_state == LANDING
    for after_s, armed in ((0.01, True), (1.99, True), (2.01, False)):  # PX4's COM_DISARM_LAND is 2 s
        vehicle.advance(touchdown + after_s)
        state = vehicle.state(touchdown + after_s)
        assert (state.armed, state.landed_state, state.position) == (armed, GROUND, (0.0, 0.0, 0.0))
    assert not vehicle.busy


def test_a_landed_vehicle_may_take_off_again_before_its_motors_stop():
    vehicle = hovering()
    vehicle.set_mode(10.0, Mode.LAND)
    assert vehicle.take_off(15.0, 3.0).accepted  # it touched down at 13.83 s
    vehicle.advance(60.0)
    assert (vehicle.state(60.0).armed, vehicle.state(60.0).position) == (True, (0.0, 0.0, -3.0))


def test_a_vehicle_that_is_armed_and_does_not_take_off_disarms_after_10_s():
    vehicle = on_the_ground()
    vehicle.arm(5.0)
    assert vehicle.advance(14.99) == []
    assert vehicle.advance(20.0) == [Said(15.0, 6, "Disarmed: no take-off for 10 s")]
    assert not vehicle.state(20.0).armed
    vehicle.arm(30.0)
    assert vehicle.take_off(39.0).accepted
    assert vehicle.advance(100.0) == []
    assert vehicle.state(100.0).armed


def test_a_vehicle_that_landed_and_is_armed_again_waits_for_its_take_off_anew():
    vehicle = hovering()
    vehicle.set_mode(10.0, Mode.LAND)
    vehicle.advance(30.0)
    vehicle.arm(30.0)
    vehicle.advance(39.9)
    assert vehicle.state(39.9).armed
    assert texts(vehicle.advance(40.1)) == ["Disarmed: no take-off for 10 s"]


def test_a_vehicle_may_be_told_never_to_disarm_itself():
    vehicle = on_the_ground(VehicleConfig(disarm_landed_s=math.inf, disarm_preflight_s=math.inf))
    vehicle.arm(0.0)
    vehicle.advance(100.0)
    vehicle.take_off(100.0)
    vehicle.set_mode(110.0, Mode.LAND)
    vehicle.advance(500.0)
    assert (vehicle.state(500.0).armed, vehicle.state(500.0).landed_state) == (True, GROUND)


def test_a_new_configuration_changes_the_coming_legs_only():
    changed, unchanged = hovering(), hovering()
    for vehicle in (changed, unchanged):
        vehicle.go_to(10.0, (0.0, 20.0, -5.0))  # 5 m/s at 3 m/s²: 20 m take 5/3 s + 4 s
    changed.configure(12.0, dataclasses.replace(changed.config, speed_mps=1.0))
    assert changed.state(12.5) == unchanged.state(12.5)
    assert changed.next_event_s() == pytest.approx(10.0 + 5.0 / 3.0 + 4.0)
    changed.go_to(20.0, (0.0, 10.0, -5.0))  # 1 m/s: 10 m take 1/3 s + 10 s
    assert changed.next_event_s() == pytest.approx(20.0 + 1.0 / 3.0 + 10.0)


def test_a_shorter_silence_acts_at_once_in_flight_and_is_told_to_a_tenth_of_a_second():
    vehicle = offboard()
    vehicle.configure(vehicle.now_s + 8.0, dataclasses.replace(vehicle.config, silence_s=5.1519))
    now_s = vehicle.now_s
    assert vehicle.advance(now_s + 0.1) == [Said(now_s, CRITICAL, "No setpoint for 5.2 s: returning home")]


def test_return_flies_home_lands_and_disarms():
    vehicle = hovering()
    vehicle.go_to(10.0, (20.0, 10.0, -2.0))
    vehicle.advance(30.0)
    assert vehicle.set_mode(30.0, Mode.RETURN).code == ACCEPTED
    lowest_on_the_way = 0.0
    for n in range(1, 400):
        t = 30.0 + n / 10.0
        vehicle.advance(t)
        state = vehicle.state(t)
        if math.hypot(*state.position[:2]) > 0.1 and math.hypot(*state.position[:2]) < 22.0:
            lowest_on_the_way = max(lowest_on_the_way, state.position[2] + 5.0)
    assert lowest_on_the_way == pytest.approx(0.0, abs=1e-9)  # it climbed to 5 m before it left
    assert (state.position, state.armed, state.landed_state) == ((0.0, 0.0, 0.0), False, GROUND)


def test_a_forced_disarm_in_the_air_lets_it_fall():
    vehicle = hovering()
    assert vehicle.disarm(10.0, force=True).code == ACCEPTED
    impact = 10.0 + math.sqrt(10.0 / GRAVITY_MPS2)
    assert vehicle.next_event_s() == pytest.approx(10.0)  # the text about the stopped motors is due
    assert vehicle.advance(10.0) == [Said(10.0, EMERGENCY, "Motors stopped in the air")]
    assert vehicle.next_event_s() == pytest.approx(impact)
    assert not vehicle.state(10.5).armed
    assert vehicle.state(10.5).landed_state == IN_AIR
    assert vehicle.arm(10.5).reason == "Arming refused: falling"
    assert vehicle.set_mode(10.5, Mode.LAND).reason == "Land refused: falling"
    vehicle.advance(12.0)
    assert (vehicle.state(12.0).position, vehicle.state(12.0).landed_state) == ((0.0, 0.0, 0.0), GROUND)
    assert vehicle.arm(12.0).accepted


def test_hold_brakes_and_stays():
    vehicle = offboard()
    vehicle.setpoint(10.0, (20.0, 0.0, -5.0))
    assert vehicle.set_mode(13.0, Mode.HOLD).code == ACCEPTED
    assert vehicle.advance(60.0) == []  # neither an arrival nor a setpoint timeout: OFFBOARD has ended
    ramp_s, ramp_m = 5.0 / 3.0, 25.0 / 6.0
    stop = ramp_m + (3.0 - ramp_s) * 5.0 + ramp_m
    assert vehicle.state(60.0).position == pytest.approx((stop, 0.0, -5.0))


def test_go_to_flies_there_and_holds_without_a_reading():
    vehicle = hovering()
    assert vehicle.go_to(10.0, (10.0, 20.0, -8.0), yaw_rad=1.0).code == ACCEPTED
    assert vehicle.advance(100.0) == []
    state = vehicle.state(100.0)
    assert (state.position, state.mode, state.yaw) == ((10.0, 20.0, -8.0), Mode.HOLD, 1.0)


def test_the_numbers_of_the_modes_are_px4s():
    assert {mode.name: mode.custom_mode for mode in Mode} == {
        "TAKEOFF": 0x02040000,
        "HOLD": 0x03040000,
        "MISSION": 0x04040000,
        "RETURN": 0x05040000,
        "LAND": 0x06040000,
        "OFFBOARD": 0x00060000,
    }


# ---- waypoints ----


def test_a_waypoint_is_remembered_and_flown_once_in_offboard():
    vehicle = hovering()
    assert vehicle.setpoint(10.0, (3.0, 4.0, -5.0)).code == ACCEPTED
    assert not vehicle.moving
    assert vehicle.set_mode(11.0, Mode.OFFBOARD).code == ACCEPTED
    # 5 m: two ramps of 5/3 s would need 25/3 m, so it is a triangle: 2 sqrt(5/3) s.
    (arrived,) = fly_on(vehicle)
    assert arrived.time_s == pytest.approx(11.0 + 2.0 * math.sqrt(5.0 / 3.0))
    assert arrived.position == (3.0, 4.0, -5.0)


def test_a_client_may_set_offboard_first_and_then_arm():
    vehicle = on_the_ground()
    vehicle.setpoint(1.0, (3.0, 4.0, -5.0))
    assert vehicle.set_mode(1.0, Mode.OFFBOARD).code == ACCEPTED
    assert not vehicle.moving
    assert vehicle.arm(2.0).code == ACCEPTED
    assert places(fly_on(vehicle)) == [(3.0, 4.0, -5.0)]


def test_arming_in_offboard_is_refused_once_the_client_is_gone():
    vehicle = on_the_ground()
    vehicle.setpoint(1.0, (3.0, 4.0, -5.0))
    vehicle.set_mode(1.0, Mode.OFFBOARD)
    assert vehicle.arm(40.0).reason == "Arming refused: no setpoint in the last 30 s"


@given(st.tuples(*[st.floats(0.0, 30.0)] * 2, st.floats(-120.0, 0.0)))
def test_the_position_on_arrival_is_the_waypoints_float32_bit_for_bit(target):
    vehicle = offboard()
    vehicle.setpoint(10.0, target, answers=True)
    (arrived,) = fly_on(vehicle)
    assert struct.pack("<3f", *arrived.position) == struct.pack("<3f", *target)
    assert vehicle.state(vehicle.now_s).position == arrived.position


def test_a_keep_alive_starts_no_new_leg():
    vehicle = offboard()
    vehicle.setpoint(10.0, (3.0, 4.0, -5.0))
    due = vehicle.next_event_s()
    for n in range(1, 100):
        events = vehicle.advance(10.0 + n / 20.0)
        assert len(places(events)) == (1 if 10.0 + (n - 1) / 20.0 < due <= 10.0 + n / 20.0 else 0)
        vehicle.setpoint(10.0 + n / 20.0, (3.0, 4.0, -5.0))
    assert not vehicle.moving


def test_a_new_yaw_turns_without_a_new_leg():
    vehicle = offboard()
    vehicle.setpoint(10.0, Setpoint((0.0, 0.0, -5.0), yaw_rad=math.pi / 2))
    assert not vehicle.moving
    assert vehicle.state(11.0).yaw == pytest.approx(math.radians(45.0))
    assert vehicle.state(13.0).yaw == pytest.approx(math.pi / 2)


def test_a_waypoint_on_the_way_replaces_the_one_flown_to():
    vehicle = offboard()
    vehicle.setpoint(10.0, (20.0, 0.0, -5.0))
    vehicle.setpoint(12.0, (0.0, 20.0, -5.0))
    assert places(fly_on(vehicle)) == [(0.0, 20.0, -5.0)]


# ---- readings and their answers ----


def test_an_answer_to_stay_arrives_at_once():
    vehicle = offboard()
    vehicle.setpoint(10.0, (0.0, 0.0, -5.0), answers=True)
    assert vehicle.next_event_s() == 10.0
    assert vehicle.advance(10.0) == [Arrived(10.0, (0.0, 0.0, -5.0))]


def test_an_answer_before_offboard_is_remembered():
    vehicle = hovering()
    vehicle.setpoint(10.0, (1.0, 0.0, -5.0), answers=True)
    vehicle.set_mode(10.0, Mode.OFFBOARD)
    assert places(fly_on(vehicle)) == [(1.0, 0.0, -5.0)]


# ---- failsafes ----


def test_silence_brings_it_home():
    vehicle = offboard()
    vehicle.setpoint(10.0, (10.0, 10.0, -5.0))
    arrived = fly_on(vehicle)[0].time_s
    assert vehicle.next_event_s() == arrived + 30.0  # silence counts from the end of the leg
    vehicle.advance(arrived + 29.9)
    assert vehicle.state(arrived + 29.9).mode is Mode.OFFBOARD
    assert vehicle.advance(arrived + 30.1) == [
        Said(arrived + 30.0, CRITICAL, "No setpoint for 30 s: returning home")
    ]
    assert (vehicle.state(arrived + 30.1).mode, vehicle.state(arrived + 30.1).failsafe) == (Mode.RETURN, True)
    vehicle.advance(200.0)
    state = vehicle.state(200.0)
    assert (state.position, state.armed, state.failsafe) == ((0.0, 0.0, 0.0), False, False)


def test_a_keep_alive_puts_silence_off():
    vehicle = offboard()
    for t in range(10, 200, 10):
        vehicle.setpoint(float(t), (0.0, 0.0, -5.0))
    assert vehicle.advance(219.0) == []
    assert texts(vehicle.advance(221.0)) == ["No setpoint for 30 s: returning home"]


def test_silence_in_hold_is_no_alarm():
    vehicle = hovering()
    assert vehicle.advance(1000.0) == []


def test_a_client_that_comes_back_may_take_over_again():
    vehicle = offboard()
    vehicle.advance(40.0)
    vehicle.setpoint(40.0, (2.0, 2.0, -5.0))
    assert vehicle.state(40.0).mode is not Mode.OFFBOARD  # a setpoint alone does not switch to OFFBOARD
    assert vehicle.set_mode(40.0, Mode.OFFBOARD).accepted
    assert not vehicle.state(40.0).failsafe


def test_the_battery_drains_with_the_motors_on_warns_and_then_lands():
    vehicle = Vehicle(VehicleConfig(endurance_s=100.0, silence_s=math.inf))
    vehicle.advance(50.0)
    assert vehicle.state(50.0).battery == 1.0
    vehicle.arm(50.0)
    vehicle.take_off(50.0)
    vehicle.advance(100.0)
    assert vehicle.state(100.0).battery == pytest.approx(0.5)
    assert vehicle.advance(149.0) == [Said(135.0, WARNING, "Battery low: 15% left")]
    assert texts(vehicle.advance(151.0)) == ["Battery empty: landing"]
    assert vehicle.set_mode(151.0, Mode.HOLD).reason == "Hold refused: battery empty"
    vehicle.advance(200.0)
    assert not vehicle.state(200.0).armed
    assert not vehicle.state(200.0).fit
    assert vehicle.arm(200.0)[:2] == (REJECTED, "Arming refused: battery empty")


def test_two_flights_use_up_one_battery():
    """Up 5 m at 1 m/s and 1 m/s²: 1 s + 4 s + 1 s, and the same down."""
    vehicle = Vehicle(
        VehicleConfig(endurance_s=100.0, silence_s=math.inf, climb_mps=1.0, descent_mps=1.0, accel_mps2=1.0)
    )
    vehicle.arm(10.0)
    vehicle.take_off(10.0)
    vehicle.arm(20.0)  # repeated, as after a lost acknowledgement: the motors have been on since 10 s
    vehicle.set_mode(24.0, Mode.LAND)
    vehicle.advance(29.9)
    assert vehicle.state(29.9).armed
    vehicle.advance(50.0)
    assert not vehicle.state(50.0).armed
    assert vehicle.state(50.0).battery == pytest.approx(
        0.78
    )  # on from 10 s to 30 s, and 2 s more on the ground
    vehicle.arm(50.0)
    vehicle.take_off(50.0)
    vehicle.advance(90.0)
    assert vehicle.state(90.0).battery == pytest.approx(0.38)  # 22 s + 40 s
    assert vehicle.advance(127.0) == [Said(113.0, WARNING, "Battery low: 15% left")]  # 22 s + 63 s
    assert vehicle.state(127.0).battery == pytest.approx(0.01)
    assert vehicle.advance(135.0) == [Said(128.0, CRITICAL, "Battery empty: landing")]  # 22 s + 78 s
    assert vehicle.state(135.0).battery == 0.0
    vehicle.advance(137.0)
    assert not vehicle.state(137.0).armed


def test_a_warning_that_was_given_in_one_flight_is_not_given_again_in_the_next():
    vehicle = Vehicle(VehicleConfig(endurance_s=100.0, disarm_preflight_s=math.inf))
    vehicle.arm(0.0)
    vehicle.disarm(40.0)
    vehicle.arm(60.0)
    assert vehicle.advance(110.0) == [Said(105.0, WARNING, "Battery low: 15% left")]  # 40 s + 45 s
    vehicle.disarm(110.0)
    assert vehicle.advance(200.0) == []
    assert vehicle.arm(200.0).accepted
    assert vehicle.state(205.0).battery == pytest.approx(0.05)  # 40 s + 50 s + 5 s
    assert vehicle.advance(220.0) == [Said(210.0, CRITICAL, "Battery empty: disarmed")]
    assert vehicle.arm(220.0).reason == "Arming refused: battery empty"


def test_a_battery_drains_no_more_once_the_motors_stop_in_the_air():
    vehicle = hovering(VehicleConfig(endurance_s=100.0))
    armed_s = 100.0 * (1.0 - vehicle.state(10.0).battery)
    vehicle.disarm(20.0, force=True)
    for t_s in (20.0, 20.5, 40.0):  # falling, and on the ground
        vehicle.advance(t_s)
        assert vehicle.state(t_s).battery == pytest.approx(1.0 - (armed_s + 10.0) / 100.0)


def test_a_battery_without_end_never_drains():
    vehicle = hovering(VehicleConfig(endurance_s=math.inf))
    assert vehicle.next_event_s() is None
    assert vehicle.state(10.0).battery == 1.0


# ---- any step ----


def _vector(place):
    """A velocity or an acceleration from a place: up to 7 along each axis."""
    return (place[0] - 14.5) / 4.0, (place[1] - 15.5) / 4.0, (place[2] + 6.0) / 4.0


ACTIONS = {
    "arm": lambda v, t, p: v.arm(t),
    "take off": lambda v, t, p: v.take_off(t),
    "waypoint": lambda v, t, p: v.setpoint(t, p),
    "velocity": lambda v, t, p: v.setpoint(t, Setpoint(velocity=_vector(p), yaw_rate_radps=p[0] / 30.0)),
    "acceleration": lambda v, t, p: v.setpoint(t, Setpoint(acceleration=_vector(p))),
    "height": lambda v, t, p: v.setpoint(t, Setpoint(velocity=_vector(p), down_m=p[2])),
    "offboard": lambda v, t, p: v.set_mode(t, Mode.OFFBOARD),
    "hold": lambda v, t, p: v.set_mode(t, Mode.HOLD),
    "go to": lambda v, t, p: v.go_to(t, p, yaw_rad=p[0] / 10.0),
    "return": lambda v, t, p: v.set_mode(t, Mode.RETURN),
    "land": lambda v, t, p: v.set_mode(t, Mode.LAND),
    "disarm": lambda v, t, p: v.disarm(t),
    "drop": lambda v, t, p: v.disarm(t, force=True),
}
START = [(0.0, "arm", (0.0, 0.0, 0.0)), (0.0, "take off", (0.0, 0.0, 0.0))]
targets = st.tuples(
    st.floats(-1.0, 30.0, width=32), st.floats(0.0, 31.0, width=32), st.floats(-12.0, 0.0, width=32)
)
scripts = st.lists(st.tuples(st.floats(0.0, 8.0), st.sampled_from(sorted(ACTIONS)), targets), max_size=12)
MOVES = ["waypoint", "offboard", "velocity", "acceleration", "height", "hold"]
flights = st.lists(
    st.tuples(st.floats(0.0, 8.0), st.sampled_from(MOVES), targets),
    max_size=12,
)


def play(script, steps):
    """All states and events of a script; `steps` are the time steps between its actions (none: one jump)."""
    vehicle = Vehicle(VehicleConfig(silence_s=6.0, endurance_s=50.0))
    events, results, states = [], [], []

    def advance(until_s):
        for n in range(10_000 if steps else 0):
            if (t := vehicle.now_s + steps[n % len(steps)]) >= until_s:
                break
            events.extend(vehicle.advance(t))
        events.extend(vehicle.advance(until_s))

    now = 0.0
    for gap, action, target in script:
        now += gap
        advance(now)
        results.append(ACTIONS[action](vehicle, now, target))
        states.append(vehicle.state(now))
    advance(now + 80.0)
    return events, results, [*states, vehicle.state(now + 80.0)]


@settings(max_examples=150, deadline=None)
@given(
    scripts | flights.map(lambda script: START + script),
    st.lists(st.floats(0.05, 9.0), min_size=1, max_size=5),
)
def test_one_jump_and_many_steps_give_the_same_bits_and_events(script, steps):
    assert repr(play(script, [])) == repr(play(script, steps))


def test_a_flight_in_steps_of_a_millisecond_gives_the_same_bits_and_events():
    script = [
        *START,
        (4.0, "waypoint", (9.0, 7.0, -6.0)),
        (0.0, "offboard", (0.0, 0.0, 0.0)),
        (1.3, "waypoint", (2.0, 20.0, -5.0)),
    ]
    events, *rest = play(script, [])
    assert [type(event) for event in events] == [Arrived, Said]  # arrival; then the setpoint timeout
    assert repr((events, *rest)) == repr(play(script, [0.001] * 10))


@settings(max_examples=150, deadline=None)
@given(scripts | flights.map(lambda script: START + script))
def test_left_alone_it_comes_to_rest_and_never_below_the_ground(script):
    _, _, states = play(script, [])
    assert all(state.position[2] <= 0.0 for state in states)
    assert not states[-1].armed  # the battery has run out by then
    assert states[-1].velocity == (0.0, 0.0, 0.0)


def test_a_way_through_a_building_is_refused_and_one_beside_it_is_flown():
    """The vehicle hovers above home."""
    house = ((4.0, 0.0), (6.0, 0.0), (6.0, 3.0), (4.0, 3.0))
    ground = Problem(keep_out=(house,), clearance_m=1.0).ground
    vehicle = offboard(VehicleConfig(area=ground))
    refused = vehicle.setpoint(10.0, (1.0, 10.0, -5.0))
    assert refused[0] == DENIED
    assert refused[1].endswith("crosses a polygon of keep_out")
    assert refused[2] == "keep-out"
    assert vehicle.go_to(10.0, (1.0, 10.0, -5.0)).reason.startswith("Go-to refused: the way to")
    assert vehicle.setpoint(10.0, (8.0, 10.0, -5.0)).accepted
