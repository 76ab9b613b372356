"""Protects the MAVLink protocol: what each command does, who gets which answer, and the words of the
texts.
"""

import math
import struct

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from link.modes import Mode
from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.telemetry import Snapshot, Telemetry
from tests.ground.tlog.flights import (
    ACCEPTED,
    CONFIG,
    DENIED,
    NAN,
    REJECTED,
    UNSUPPORTED,
    fly_on,
    hovering,
    offboard,
    on_the_ground,
    places,
    texts,
)

CLIENT = (245, 190)


def wire(message):
    """The message as a remote client sends it: every float is a float32."""
    packed = message.pack(mavlink.MAVLink(None, srcSystem=CLIENT[0], srcComponent=CLIENT[1]))
    return mavlink.MAVLink(None).decode(bytearray(packed))


def command(number, p1=0.0, p2=0.0, p3=0.0, p4=0.0, p5=0.0, p6=0.0, p7=0.0, system=1, component=1):
    return wire(
        mavlink.MAVLink_command_long_message(system, component, number, 0, p1, p2, p3, p4, p5, p6, p7)
    )


def command_int(number, frame, x, y, z, p4=NAN):
    return wire(mavlink.MAVLink_command_int_message(1, 1, frame, number, 0, 0, -1.0, 1.0, 0.0, p4, x, y, z))


def waypoint(north, east, down=-5.0, time_boot_ms=1, yaw=None, frame=1, mask=0b110111111000, system=1):
    mask &= 0xFFF if yaw is None else ~1024
    return wire(
        mavlink.MAVLink_set_position_target_local_ned_message(
            time_boot_ms,
            system,
            1,
            frame,
            mask,
            north,
            east,
            down,
            9.0,
            9.0,
            9.0,
            9.0,
            9.0,
            9.0,
            yaw or 0.0,
            9.0,
        )
    )


def ack(answers):
    (only,) = (m for m in answers if m.get_type() == "COMMAND_ACK")
    return only.result


def text(answers):
    return "".join(m.text for m in answers if m.get_type() == "STATUSTEXT")


# ---- refusals ----


def test_a_refused_command_is_acknowledged_to_its_client_and_told_why():
    vehicle = on_the_ground()
    answers = MavlinkProtocol(vehicle).receive(command(20), 1.0)
    assert ack(answers) == REJECTED
    assert text(answers) == "Return refused: on the ground"
    assert (answers[0].target_system, answers[0].target_component) == CLIENT
    assert not vehicle.moving


@pytest.mark.parametrize(
    ("situation", "message", "reason"),
    [
        (on_the_ground, command(20), "Return refused: on the ground"),
        (on_the_ground, command(21), "Land refused: on the ground"),
        (on_the_ground, command(192, p7=493.0), "Go-to refused: disarmed"),
        (hovering, command(22, p7=NAN), "Take-off refused: already in the air"),
        (hovering, command(400, 0.0), "Disarm refused: in the air"),
        (hovering, command(176, 1.0, 6.0), "Offboard refused: no setpoint received yet"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_the_vehicle_refuses_for_now_is_rejected_with_its_reason(situation, message, reason):
    answers = MavlinkProtocol(situation()).receive(message, 10.0)
    assert (ack(answers), text(answers)) == (REJECTED, reason)


def test_what_could_never_be_done_is_denied():
    vehicle = on_the_ground()
    vehicle.arm(0.0)
    answers = MavlinkProtocol(vehicle).receive(command(22, p7=488.0 + 121.0), 0.0)
    assert ack(answers) == DENIED
    assert "up to 120 m" in text(answers)


@pytest.mark.parametrize(
    "params", [(1.0, 3.0), (1.0, 1.0), (1.0, 4.0, 1.0), (0.0, 6.0), (NAN, 6.0), (1.0, NAN)]
)
def test_modes_that_are_not_flown_are_refused(params):
    answers = MavlinkProtocol(hovering()).receive(command(176, *params), 10.0)
    assert ack(answers) == DENIED
    assert "refused" in text(answers)


def test_go_to_is_refused_outside_the_fence_and_in_a_local_frame():
    lat, lon = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 10.0, 31.0)
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    answers = protocol.receive(command_int(192, 5, round(lat * 1e7), round(lon * 1e7), 493.0), 10.0)
    assert ack(answers) == DENIED
    assert "outside the area" in text(answers)
    assert (
        text(protocol.receive(command_int(192, 1, 0, 0, 5.0), 10.0)) == "Go-to refused: frame 1 is not global"
    )
    assert not vehicle.moving


@pytest.mark.parametrize("number", [16, 31000, 207, 42428])
def test_what_is_not_known_is_answered_as_unsupported(number):
    assert ack(MavlinkProtocol(hovering()).receive(command(number), 10.0)) == UNSUPPORTED


@pytest.mark.parametrize("number", [400, 511, 512])
def test_a_command_without_its_numbers_is_denied(number):
    assert ack(MavlinkProtocol(hovering()).receive(command(number, NAN, NAN), 10.0)) == DENIED


def test_what_is_for_others_is_not_answered():
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    assert protocol.receive(command(400, 0.0, system=2), 10.0) == []
    assert protocol.receive(command(400, 0.0, component=100), 10.0) == []
    assert protocol.receive(waypoint(1.0, 1.0, system=2), 10.0) == []
    assert protocol.receive(wire(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)), 10.0) == []
    assert not vehicle.set_mode(10.0, Mode.OFFBOARD).accepted


NOT_WHOLE = (
    "Setpoint refused: wanted a position, a velocity, a velocity x, y with a position z, or an "
    "acceleration, each whole"
)
REFUSED_WAYPOINTS = {
    "outside the area": (
        waypoint(4.0, 31.0),
        "Waypoint refused: (31.0, 4.0) m is outside the area [0, 30] x [0, 30] m",
    ),
    "outside the altitudes": (
        waypoint(4.0, 4.0, -121.0),
        "Waypoint refused: altitude 121.0 m is outside [0, 120] m",
    ),
    "not finite": (waypoint(NAN, 4.0), "Waypoint refused: (4.0, nan) m at 5.0 m is not finite"),
    "frame": (waypoint(4.0, 4.0, frame=7), "Setpoint refused: frame 7 is not LOCAL_NED (1) or BODY_NED (8)"),
    "not whole": (waypoint(4.0, 4.0, mask=0b110111111111), NOT_WHOLE),
}


@pytest.mark.parametrize("kind", REFUSED_WAYPOINTS)
def test_a_waypoint_that_makes_no_sense_is_refused_with_its_reason_and_changes_nothing(kind):
    message, reason = REFUSED_WAYPOINTS[kind]
    vehicle = offboard()
    protocol = MavlinkProtocol(vehicle)
    before, expiry = vehicle.state(10.0), vehicle.next_event_s()
    assert text(protocol.receive(message, 10.0)) == reason
    assert protocol.refused == {kind: 1}
    assert vehicle.state(10.0) == before
    assert vehicle.next_event_s() == expiry  # a refused setpoint does not reset the timeout either


def test_a_yaw_that_is_no_number_is_ignored_as_in_px4_but_an_infinite_one_is_refused():
    vehicle = offboard()
    protocol = MavlinkProtocol(vehicle)
    assert protocol.receive(waypoint(1.0, 1.0, yaw=NAN), 10.0) == []
    assert vehicle.waypoint == (1.0, 1.0, -5.0)
    assert (
        text(protocol.receive(waypoint(2.0, 1.0, yaw=math.inf), 10.0))
        == "Waypoint refused: yaw inf is not finite"
    )


def test_the_same_refusal_is_told_once_a_second_at_20_hz():
    protocol = MavlinkProtocol(offboard())
    told = [text(protocol.receive(waypoint(4.0, 31.0 + n), 10.0 + n / 20.0)) != "" for n in range(60)]
    assert sum(told) == 3
    assert protocol.refused["outside the area"] == 60
    assert text(protocol.receive(waypoint(NAN, 1.0), 13.0)) != ""  # another reason is reported at once


def test_a_long_reason_comes_in_chunks_of_50_with_one_id():
    first, second = MavlinkProtocol(offboard()).receive(waypoint(4.0, 31.0), 10.0)
    assert len(first.text) == 50
    assert (first.chunk_seq, second.chunk_seq) == (0, 1)
    assert first.id == second.id != 0


def test_a_text_that_fills_its_last_chunk_is_ended_by_an_empty_one():
    chunks = MavlinkProtocol(hovering()).statustext(4, "x" * 100)
    assert [m.text for m in chunks] == ["x" * 50, "x" * 50, ""]


def test_each_text_in_chunks_has_an_id_of_its_own_and_each_its_severity():
    protocol = MavlinkProtocol(offboard())
    reason, said, short = (
        protocol.receive(waypoint(4.0, 31.0), 10.0),
        protocol.statustext(2, "x" * 51),
        protocol.statustext(2, "x" * 50),
    )
    assert {(m.severity, m.id) for m in reason} == {(4, 1)}  # a reason is a warning
    assert {(m.severity, m.id) for m in said} == {(2, 2)}
    assert [(m.severity, m.id) for m in short] == [(2, 0)]


# ---- commands ----


def test_a_client_arms_and_takes_off_to_the_default_altitude():
    vehicle = on_the_ground()
    protocol = MavlinkProtocol(vehicle)
    assert ack(protocol.receive(command(400, 1.0), 1.0)) == ACCEPTED
    assert ack(protocol.receive(command(22, NAN, NAN, NAN, NAN, NAN, NAN, NAN), 1.0)) == ACCEPTED
    assert vehicle.state(2.0).mode is Mode.TAKEOFF
    vehicle.advance(10.0)
    assert (vehicle.state(10.0).mode, vehicle.state(10.0).position) == (Mode.HOLD, (0.0, 0.0, -5.0))


def test_the_slider_of_qgroundcontrol_takes_off_before_it_arms():
    vehicle = on_the_ground()
    protocol = MavlinkProtocol(vehicle)
    assert ack(protocol.receive(command(22, -1.0, 0.0, 0.0, NAN, NAN, NAN, 488.0 + 9.0), 1.0)) == ACCEPTED
    assert (vehicle.state(1.0).mode, vehicle.state(1.0).armed) == (Mode.TAKEOFF, False)
    assert ack(protocol.receive(command(400, 1.0), 1.2)) == ACCEPTED
    vehicle.advance(20.0)
    assert vehicle.state(20.0).position == (0.0, 0.0, -9.0)


def test_the_mode_takeoff_may_come_before_arming_too():
    vehicle = on_the_ground()
    protocol = MavlinkProtocol(vehicle)
    assert ack(protocol.receive(command(176, 1.0, 4.0, 2.0), 1.0)) == ACCEPTED
    assert ack(protocol.receive(command(400, 1.0), 1.2)) == ACCEPTED
    vehicle.advance(20.0)
    assert vehicle.state(20.0).position == (0.0, 0.0, -5.0)


def test_a_takeoff_altitude_is_above_mean_sea_level():
    vehicle = on_the_ground()
    vehicle.arm(0.0)
    MavlinkProtocol(vehicle).receive(command(22, p7=488.0 + 12.0), 0.0)
    vehicle.advance(60.0)
    assert vehicle.state(60.0).position == (0.0, 0.0, -12.0)


@pytest.mark.parametrize(
    ("altitude", "height", "told"),
    [(488.0 + 4.0, 5.0, True), (7.0, 5.0, True), (488.0 + 4.95, 5.0, False), (488.0 + 5.5, 5.5, False)],
)
def test_a_takeoff_altitude_that_is_too_low_is_raised_with_a_word(altitude, height, told):
    vehicle = on_the_ground()
    vehicle.arm(0.0)
    answers = MavlinkProtocol(vehicle).receive(command(22, p7=altitude), 0.0)
    assert ack(answers) == ACCEPTED
    assert text(answers) == ("Using minimum takeoff altitude: 5 m above home" if told else "")
    vehicle.advance(60.0)
    assert vehicle.state(60.0).position == (0.0, 0.0, -height)


@pytest.mark.parametrize(
    ("kind", "speed", "after"),
    [
        (0.0, 3.0, (3.0, 3.0, 1.5)),
        (1.0, 3.0, (3.0, 3.0, 1.5)),
        (2.0, 2.0, (5.0, 2.0, 1.5)),
        (3.0, 1.0, (5.0, 3.0, 1.0)),
        (1.0, -1.0, (5.0, 3.0, 1.5)),
    ],
)
def test_speeds_are_changed_for_the_legs_to_come(kind, speed, after):
    vehicle = hovering()
    assert ack(MavlinkProtocol(vehicle).receive(command(178, kind, speed, -1.0), 10.0)) == ACCEPTED
    assert (vehicle.config.speed_mps, vehicle.config.climb_mps, vehicle.config.descent_mps) == after


@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ((1.0, 50.0), "Speed refused: 50, allowed is 0.5 to 20 m/s"),
        ((1.0, 0.0), "Speed refused: 0, allowed is 0.5 to 20 m/s"),
        ((4.0, 3.0), "Speed refused: param 1 is 4, allowed is 0 to 3"),
        ((1.0, NAN), "Command 178 refused: param 2 is nan"),
    ],
)
def test_a_speed_that_it_cannot_fly_is_denied(params, reason):
    vehicle = hovering()
    answers = MavlinkProtocol(vehicle).receive(command(178, *params), 10.0)
    assert (ack(answers), text(answers)) == (DENIED, reason)
    assert vehicle.config.speed_mps == 5.0


def test_who_overrides_the_radio_is_told_once_that_there_is_none():
    protocol = MavlinkProtocol(hovering())
    override = wire(mavlink.MAVLink_rc_channels_override_message(1, 1, *[1500] * 8))
    told = [text(protocol.receive(override, 10.0 + second)) for second in range(5)]
    assert told == ["RC override refused: not simulated", "", "", "", ""]


@pytest.mark.parametrize("frame", [0, 5, 3, 6])
def test_go_to_flies_to_a_latitude_and_longitude_and_holds_there(frame):
    vehicle = hovering()
    lat, lon = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 10.0, 20.0)
    altitude = 8.0 if frame in (3, 6) else 496.0
    answers = MavlinkProtocol(vehicle).receive(
        command_int(192, frame, round(lat * 1e7), round(lon * 1e7), altitude, p4=1.0), 10.0
    )
    assert ack(answers) == ACCEPTED
    assert vehicle.advance(100.0) == []
    assert vehicle.state(100.0).position == pytest.approx(
        (10.0, 20.0, -8.0), abs=0.012
    )  # the resolution, 1e-7 degrees
    assert (vehicle.state(100.0).mode, vehicle.state(100.0).yaw) == (Mode.HOLD, 1.0)


def test_go_to_without_a_place_changes_only_the_altitude():
    vehicle = hovering()
    MavlinkProtocol(vehicle).receive(command_int(192, 6, 0x7FFFFFFF, 0x7FFFFFFF, 9.0), 10.0)
    vehicle.advance(60.0)
    assert vehicle.state(60.0).position == (0.0, 0.0, -9.0)


def test_go_to_home_is_not_outside_the_area_by_a_rounded_digit():
    config = VehicleConfig(
        home_lat_deg=47.39774205, home_lon_deg=8.54559405
    )  # 5 mm off the nearest position that MAVLink can carry
    vehicle = hovering(config)
    assert (
        ack(MavlinkProtocol(vehicle).receive(command_int(192, 6, 473977420, 85455940, 6.0), 10.0)) == ACCEPTED
    )


def test_set_mode_does_the_same_as_its_command():
    vehicle = hovering()
    answers = MavlinkProtocol(vehicle).receive(
        wire(mavlink.MAVLink_set_mode_message(1, 1, Mode.LAND.custom_mode)), 10.0
    )
    assert (ack(answers), answers[0].command) == (ACCEPTED, 11)
    assert vehicle.state(10.0).mode is Mode.LAND


@pytest.mark.parametrize(
    ("params", "mode"),
    [
        ((4.0, 3.0), Mode.HOLD),
        ((4.0, 5.0), Mode.RETURN),
        ((4.0, 6.0), Mode.LAND),
        ((6.0, 7.0), Mode.OFFBOARD),
    ],
)
def test_a_mode_is_set_by_its_px4_numbers(params, mode):
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    protocol.receive(waypoint(1.0, 1.0), 10.0)
    assert ack(protocol.receive(command(176, 1.0, *params), 10.0)) == ACCEPTED
    assert vehicle.state(10.0).mode is mode


@pytest.mark.parametrize(("number", "mode"), [(20, Mode.RETURN), (21, Mode.LAND)])
def test_return_and_land_have_commands_of_their_own(number, mode):
    vehicle = hovering()
    assert ack(MavlinkProtocol(vehicle).receive(command(number), 10.0)) == ACCEPTED
    assert vehicle.state(10.0).mode is mode


def test_only_the_magic_number_stops_the_motors_in_the_air():
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    assert ack(protocol.receive(command(400, 0.0, 1.0), 10.0)) == REJECTED
    assert ack(protocol.receive(command(400, 0.0, 21196.0), 10.0)) == ACCEPTED
    assert not vehicle.state(10.0).armed


def test_a_message_lets_time_pass_and_what_happened_meanwhile_is_still_told():
    vehicle = offboard()
    MavlinkProtocol(vehicle).receive(wire(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)), 34.0)
    assert vehicle.now_s == 34.0
    assert vehicle.state(34.0).mode is Mode.LAND  # it was already above home
    assert texts(vehicle.advance(34.0)) == ["No setpoint for 30 s: returning home"]


# ---- waypoints ----


def test_a_waypoint_is_remembered_and_flown_once_in_offboard():
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    assert protocol.receive(waypoint(3.0, 4.0), 10.0) == []
    assert not vehicle.moving
    assert ack(protocol.receive(command(176, 1.0, 6.0), 11.0)) == ACCEPTED
    # 5 m: two ramps of 5/3 s would need 25/3 m, so it is a triangle: 2 sqrt(5/3) s.
    (arrived,) = fly_on(vehicle)
    assert arrived.time_s == pytest.approx(11.0 + 2.0 * math.sqrt(5.0 / 3.0))
    assert arrived.position == (3.0, 4.0, -5.0)


def test_a_client_may_set_offboard_first_and_then_arm():
    vehicle = on_the_ground()
    protocol = MavlinkProtocol(vehicle)
    protocol.receive(waypoint(3.0, 4.0), 1.0)
    assert ack(protocol.receive(command(176, 1.0, 6.0), 1.0)) == ACCEPTED
    assert not vehicle.moving
    assert ack(protocol.receive(command(400, 1.0), 2.0)) == ACCEPTED
    assert places(fly_on(vehicle)) == [(3.0, 4.0, -5.0)]


@given(st.tuples(*[st.floats(0.0, 30.0, width=32)] * 2, st.floats(-120.0, 0.0, width=32)))
def test_the_position_on_arrival_is_the_waypoints_float32_bit_for_bit(target):
    vehicle = offboard()
    MavlinkProtocol(vehicle).receive(waypoint(*target), 10.0)
    assume(vehicle.moving)
    (arrived,) = fly_on(vehicle)
    assert struct.pack("<3f", *arrived.position) == struct.pack("<3f", *target)
    assert vehicle.state(vehicle.now_s).position == arrived.position


def test_a_new_yaw_turns_without_a_new_leg():
    vehicle = offboard()
    MavlinkProtocol(vehicle).receive(waypoint(0.0, 0.0, yaw=math.pi / 2), 10.0)
    assert not vehicle.moving
    assert vehicle.state(11.0).yaw == pytest.approx(math.radians(45.0))
    assert vehicle.state(13.0).yaw == pytest.approx(math.pi / 2)


# ---- requests go to the telemetry of the link they came over ----


@pytest.fixture
def telemetry_of():
    return lambda vehicle: Telemetry(lambda t: Snapshot(vehicle.config, vehicle.state(t), (1.0, 0.0), None))


def test_requests_without_telemetry_or_of_what_is_not_streamed_are_unsupported(telemetry_of):
    vehicle = hovering()
    protocol = MavlinkProtocol(vehicle)
    assert ack(protocol.receive(command(512, 242.0), 10.0)) == UNSUPPORTED
    assert ack(protocol.receive(command(512, 76.0), 10.0, telemetry_of(vehicle))) == UNSUPPORTED
    assert ack(protocol.receive(command(511, 30.0, -2.0), 10.0, telemetry_of(vehicle))) == UNSUPPORTED


@pytest.mark.parametrize(
    ("number", "param", "expected"),
    [
        (512, 242.0, "HOME_POSITION"),
        (410, 0.0, "HOME_POSITION"),
        (520, 1.0, "AUTOPILOT_VERSION"),
        (512, 148.0, "AUTOPILOT_VERSION"),
    ],
)
def test_a_message_is_sent_on_request(number, param, expected, telemetry_of):
    vehicle = hovering()
    answers = MavlinkProtocol(vehicle).receive(command(number, param), 10.0, telemetry_of(vehicle))
    assert ack(answers) == ACCEPTED
    assert [m.get_type() for m in answers] == ["COMMAND_ACK", expected]


def test_an_interval_is_set_on_request(telemetry_of):
    vehicle = hovering()
    telemetry = telemetry_of(vehicle)
    assert ack(MavlinkProtocol(vehicle).receive(command(511, 30.0, -1.0), 10.0, telemetry)) == ACCEPTED
    assert "ATTITUDE" not in {m.get_type() for m in telemetry.due(11.0)}
