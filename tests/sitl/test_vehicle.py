"""Protects the autopilot: what it refuses and why, what it does and when, and that neither depends on how time is cut into steps."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from sitl.geodesy import to_global
from sitl.motion import GRAVITY_MPS2
from sitl.telemetry import Snapshot, Telemetry
from sitl.vehicle import Arrived, Mode, Said, Vehicle, VehicleConfig

ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3  # MAV_RESULT
GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE
CLIENT = (245, 190)
NAN = math.nan
CONFIG = VehicleConfig()
CLIMB_S = 5.0 / 3.0 + 1.0  # the take-off to 5 m: 3 m/s at 3 m/s², so two ramps of 1 s and 1.5 m, and 2 m of cruise


def wire(message):
    """The message as a client on the other side of a wire sends it: every float a float32."""
    packed = message.pack(mavlink.MAVLink(None, srcSystem=CLIENT[0], srcComponent=CLIENT[1]))
    return mavlink.MAVLink(None).decode(bytearray(packed))


def command(number, p1=0.0, p2=0.0, p3=0.0, p4=0.0, p5=0.0, p6=0.0, p7=0.0, system=1, component=1):
    return wire(mavlink.MAVLink_command_long_message(system, component, number, 0, p1, p2, p3, p4, p5, p6, p7))


def command_int(number, frame, x, y, z, p4=NAN):
    return wire(mavlink.MAVLink_command_int_message(1, 1, frame, number, 0, 0, -1.0, 1.0, 0.0, p4, x, y, z))


def waypoint(north, east, down=-5.0, time_boot_ms=1, yaw=None, frame=1, mask=0b110111111000, system=1):
    mask &= 0xFFF if yaw is None else ~1024
    return wire(
        mavlink.MAVLink_set_position_target_local_ned_message(
            time_boot_ms, system, 1, frame, mask, north, east, down, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, yaw or 0.0, 9.0
        )
    )


def ack(answers):
    (only,) = (m for m in answers if m.get_type() == "COMMAND_ACK")
    return only.result


def text(answers):
    return "".join(m.text for m in answers if m.get_type() == "STATUSTEXT")


def places(events):
    return [event.position for event in events if isinstance(event, Arrived)]


def texts(events):
    return [event.text for event in events if isinstance(event, Said)]


def on_the_ground(config=CONFIG):
    return Vehicle(config)


def hovering(config=CONFIG):
    """A vehicle that holds 5 m over home."""
    vehicle = Vehicle(config)
    assert vehicle.arm(0.0).accepted
    assert vehicle.take_off(0.0).accepted
    vehicle.advance(CLIMB_S + 0.01)
    assert vehicle.state(vehicle.now_s).mode is Mode.HOLD
    return vehicle


def offboard(config=CONFIG):
    """A vehicle in OFFBOARD at rest 5 m over home, the arrival there already told."""
    vehicle = hovering(config)
    t = vehicle.now_s
    vehicle.setpoint(t, (0.0, 0.0, -5.0))
    assert vehicle.set_mode(t, Mode.OFFBOARD).accepted
    assert places(vehicle.advance(t)) == [(0.0, 0.0, -5.0)]
    return vehicle


def fly_on(vehicle, until_s=math.inf):
    """Jump from event to event, as an event-driven loop does."""
    events = []
    while vehicle.moving and (at := vehicle.next_event_s()) is not None and at <= until_s:
        events += vehicle.advance(at)
    return events


# ---- refusals ----


def test_takeoff_is_refused_while_disarmed():
    vehicle = on_the_ground()
    answers = vehicle.receive(command(22, NAN, NAN, NAN, NAN, NAN, NAN, NAN), 1.0)
    assert ack(answers) == REJECTED
    assert text(answers) == "Take-off refused: disarmed"
    assert (answers[0].target_system, answers[0].target_component) == CLIENT
    assert not vehicle.moving


def test_takeoff_is_refused_in_the_air():
    vehicle = hovering()
    answers = vehicle.receive(command(22, p7=NAN), 10.0)
    assert ack(answers) == REJECTED
    assert text(answers) == "Take-off refused: already in the air"


@pytest.mark.parametrize("altitude", [488.0 + 121.0, 488.0, 400.0])
def test_takeoff_is_refused_to_below_the_ground_or_above_the_ceiling(altitude):
    vehicle = on_the_ground()
    vehicle.arm(0.0)
    answers = vehicle.receive(command(22, p7=altitude), 0.0)
    assert ack(answers) == DENIED
    assert "up to 120 m" in text(answers)


def test_disarm_is_refused_in_the_air():
    vehicle = hovering()
    answers = vehicle.receive(command(400, 0.0), 10.0)
    assert ack(answers) == REJECTED
    assert text(answers) == "Disarm refused: in the air"
    assert vehicle.state(10.0).armed


@pytest.mark.parametrize(("number", "reason"), [(20, "Return refused: on the ground"), (21, "Land refused: on the ground")])
def test_land_and_return_are_refused_on_the_ground(number, reason):
    answers = on_the_ground().receive(command(number), 1.0)
    assert (ack(answers), text(answers)) == (REJECTED, reason)


def test_offboard_is_refused_without_a_setpoint():
    answers = hovering().receive(command(176, 1.0, 6.0), 10.0)
    assert (ack(answers), text(answers)) == (REJECTED, "Offboard refused: no setpoint received yet")


def test_offboard_is_refused_when_the_setpoint_is_stale():
    vehicle = hovering()
    vehicle.receive(waypoint(1.0, 1.0), 10.0)
    answers = vehicle.receive(command(176, 1.0, 6.0), 41.0)
    assert (ack(answers), text(answers)) == (REJECTED, "Offboard refused: no setpoint in the last 30 s")


@pytest.mark.parametrize("params", [(1.0, 3.0), (1.0, 1.0), (1.0, 4.0, 4.0), (0.0, 6.0), (NAN, 6.0), (1.0, NAN)])
def test_modes_that_are_not_flown_are_refused(params):
    answers = hovering().receive(command(176, *params), 10.0)
    assert ack(answers) == DENIED
    assert "refused" in text(answers)


def test_go_to_is_refused_on_the_ground_outside_the_fence_and_in_a_local_frame():
    lat, lon = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 10.0, 31.0)
    vehicle = on_the_ground()
    assert text(vehicle.receive(command(192, p5=lat, p6=lon, p7=493.0), 1.0)) == "Go-to refused: disarmed"
    vehicle.arm(1.0)
    assert text(vehicle.receive(command(192, p5=lat, p6=lon, p7=493.0), 1.0)) == "Go-to refused: on the ground"
    vehicle = hovering()
    answers = vehicle.receive(command_int(192, 5, round(lat * 1e7), round(lon * 1e7), 493.0), 10.0)
    assert ack(answers) == DENIED
    assert "outside the area" in text(answers)
    assert text(vehicle.receive(command_int(192, 1, 0, 0, 5.0), 10.0)) == "Go-to refused: frame 1 is not global"
    assert not vehicle.moving


@pytest.mark.parametrize("number", [16, 31000, 300, 42428])
def test_what_is_not_known_is_answered_as_unsupported(number):
    assert ack(hovering().receive(command(number), 10.0)) == UNSUPPORTED


@pytest.mark.parametrize("number", [400, 511, 512])
def test_a_command_without_its_numbers_is_denied(number):
    assert ack(hovering().receive(command(number, NAN, NAN), 10.0)) == DENIED


def test_what_is_for_others_is_not_answered():
    vehicle = hovering()
    assert vehicle.receive(command(400, 0.0, system=2), 10.0) == []
    assert vehicle.receive(command(400, 0.0, component=100), 10.0) == []
    assert vehicle.receive(waypoint(1.0, 1.0, system=2), 10.0) == []
    assert vehicle.receive(wire(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)), 10.0) == []
    assert not vehicle.set_mode(10.0, Mode.OFFBOARD).accepted


REFUSED_WAYPOINTS = {
    "outside the area": (waypoint(4.0, 31.0), "Waypoint refused: (31.0, 4.0) m is outside the area [0, 30] x [0, 30] m"),
    "outside the altitudes": (waypoint(4.0, 4.0, -121.0), "Waypoint refused: altitude 121.0 m is outside [0, 120] m"),
    "not finite": (waypoint(NAN, 4.0), "Waypoint refused: (4.0, nan) m at 5.0 m is not finite"),
    "frame": (waypoint(4.0, 4.0, frame=8), "Waypoint refused: frame 8 is not LOCAL_NED (1)"),
    "no position": (waypoint(4.0, 4.0, mask=0b110111000111), "Waypoint refused: it has no position x, y, z"),
}


@pytest.mark.parametrize("kind", REFUSED_WAYPOINTS)
def test_a_waypoint_that_makes_no_sense_is_refused_with_its_reason_and_changes_nothing(kind):
    message, reason = REFUSED_WAYPOINTS[kind]
    vehicle = offboard()
    before, expiry = vehicle.state(10.0), vehicle.next_event_s()
    assert text(vehicle.receive(message, 10.0)) == reason
    assert vehicle.refused == {kind: 1}
    assert vehicle.state(10.0) == before
    assert vehicle.next_event_s() == expiry  # a refused setpoint is no sign of life either


@pytest.mark.parametrize("message", [waypoint(-1e-6, 0.0), waypoint(30.000002, 0.0), waypoint(0, 0, 1e-6), waypoint(0, 0, -math.inf)])
def test_the_fence_is_exact(message):
    vehicle = offboard()
    assert text(vehicle.receive(message, 10.0)).startswith("Waypoint refused: ")


def test_a_waypoint_with_a_yaw_that_is_no_number_is_refused():
    assert text(offboard().receive(waypoint(1.0, 1.0, yaw=NAN), 10.0)) == "Waypoint refused: yaw nan is not finite"


def test_the_same_refusal_is_told_once_a_second_at_20_hz():
    vehicle = offboard()
    told = [text(vehicle.receive(waypoint(4.0, 31.0 + n), 10.0 + n / 20.0)) != "" for n in range(60)]
    assert sum(told) == 3
    assert vehicle.refused["outside the area"] == 60
    assert text(vehicle.receive(waypoint(NAN, 1.0), 13.0)) != ""  # another reason is told at once


def test_a_long_reason_comes_in_chunks_of_50_with_one_id():
    first, second = offboard().receive(waypoint(4.0, 31.0), 10.0)
    assert len(first.text) == 50
    assert (first.chunk_seq, second.chunk_seq) == (0, 1)
    assert first.id == second.id != 0


def test_a_text_that_fills_its_last_chunk_is_ended_by_an_empty_one():
    chunks = hovering()._text(4, "x" * 100)
    assert [m.text for m in chunks] == ["x" * 50, "x" * 50, ""]


def test_time_does_not_run_backwards():
    vehicle = hovering()
    with pytest.raises(ValueError, match="backwards"):
        vehicle.advance(1.0)


@pytest.mark.parametrize(
    "wrong", [{"sysid": 0}, {"area_m": -1.0}, {"speed_mps": NAN}, {"takeoff_altitude_m": 121.0}, {"home_lat_deg": 91.0}]
)
def test_a_configuration_that_cannot_fly_is_refused_by_field_and_value(wrong):
    ((field, value),) = wrong.items()
    with pytest.raises(ValueError, match=f"{field} is {value}.*allowed"):
        VehicleConfig(**wrong)


# ---- flight ----


def test_it_takes_off_when_armed_and_then_holds():
    vehicle = on_the_ground()
    assert ack(vehicle.receive(command(400, 1.0), 1.0)) == ACCEPTED
    assert ack(vehicle.receive(command(22, NAN, NAN, NAN, NAN, NAN, NAN, NAN), 1.0)) == ACCEPTED
    assert (vehicle.state(2.0).mode, vehicle.state(2.0).landed) == (Mode.TAKEOFF, TAKING_OFF)
    assert vehicle.next_event_s() == pytest.approx(1.0 + CLIMB_S)
    vehicle.advance(10.0)
    state = vehicle.state(10.0)
    assert (state.mode, state.landed, state.position, state.velocity) == (Mode.HOLD, IN_AIR, (0.0, 0.0, -5.0), (0.0, 0.0, 0.0))


def test_a_takeoff_altitude_is_above_mean_sea_level():
    vehicle = on_the_ground()
    vehicle.arm(0.0)
    vehicle.receive(command(22, p7=488.0 + 12.0), 0.0)
    vehicle.advance(60.0)
    assert vehicle.state(60.0).position == (0.0, 0.0, -12.0)


def test_a_command_repeated_because_its_answer_was_lost_is_accepted_again():
    vehicle = on_the_ground()
    for number in (400, 22):
        for t in (1.0, 1.5):
            assert ack(vehicle.receive(command(number, 1.0, p7=NAN), t if number == 400 else t + 1.0)) == ACCEPTED
    assert vehicle.next_event_s() == pytest.approx(2.0 + CLIMB_S)


def test_landing_ends_on_the_ground_disarmed():
    vehicle = hovering()
    assert ack(vehicle.receive(command(21), 10.0)) == ACCEPTED
    assert vehicle.state(11.0).landed == LANDING
    # 5 m down at 1.5 m/s: two ramps of 0.5 s and 0.375 m, and 4.25 m of cruise.
    touchdown = 10.0 + 1.0 + 4.25 / 1.5
    assert vehicle.next_event_s() == pytest.approx(touchdown)
    vehicle.advance(touchdown - 0.01)
    assert vehicle.state(touchdown - 0.01).armed
    vehicle.advance(touchdown + 0.01)
    state = vehicle.state(touchdown + 0.01)
    assert (state.armed, state.landed, state.position) == (False, GROUND, (0.0, 0.0, 0.0))


def test_return_flies_home_lands_and_disarms():
    vehicle = hovering()
    vehicle.go_to(10.0, (20.0, 10.0, -2.0))
    vehicle.advance(30.0)
    assert ack(vehicle.receive(command(20), 30.0)) == ACCEPTED
    lowest_on_the_way = 0.0
    for n in range(1, 400):
        t = 30.0 + n / 10.0
        vehicle.advance(t)
        state = vehicle.state(t)
        if math.hypot(*state.position[:2]) > 0.1 and math.hypot(*state.position[:2]) < 22.0:
            lowest_on_the_way = max(lowest_on_the_way, state.position[2] + 5.0)
    assert lowest_on_the_way == pytest.approx(0.0, abs=1e-9)  # it climbed to 5 m before it left
    assert (state.position, state.armed, state.landed) == ((0.0, 0.0, 0.0), False, GROUND)


def test_a_forced_disarm_in_the_air_lets_it_fall():
    vehicle = hovering()
    assert ack(vehicle.receive(command(400, 0.0, 21196.0), 10.0)) == ACCEPTED
    impact = 10.0 + math.sqrt(10.0 / GRAVITY_MPS2)
    assert vehicle.next_event_s() == pytest.approx(10.0)  # what it has to say
    assert texts(vehicle.advance(10.0)) == ["Motors stopped in the air"]
    assert vehicle.next_event_s() == pytest.approx(impact)
    assert not vehicle.state(10.5).armed
    assert vehicle.state(10.5).landed == IN_AIR
    assert vehicle.arm(10.5).reason == "Arming refused: falling"
    assert vehicle.set_mode(10.5, Mode.LAND).reason == "Land refused: falling"
    vehicle.advance(12.0)
    assert (vehicle.state(12.0).position, vehicle.state(12.0).landed) == ((0.0, 0.0, 0.0), GROUND)
    assert vehicle.arm(12.0).accepted


def test_hold_brakes_and_stays():
    vehicle = offboard()
    vehicle.receive(waypoint(20.0, 0.0), 10.0)
    assert ack(vehicle.receive(command(176, 1.0, 4.0, 3.0), 13.0)) == ACCEPTED
    assert vehicle.advance(60.0) == []  # neither arrived nor silent: OFFBOARD is over
    ramp_s, ramp_m = 5.0 / 3.0, 25.0 / 6.0
    stop = ramp_m + (3.0 - ramp_s) * 5.0 + ramp_m
    assert vehicle.state(60.0).position == pytest.approx((stop, 0.0, -5.0))


@pytest.mark.parametrize("frame", [0, 5, 3, 6])
def test_go_to_flies_to_a_latitude_and_longitude_and_holds_there(frame):
    vehicle = hovering()
    lat, lon = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 10.0, 20.0)
    altitude = 8.0 if frame in (3, 6) else 496.0
    answers = vehicle.receive(command_int(192, frame, round(lat * 1e7), round(lon * 1e7), altitude, p4=1.0), 10.0)
    assert ack(answers) == ACCEPTED
    assert vehicle.advance(100.0) == []
    assert vehicle.state(100.0).position == pytest.approx((10.0, 20.0, -8.0), abs=0.012)  # the step of 1e-7 degrees
    assert (vehicle.state(100.0).mode, vehicle.state(100.0).yaw) == (Mode.HOLD, 1.0)


def test_go_to_without_a_place_changes_only_the_altitude():
    vehicle = hovering()
    vehicle.receive(command_int(192, 6, 0x7FFFFFFF, 0x7FFFFFFF, 9.0), 10.0)
    vehicle.advance(60.0)
    assert vehicle.state(60.0).position == (0.0, 0.0, -9.0)


def test_go_to_home_is_not_outside_the_area_by_a_rounded_digit():
    config = VehicleConfig(home_lat_deg=47.39774205, home_lon_deg=8.54559405)  # 5 mm off what MAVLink can say
    vehicle = hovering(config)
    assert ack(vehicle.receive(command_int(192, 6, 473977420, 85455940, 6.0), 10.0)) == ACCEPTED


def test_set_mode_does_the_same_as_its_command():
    vehicle = hovering()
    answers = vehicle.receive(wire(mavlink.MAVLink_set_mode_message(1, 1, Mode.LAND.custom_mode)), 10.0)
    assert (ack(answers), answers[0].command) == (ACCEPTED, 11)
    assert vehicle.state(10.0).mode is Mode.LAND


def test_the_numbers_of_the_modes_are_px4s():
    assert {mode.name: mode.custom_mode for mode in Mode} == {
        "TAKEOFF": 0x02040000,
        "HOLD": 0x03040000,
        "RETURN": 0x05040000,
        "LAND": 0x06040000,
        "OFFBOARD": 0x00060000,
    }


# ---- waypoints ----


def test_a_waypoint_is_remembered_and_flown_once_in_offboard():
    vehicle = hovering()
    assert vehicle.receive(waypoint(3.0, 4.0), 10.0) == []
    assert not vehicle.moving
    assert ack(vehicle.receive(command(176, 1.0, 6.0), 11.0)) == ACCEPTED
    # 5 m: two ramps of 5/3 s would need 25/3 m, so it is a triangle: 2 sqrt(5/3) s.
    (arrived,) = fly_on(vehicle)
    assert arrived.time_s == pytest.approx(11.0 + 2.0 * math.sqrt(5.0 / 3.0))
    assert arrived.position == (3.0, 4.0, -5.0)


def test_a_client_may_set_offboard_first_and_then_arm():
    vehicle = on_the_ground()
    vehicle.receive(waypoint(3.0, 4.0), 1.0)
    assert ack(vehicle.receive(command(176, 1.0, 6.0), 1.0)) == ACCEPTED
    assert not vehicle.moving
    assert ack(vehicle.receive(command(400, 1.0), 2.0)) == ACCEPTED
    assert places(fly_on(vehicle)) == [(3.0, 4.0, -5.0)]


def test_arming_in_offboard_is_refused_once_the_client_is_gone():
    vehicle = on_the_ground()
    vehicle.receive(waypoint(3.0, 4.0), 1.0)
    vehicle.set_mode(1.0, Mode.OFFBOARD)
    assert vehicle.arm(40.0).reason == "Arming refused: no setpoint in the last 30 s"


@given(st.tuples(*[st.floats(0.0, 30.0, width=32)] * 2, st.floats(-120.0, 0.0, width=32)))
def test_the_position_on_arrival_is_the_waypoints_float32_bit_for_bit(target):
    vehicle = offboard()
    vehicle.sampled(100)
    vehicle.receive(waypoint(*target, time_boot_ms=100), 10.0)
    (arrived,) = fly_on(vehicle)
    assert struct.pack("<3f", *arrived.position) == struct.pack("<3f", *target)
    assert vehicle.state(vehicle.now_s).position == arrived.position


def test_a_keep_alive_starts_no_new_leg():
    vehicle = offboard()
    vehicle.receive(waypoint(3.0, 4.0), 10.0)
    due = vehicle.next_event_s()
    for n in range(1, 100):
        events = vehicle.advance(10.0 + n / 20.0)
        assert len(places(events)) == (1 if 10.0 + (n - 1) / 20.0 < due <= 10.0 + n / 20.0 else 0)
        vehicle.receive(waypoint(3.0, 4.0, time_boot_ms=n), 10.0 + n / 20.0)
    assert not vehicle.moving


def test_a_new_yaw_turns_without_a_new_leg():
    vehicle = offboard()
    vehicle.receive(waypoint(0.0, 0.0, yaw=math.pi / 2), 10.0)
    assert not vehicle.moving
    assert vehicle.state(11.0).yaw == pytest.approx(math.radians(45.0))
    assert vehicle.state(13.0).yaw == pytest.approx(math.pi / 2)


def test_a_waypoint_on_the_way_replaces_the_one_flown_to():
    vehicle = offboard()
    vehicle.receive(waypoint(20.0, 0.0), 10.0)
    vehicle.receive(waypoint(0.0, 20.0), 12.0)
    assert places(fly_on(vehicle)) == [(0.0, 20.0, -5.0)]


# ---- readings and their answers ----


def test_a_late_answer_and_a_second_one_are_ignored_and_counted():
    vehicle = offboard()
    vehicle.sampled(100)
    assert vehicle.awaiting_answer
    vehicle.receive(waypoint(1.0, 0.0, time_boot_ms=100), 10.0)
    assert not vehicle.awaiting_answer
    assert vehicle.receive(waypoint(2.0, 0.0, time_boot_ms=100), 10.1) == []
    fly_on(vehicle)
    vehicle.sampled(200)
    assert vehicle.receive(waypoint(3.0, 0.0, time_boot_ms=100), 20.0) == []
    assert not vehicle.moving
    assert vehicle.awaiting_answer
    assert vehicle.ignored == {"duplicate": 1, "late": 1}
    assert vehicle.refused == {}


def test_an_ignored_answer_is_no_sign_of_life():
    vehicle = offboard()
    vehicle.sampled(100)
    vehicle.receive(waypoint(0.0, 0.0, time_boot_ms=100), 5.0)
    vehicle.advance(5.0)
    expiry = vehicle.next_event_s()
    vehicle.receive(waypoint(0.0, 0.0, time_boot_ms=100), 20.0)
    assert vehicle.next_event_s() == expiry == 35.0


def test_an_answer_to_stay_arrives_at_once():
    vehicle = offboard()
    vehicle.sampled(100)
    vehicle.receive(waypoint(0.0, 0.0, time_boot_ms=100), 10.0)
    assert vehicle.next_event_s() == 10.0
    assert vehicle.advance(10.0) == [Arrived(10.0, (0.0, 0.0, -5.0))]


def test_a_refused_answer_leaves_the_reading_unanswered():
    vehicle = offboard()
    vehicle.sampled(100)
    vehicle.receive(waypoint(31.0, 0.0, time_boot_ms=100), 10.0)
    assert vehicle.awaiting_answer


def test_an_answer_before_offboard_is_remembered_as_the_answer():
    vehicle = hovering()
    vehicle.sampled(100)
    vehicle.receive(waypoint(1.0, 0.0, time_boot_ms=100), 10.0)
    assert not vehicle.awaiting_answer
    vehicle.set_mode(10.0, Mode.OFFBOARD)
    assert places(fly_on(vehicle)) == [(1.0, 0.0, -5.0)]


def test_the_times_of_readings_must_grow():
    vehicle = offboard()
    vehicle.sampled(100)
    with pytest.raises(ValueError, match="100 ms"):
        vehicle.sampled(100)


def test_a_search_visits_every_waypoint_once_though_each_is_sent_twice():
    vehicle, visited = offboard(), []
    for n, (north, east) in enumerate([(0.1, 1.0), (0.1, 1.0), (2.5, 1.0), (2.5, 3.3)]):
        stamp = 1000 + n
        vehicle.sampled(stamp)
        for _ in range(2):
            vehicle.receive(waypoint(north, east, time_boot_ms=stamp), vehicle.now_s)
        visited += places(fly_on(vehicle))
    assert visited == [pytest.approx((north, east, -5.0)) for north, east in [(0.1, 1.0), (0.1, 1.0), (2.5, 1.0), (2.5, 3.3)]]
    assert vehicle.ignored == {"duplicate": 4}


# ---- failsafes ----


def test_silence_brings_it_home():
    vehicle = offboard()
    vehicle.receive(waypoint(10.0, 10.0), 10.0)
    arrived = fly_on(vehicle)[0].time_s
    assert vehicle.next_event_s() == arrived + 30.0  # a leg may take long: silence counts from its end
    vehicle.advance(arrived + 29.9)
    assert vehicle.state(arrived + 29.9).mode is Mode.OFFBOARD
    assert texts(vehicle.advance(arrived + 30.1)) == ["No setpoint for 30 s: returning home"]
    assert (vehicle.state(arrived + 30.1).mode, vehicle.state(arrived + 30.1).failsafe) == (Mode.RETURN, True)
    vehicle.advance(200.0)
    state = vehicle.state(200.0)
    assert (state.position, state.armed, state.failsafe) == ((0.0, 0.0, 0.0), False, False)


def test_a_keep_alive_puts_silence_off():
    vehicle = offboard()
    for t in range(10, 200, 10):
        vehicle.receive(waypoint(0.0, 0.0), float(t))
    assert vehicle.advance(219.0) == []
    assert texts(vehicle.advance(221.0)) == ["No setpoint for 30 s: returning home"]


def test_silence_in_hold_is_no_alarm():
    vehicle = hovering()
    assert vehicle.advance(1000.0) == []


def test_a_client_that_comes_back_may_take_over_again():
    vehicle = offboard()
    vehicle.advance(40.0)
    vehicle.receive(waypoint(2.0, 2.0), 40.0)
    assert vehicle.state(40.0).mode is not Mode.OFFBOARD  # a setpoint alone does not
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
    assert [(e.time_s, e.text) for e in vehicle.advance(149.0)] == [(135.0, "Battery low: 15% left")]
    assert texts(vehicle.advance(151.0)) == ["Battery empty: landing"]
    assert vehicle.set_mode(151.0, Mode.HOLD).reason == "Hold refused: battery empty"
    vehicle.advance(200.0)
    assert not vehicle.state(200.0).armed
    assert not vehicle.state(200.0).fit
    answers = vehicle.receive(command(400, 1.0), 200.0)
    assert (ack(answers), text(answers)) == (REJECTED, "Arming refused: battery empty")


def test_a_battery_without_end_never_drains():
    vehicle = hovering(VehicleConfig(endurance_s=math.inf))
    assert vehicle.next_event_s() is None
    assert vehicle.state(10.0).battery == 1.0


# ---- requests go to the telemetry of the link they came over ----


@pytest.fixture
def telemetry_of():
    return lambda vehicle: Telemetry(lambda t: Snapshot(vehicle.config, vehicle.state(t), (1.0, 0.0), None))


def test_requests_without_telemetry_or_of_what_is_not_streamed_are_unsupported(telemetry_of):
    vehicle = hovering()
    assert ack(vehicle.receive(command(512, 242.0), 10.0)) == UNSUPPORTED
    assert ack(vehicle.receive(command(512, 76.0), 10.0, telemetry_of(vehicle))) == UNSUPPORTED
    assert ack(vehicle.receive(command(511, 30.0, -2.0), 10.0, telemetry_of(vehicle))) == UNSUPPORTED


@pytest.mark.parametrize(
    ("number", "param", "expected"),
    [(512, 242.0, "HOME_POSITION"), (410, 0.0, "HOME_POSITION"), (520, 1.0, "AUTOPILOT_VERSION"), (512, 148.0, "AUTOPILOT_VERSION")],
)
def test_a_message_is_sent_on_request(number, param, expected, telemetry_of):
    vehicle = hovering()
    answers = vehicle.receive(command(number, param), 10.0, telemetry_of(vehicle))
    assert ack(answers) == ACCEPTED
    assert [m.get_type() for m in answers] == ["COMMAND_ACK", expected]


def test_an_interval_is_set_on_request(telemetry_of):
    vehicle = hovering()
    telemetry = telemetry_of(vehicle)
    assert ack(vehicle.receive(command(511, 30.0, -1.0), 10.0, telemetry)) == ACCEPTED
    assert "ATTITUDE" not in {m.get_type() for m in telemetry.due(11.0)}


# ---- any step ----

ACTIONS = {
    "arm": lambda v, t, p: v.arm(t),
    "take off": lambda v, t, p: v.take_off(t),
    "waypoint": lambda v, t, p: v.setpoint(t, p),
    "offboard": lambda v, t, p: v.set_mode(t, Mode.OFFBOARD),
    "hold": lambda v, t, p: v.set_mode(t, Mode.HOLD),
    "go to": lambda v, t, p: v.go_to(t, p, yaw_rad=p[0] / 10.0),
    "return": lambda v, t, p: v.set_mode(t, Mode.RETURN),
    "land": lambda v, t, p: v.set_mode(t, Mode.LAND),
    "disarm": lambda v, t, p: v.disarm(t),
    "drop": lambda v, t, p: v.disarm(t, force=True),
}
START = [(0.0, "arm", (0.0, 0.0, 0.0)), (0.0, "take off", (0.0, 0.0, 0.0))]
targets = st.tuples(st.floats(-1.0, 30.0, width=32), st.floats(0.0, 31.0, width=32), st.floats(-12.0, 0.0, width=32))
scripts = st.lists(st.tuples(st.floats(0.0, 8.0), st.sampled_from(sorted(ACTIONS)), targets), max_size=12)
flights = st.lists(st.tuples(st.floats(0.0, 8.0), st.sampled_from(["waypoint", "offboard", "waypoint", "hold"]), targets), max_size=12)


def play(script, steps):
    """Everything that a script brings about, time cut into the given steps between its actions (none: one jump)."""
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
    return [event[:2] for event in events], results, [*states, vehicle.state(now + 80.0)]


@settings(max_examples=150, deadline=None)
@given(scripts | flights.map(lambda script: START + script), st.lists(st.floats(0.05, 9.0), min_size=1, max_size=5))
def test_one_jump_and_many_steps_give_the_same_bits_and_events(script, steps):
    assert repr(play(script, [])) == repr(play(script, steps))


def test_a_flight_in_steps_of_a_millisecond_gives_the_same_bits_and_events():
    script = [*START, (4.0, "waypoint", (9.0, 7.0, -6.0)), (0.0, "offboard", (0.0, 0.0, 0.0)), (1.3, "waypoint", (2.0, 20.0, -5.0))]
    events, *rest = play(script, [])
    assert [type(e[1]) for e in events] == [tuple, str]  # arrived; silence brings it home
    assert repr((events, *rest)) == repr(play(script, [0.001] * 10))


@settings(max_examples=150, deadline=None)
@given(scripts | flights.map(lambda script: START + script))
def test_left_alone_it_comes_to_rest_and_never_below_the_ground(script):
    _, _, states = play(script, [])
    assert all(state.position[2] <= 0.0 for state in states)
    assert not states[-1].armed  # the battery sees to that
    assert states[-1].velocity == (0.0, 0.0, 0.0)
