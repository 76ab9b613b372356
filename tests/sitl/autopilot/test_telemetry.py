"""Protects telemetry: rates, units, signs, and that only simulated parts are reported. Every frame is
packed and parsed as by a client.
"""

import math
import struct
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Reading, unpack_reading
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.telemetry import STREAMS, Snapshot, Telemetry
from sitl.autopilot.vehicle import State

CONFIG = VehicleConfig(home_heading_deg=90.0)
AT_REST = State(
    time_s=12.5,
    position=(0.0, 0.0, 0.0),
    velocity=(0.0, 0.0, 0.0),
    acceleration=(0.0, 0.0, 0.0),
    roll=0.0,
    pitch=0.0,
    yaw=0.0,
    yaw_rate=0.0,
    mode=Mode.HOLD,
    armed=False,
    landed_state=1,
    failsafe=False,
    battery=1.0,
    fit=True,
    target=(0.0, 0.0, 0.0),
)
FLYING = AT_REST._replace(
    position=(10.0, 20.0, -5.0),
    velocity=(3.0, 4.0, -1.0),
    yaw=-math.pi / 2,
    armed=True,
    landed_state=2,
    mode=Mode.OFFBOARD,
    battery=0.5,
)
NUMBER = {
    name.removeprefix("MAVLINK_MSG_ID_"): value
    for name, value in vars(mavlink).items()
    if name.startswith("MAVLINK_MSG_ID_")
}
GYRO, ACCEL, MAG, GPS, BATTERY, PREARM = 1, 2, 4, 0x20, 0x2000000, 0x10000000


def telemetry(state=FLYING, wind=(0.0, 0.0), gas=(12_500, 0.25), config=CONFIG):
    return Telemetry(lambda t: Snapshot(config, state._replace(time_s=t), wind, gas))


def report(name, state=FLYING, at_s=12.5, **kwargs):
    """The message as a client receives it."""
    message = telemetry(state, **kwargs).build(NUMBER[name], at_s)
    return mavlink.MAVLink(None).decode(
        bytearray(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))
    )


def count(source, seconds, step_s):
    counted = Counter()
    for n in range(round(seconds / step_s)):
        counted.update(m.get_type() for m in source.due(n * step_s))
    return counted


# ---- what is sent when ----


def test_what_is_not_streamed_is_not_built_and_has_no_interval():
    assert telemetry().build(NUMBER["RAW_IMU"], 0.0) is None
    assert not telemetry().set_interval(NUMBER["RAW_IMU"], 1e5, 0.0).accepted
    assert telemetry().interval_us(NUMBER["RAW_IMU"]) == 0


@pytest.mark.parametrize("interval", [math.nan, -2.0, -0.5])
def test_what_is_no_interval_changes_nothing(interval):
    source = telemetry()
    assert not source.set_interval(NUMBER["ATTITUDE"], interval, 0.0).accepted
    assert count(source, 10.0, 0.001)["ATTITUDE"] == 1000


def test_before_the_first_reading_there_is_no_gas():
    assert telemetry(gas=None).build(NUMBER["NAMED_VALUE_FLOAT"], 0.0) is None
    assert "NAMED_VALUE_FLOAT" not in count(telemetry(gas=None), 1.0, 0.01)


def test_the_rates_are_those_of_px4s_onboard_link():
    counted = count(telemetry(), 10.0, 0.001)
    assert {name: n / 10.0 for name, n in counted.items()} == {
        "HEARTBEAT": 1.0,
        "SYS_STATUS": 5.0,
        "GPS_RAW_INT": 10.0,
        "GLOBAL_POSITION_INT": 50.0,
        "LOCAL_POSITION_NED": 30.0,
        "ATTITUDE": 100.0,
        "VFR_HUD": 10.0,
        "BATTERY_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "EXTENDED_SYS_STATE": 5.0,
        "WIND_COV": 10.0,
        "NAMED_VALUE_FLOAT": 10.0,
        "ALTITUDE": 10.0,
        "POSITION_TARGET_LOCAL_NED": 10.0,
        "ESTIMATOR_STATUS": 1.0,
        "SYSTEM_TIME": 1.0,
        "CURRENT_MODE": 0.5,
        "MISSION_CURRENT": 1.0,
    }


def test_waking_when_it_is_due_sends_at_the_same_rates():
    source, counted, now = telemetry(), Counter(), 0.0
    while now < 9.995:
        counted.update(m.get_type() for m in source.due(now))
        assert source.next_due_s() > now
        now = source.next_due_s()
    assert counted["ATTITUDE"] == 1000
    assert counted["LOCAL_POSITION_NED"] == 300


def test_slower_streams_go_with_the_fastest_one_at_their_own_rates():
    source, counted, wakes, now = telemetry(), Counter(), 0, 0.0
    for stream in STREAMS:
        if stream.rate_hz > 8.0:
            source.set_interval(stream.message_id, 125_000.0, 0.0)
    while now < 9.995:
        wakes += 1
        counted.update(m.get_type() for m in source.due(now))
        now = source.next_due_s()
    # 8 and 5 Hz coincide once a second only: apart they would be 12 wakes a second.
    assert (wakes, counted["ATTITUDE"], counted["SYS_STATUS"], counted["HEARTBEAT"]) == (80, 79, 50, 10)


def test_a_late_call_sends_one_of_each_and_does_not_catch_up():
    source = telemetry()
    source.due(0.0)
    late = Counter(m.get_type() for m in source.due(100.005))
    assert set(late.values()) == {1}
    assert source.due(100.006) == []
    assert source.next_due_s() == pytest.approx(100.01)


@given(st.lists(st.floats(0.0, 3.0), max_size=50))
def test_no_step_makes_it_send_twice_or_stall(steps):
    source, now = telemetry(), 0.0
    for step in steps:
        now += step
        assert all(n == 1 for n in Counter(m.get_type() for m in source.due(now)).values())
        assert now < source.next_due_s() <= now + 0.0101


def test_an_interval_may_be_changed_turned_off_and_set_back():
    source = telemetry()
    assert source.set_interval(NUMBER["HEARTBEAT"], 250_000.0, 0.0).accepted
    assert source.set_interval(NUMBER["ATTITUDE"], -1.0, 0.0).accepted
    assert source.set_interval(NUMBER["AUTOPILOT_VERSION"], 1e6, 0.0).accepted
    counted = count(source, 10.0, 0.001)
    assert (counted["HEARTBEAT"], counted["ATTITUDE"], counted["AUTOPILOT_VERSION"]) == (
        39,
        0,
        9,
    )  # from the next slot on
    for name in ("HEARTBEAT", "ATTITUDE", "AUTOPILOT_VERSION"):
        source.set_interval(NUMBER[name], 0.0, -1e-9)
    counted = count(source, 10.0, 0.001)
    assert (counted["HEARTBEAT"], counted["ATTITUDE"], counted["AUTOPILOT_VERSION"]) == (10, 1000, 0)


@pytest.mark.parametrize("interval", [-1.0, 1_000_001.0, 1e9, math.inf])
def test_the_heartbeat_can_neither_be_turned_off_nor_slowed_down(interval):
    source = telemetry()
    refused = source.set_interval(NUMBER["HEARTBEAT"], interval, 0.0)
    assert (refused.code, refused.reason) == (
        2,
        "Interval refused: HEARTBEAT has at most 1000000 us and stays on",
    )
    assert count(source, 10.0, 0.001)["HEARTBEAT"] == 10


def test_with_all_other_streams_off_only_the_heartbeat_is_due():
    source = telemetry()
    for stream in STREAMS:
        source.set_interval(stream.message_id, -1.0, 0.0)
    assert [m.get_type() for m in source.due(10.0)] == ["HEARTBEAT"]
    assert source.next_due_s() == 11.0


def test_the_interval_of_a_stream_is_told():
    source = telemetry()
    assert [source.interval_us(NUMBER[name]) for name in ("ATTITUDE", "BATTERY_STATUS", "ODOMETRY")] == [
        10_000,
        2_000_000,
        -1,
    ]
    source.set_interval(NUMBER["ODOMETRY"], 40_000.0, 0.0)
    assert source.interval_us(NUMBER["ODOMETRY"]) == 40_000


# ---- what it says ----


def test_a_heartbeat_is_that_of_a_px4_quadrotor():
    standing, flying = report("HEARTBEAT", AT_REST), report("HEARTBEAT")
    assert (standing.type, standing.autopilot) == (2, 12)
    assert (standing.base_mode & 128, standing.base_mode & 1, standing.system_status) == (0, 1, 3)
    assert (flying.base_mode & 128, flying.custom_mode, flying.system_status) == (128, 6 << 16, 4)
    assert report("HEARTBEAT", FLYING._replace(failsafe=True)).system_status == 5


def test_an_empty_battery_and_a_vehicle_unfit_to_fly_are_not_called_healthy():
    unfit = report("SYS_STATUS", AT_REST._replace(battery=0.0, fit=False))
    assert unfit.onboard_control_sensors_present & PREARM
    assert unfit.onboard_control_sensors_present & BATTERY
    assert unfit.onboard_control_sensors_health & (PREARM | BATTERY) == 0
    assert unfit.battery_remaining == 0


def test_health_covers_what_is_simulated_and_nothing_else():
    status = report("SYS_STATUS", AT_REST)
    for needed in (GYRO, ACCEL, MAG, GPS, BATTERY, PREARM):
        assert (
            status.onboard_control_sensors_present
            & status.onboard_control_sensors_enabled
            & status.onboard_control_sensors_health
            & needed
        )
    for absent in (
        0x8,
        0x10,
        0x40,
        0x80,
        0x10000,
        0x1000000,
    ):  # barometer, airspeed, optical flow, vision, receiver, logging
        assert not (status.onboard_control_sensors_present | status.onboard_control_sensors_health) & absent
    assert (status.battery_remaining, status.current_battery) == (100, -1)


@given(st.tuples(*[st.floats(-120.0, 120.0)] * 3))
def test_the_local_position_is_the_float32_position_bit_for_bit(position):
    told = report("LOCAL_POSITION_NED", FLYING._replace(position=position))
    in_process = telemetry(FLYING._replace(position=position)).build(NUMBER["LOCAL_POSITION_NED"], 12.5)
    assert struct.pack("<3f", *position) == struct.pack("<3f", told.x, told.y, told.z)
    assert (in_process.x, in_process.y, in_process.z) == (told.x, told.y, told.z)


def test_the_local_position_is_north_east_down_at_its_time():
    told = report("LOCAL_POSITION_NED")
    assert (told.time_boot_ms, told.x, told.y, told.z, told.vx, told.vy, told.vz) == (
        12_500,
        10.0,
        20.0,
        -5.0,
        3.0,
        4.0,
        -1.0,
    )


def test_the_global_position_is_in_its_units():
    told = report("GLOBAL_POSITION_INT")
    assert (told.alt, told.relative_alt, told.vx, told.vy, told.vz, told.hdg) == (
        493_000,
        5_000,
        300,
        400,
        -100,
        27_000,
    )
    degree = math.pi * 6_371_000.0 / 180.0
    assert (told.lat / 1e7 - CONFIG.home_lat_deg) * degree == pytest.approx(10.0, abs=0.02)
    assert (told.lon / 1e7 - CONFIG.home_lon_deg) * degree * math.cos(
        math.radians(CONFIG.home_lat_deg)
    ) == pytest.approx(20.0, abs=0.02)


def test_gps_claims_a_fix_but_no_accuracy():
    told, standing = report("GPS_RAW_INT"), report("GPS_RAW_INT", AT_REST)
    assert (told.fix_type, told.eph, told.epv, told.vel, told.time_usec) == (3, 65535, 65535, 500, 12_500_000)
    assert told.cog == round(math.degrees(math.atan2(4.0, 3.0)) * 100)
    assert (standing.vel, standing.cog) == (0, 65535)


def test_attitude_and_hud_point_the_same_way():
    turned = FLYING._replace(roll=0.1, pitch=-0.2, yaw=math.pi, yaw_rate=0.5)
    told, hud = report("ATTITUDE", turned), report("VFR_HUD", turned)
    assert (told.roll, told.pitch, told.yaw, told.yawspeed) == pytest.approx((0.1, -0.2, math.pi, 0.5))
    assert (hud.heading, hud.groundspeed, hud.climb, hud.alt) == (180, 5.0, 1.0, 493.0)
    assert report("VFR_HUD", FLYING._replace(yaw=-0.001)).heading == 0


def test_wind_is_told_as_the_airs_velocity():
    # From the north-east (x and y both positive), 2 m/s: the air moves to the south-west.
    wind = (2.0 * math.cos(math.pi / 4), 2.0 * math.sin(math.pi / 4))
    told = report("WIND_COV", wind=wind)
    assert (told.wind_x, told.wind_y, told.wind_z) == pytest.approx((-math.sqrt(2.0), -math.sqrt(2.0), 0.0))
    assert told.time_usec == 12_500_000
    east_wind = report("WIND_COV", wind=(3.0, 0.0))
    assert (east_wind.wind_x, east_wind.wind_y) == (0.0, -3.0)


def test_airspeed_is_the_speed_against_the_wind():
    # Flying east at 4 m/s into a 3 m/s wind from the east.
    east = FLYING._replace(velocity=(0.0, 4.0, 0.0))
    assert report("VFR_HUD", east, wind=(3.0, 0.0)).airspeed == pytest.approx(7.0)
    assert report("VFR_HUD", east, wind=(-3.0, 0.0)).airspeed == pytest.approx(1.0)


def test_position_wind_and_gas_of_one_time_make_a_reading():
    source, packer = telemetry(wind=(1.5, -0.5)), mavlink.MAVLink(None)
    frames = [
        source.build(NUMBER[name], 12.5).pack(packer)
        for name in ("LOCAL_POSITION_NED", "WIND_COV", "NAMED_VALUE_FLOAT")
    ]
    assert unpack_reading(b"".join(frames)) == Reading(12_500, (20.0, 10.0), 5.0, (1.5, -0.5), 0.25)


def test_a_gas_value_that_is_told_again_keeps_the_time_it_was_read_at():
    told = report("NAMED_VALUE_FLOAT", at_s=99.0, gas=(12_500, 0.25))
    assert (told.name, told.value, told.time_boot_ms) == ("gas", 0.25, 12_500)
    assert report("LOCAL_POSITION_NED", at_s=99.0).time_boot_ms == 99_000


def test_the_battery_tells_what_is_left():
    half, low, empty = (report("BATTERY_STATUS", FLYING._replace(battery=left)) for left in (0.5, 0.1, 0.0))
    assert (half.battery_remaining, half.time_remaining, half.current_battery, half.charge_state) == (
        50,
        900,
        -1,
        1,
    )
    assert half.voltages[:2] == [round(4 * (3.5 + 4.2) / 2 * 1000), 65535]
    assert (low.charge_state, empty.charge_state, empty.battery_remaining) == (2, 3, 0)
    assert report("BATTERY_STATUS", config=VehicleConfig(endurance_s=math.inf)).time_remaining == 0


def test_home_is_the_origin_of_the_local_frame():
    told = report("HOME_POSITION")
    assert (told.latitude, told.longitude, told.altitude) == (473_977_420, 85_455_940, 488_000)
    assert (told.x, told.y, told.z) == (0.0, 0.0, 0.0)
    assert told.q == pytest.approx([math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)])


def test_the_landed_state_and_the_version_are_told():
    assert report("EXTENDED_SYS_STATE").landed_state == 2
    version = report("AUTOPILOT_VERSION")
    assert version.flight_sw_version >> 16 >= 1 << 8 | 13  # stations warn of a PX4 before 1.13
    assert version.flight_sw_version & 0xFF == 0  # a development version: it is no release of PX4
    assert bytes(version.flight_custom_version) == b"\x00\x01\x00plume"  # 0.1.0, the last first
    assert bytes(version.uid2).startswith(b"plumeward")
    assert bytes(version.uid2)[-1] == version.uid == 1
    # SET_POSITION_TARGET_GLOBAL_INT is 256, and also:
    # PARAM_FLOAT, MISSION_INT, COMMAND_INT, PARAM_ENCODE_BYTEWISE, SET_POSITION_TARGET_LOCAL_NED, MAVLINK2,
    # MISSION_FENCE, MISSION_RALLY
    assert version.capabilities == 2 | 4 | 8 | 16 | 128 | 256 | 8192 | 16384 | 32768


# ---- the streams beyond PX4's common ones ----

TILTED = FLYING._replace(
    roll=0.3, pitch=-0.2, yaw=2.0, yaw_rate=0.5, acceleration=(1.0, -2.0, 0.5), target=(7.0, 8.0, -9.0)
)


def body_to_ned(state):
    """The rotation from body to NED, as a product of the three rotations about z, y and x."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (state.roll, state.pitch, state.yaw))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


def rotation(w, x, y, z):
    """The rotation matrix of a unit quaternion."""
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def test_the_quaternion_turns_the_body_as_the_angles_do():
    told = report("ATTITUDE_QUATERNION", TILTED)
    assert rotation(told.q1, told.q2, told.q3, told.q4) == pytest.approx(body_to_ned(TILTED), abs=1e-6)
    assert (told.rollspeed, told.pitchspeed, told.yawspeed) == (0.0, 0.0, 0.5)


def test_odometry_has_its_velocity_in_the_bodys_axes():
    told = report("ODOMETRY", TILTED)
    assert (told.frame_id, told.child_frame_id, told.x, told.y, told.z) == (1, 12, 10.0, 20.0, -5.0)
    assert (told.vx, told.vy, told.vz) == pytest.approx(
        tuple(body_to_ned(TILTED).T @ TILTED.velocity), abs=1e-6
    )
    assert rotation(*told.q) == pytest.approx(body_to_ned(TILTED), abs=1e-6)
    assert math.isnan(told.pose_covariance[0])  # unknown, not exact


def test_an_accelerometer_at_rest_feels_one_g_upwards_and_only_what_is_simulated_is_marked():
    rest, tilted = report("HIGHRES_IMU", AT_REST), report("HIGHRES_IMU", TILTED)
    assert (rest.xacc, rest.yacc, rest.zacc) == pytest.approx((0.0, 0.0, -9.80665))
    felt = body_to_ned(TILTED).T @ (np.array(TILTED.acceleration) - (0, 0, 9.80665))
    assert (tilted.xacc, tilted.yacc, tilted.zacc) == pytest.approx(tuple(felt), abs=1e-5)
    assert tilted.fields_updated == 1 | 2 | 4 | 32  # three accelerations and the yaw rate
    assert tilted.zgyro == 0.5


def test_altitude_is_above_sea_and_above_home():
    told = report("ALTITUDE")
    assert (told.altitude_amsl, told.altitude_local, told.altitude_relative) == (493.0, 5.0, 5.0)
    assert math.isnan(told.bottom_clearance)


def test_the_target_is_told_while_armed():
    told = report("POSITION_TARGET_LOCAL_NED", TILTED)
    assert (told.coordinate_frame, told.x, told.y, told.z) == (1, 7.0, 8.0, -9.0)
    assert told.type_mask & 0b111 == 0  # the position counts
    assert telemetry(TILTED._replace(armed=False)).build(NUMBER["POSITION_TARGET_LOCAL_NED"], 1.0) is None


def test_time_mode_and_estimator_are_told():
    assert (report("SYSTEM_TIME").time_boot_ms, report("SYSTEM_TIME").time_unix_usec) == (12_500, 0)
    assert (
        report("ESTIMATOR_STATUS").flags & 0b1111111 == 0b0111111
    )  # attitude, velocities, positions; not above ground
    mode = telemetry(FLYING._replace(mode=Mode.RETURN)).build(436, 1.0)
    packed = mode.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    custom, intended, standard = struct.unpack("<IIB", packed[10:19])
    assert (custom, intended, standard) == (4 << 16 | 5 << 24, 4 << 16 | 5 << 24, 5)


@pytest.mark.parametrize("at_s", [4_294_967.296, 9_000_000.25])
def test_every_message_tells_its_time_after_that_has_wrapped(at_s):
    assert report("LOCAL_POSITION_NED", at_s=at_s).time_boot_ms == round(at_s * 1000) % 2**32
    for name, number in NUMBER.items():
        if telemetry().build(number, at_s):
            report(name, at_s=at_s)  # it can be packed
