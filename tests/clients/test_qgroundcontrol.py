"""Protects the vehicle against QGroundControl: its start, its sliders and buttons, its plans, as scripts
of its requests.
"""

import math
from collections.abc import Callable, Iterator

import pytest
from pymavlink.dialects.v20 import development as mavlink

from link.modes import Mode
from tests.clients.qgroundcontrol import FENCE, MISSION, RALLY, QGroundControl, place, polygon, same, waypoint

ACCEPTED, UNSUPPORTED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_UNSUPPORTED
PROTOCOL_VERSION, COMPONENT_INFORMATION, COMPONENT_METADATA = 300, 395, 397
TAKE_OFF, WAYPOINT, LAND = mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_NAV_LAND
ARM, REPOSITION = mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_DO_REPOSITION
AUTO_MISSION = 4 << 16 | 4 << 24
INCLUSION, EXCLUSION, RALLY_POINT = 5001, 5002, 5100
STREAMS = {
    "ALTITUDE",
    "ATTITUDE",
    "BATTERY_STATUS",
    "ESTIMATOR_STATUS",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "GPS_RAW_INT",
    "HEARTBEAT",
    "HOME_POSITION",
    "LOCAL_POSITION_NED",
    "SYS_STATUS",
    "VFR_HUD",
    "WIND_COV",
}
"""What it shows on its instruments."""


@pytest.fixture
def station(vehicle: Callable[..., int]) -> Iterator[Callable[..., QGroundControl]]:
    """Start a station and a vehicle that it hears."""
    opened: list[QGroundControl] = []

    def begin(*words: str) -> QGroundControl:
        opened.append(QGroundControl())
        vehicle(*words, port=opened[0].port)
        opened[0].until("HEARTBEAT")
        return opened[0]

    yield begin
    for each in opened:
        each.socket.close()


def arm_and_climb(station: QGroundControl, up_m: float) -> None:
    """The take-off slider: a take-off to an altitude above sea while disarmed; once accepted, arming."""
    ground_m = station.until("ALTITUDE").altitude_amsl
    assert station.command(TAKE_OFF, -1, 0, 0, math.nan, math.nan, math.nan, ground_m + up_m) == ACCEPTED
    assert station.command(ARM, 1) == ACCEPTED
    station.until("ALTITUDE", lambda altitude: altitude.altitude_relative > up_m - 0.3)


def until_there(station: QGroundControl, north_m: float, east_m: float, up_m: float) -> None:
    station.until(
        "LOCAL_POSITION_NED", lambda at: math.dist((at.x, at.y, at.z), (north_m, east_m, -up_m)) < 0.5
    )


def test_qgroundcontrol_comes_to_the_end_of_its_start_without_waiting_once(
    station: Callable[..., QGroundControl],
) -> None:
    ground = station()
    _, version = ground.request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert version.flight_sw_version >> 8 >= 0x010401  # an older PX4 gets a warning
    for name in (
        "MISSION_INT",
        "COMMAND_INT",
        "MISSION_FENCE",
        "MISSION_RALLY",
        "MAVLINK2",
        "SET_POSITION_TARGET_LOCAL_NED",
    ):
        assert version.capabilities & getattr(mavlink, f"MAV_PROTOCOL_CAPABILITY_{name}"), name
    ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 0)
    modes = [ground.until("AVAILABLE_MODES")]
    modes += [ground.until("AVAILABLE_MODES") for _ in range(1, modes[0].number_modes)]
    assert [mode.mode_index for mode in modes] == list(range(1, len(modes) + 1))
    assert AUTO_MISSION in {mode.custom_mode for mode in modes}
    for message_id in (COMPONENT_METADATA, COMPONENT_INFORMATION):
        assert ground.request(message_id)[0] == UNSUPPORTED
    assert ground.request(PROTOCOL_VERSION)[0] == ACCEPTED
    parameters = ground.parameters()
    assert parameters.checksum == parameters.computed
    assert parameters.values["MAV_SYS_ID"] == 1
    for kind in (MISSION, FENCE, RALLY):
        assert ground.download(kind) == []


@pytest.mark.full
def test_qgroundcontrol_hears_all_that_its_instruments_show(station: Callable[..., QGroundControl]) -> None:
    ground, missing = station("--speedup", "4"), set(STREAMS)
    assert ground.wait(lambda message: missing.discard(message.get_type()) or not missing), missing
    beat = ground.until("HEARTBEAT")
    assert (beat.autopilot, beat.type) == (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_TYPE_QUADROTOR)


def test_qgroundcontrol_takes_off_with_its_slider_goes_to_pauses_climbs_and_returns(
    station: Callable[..., QGroundControl],
) -> None:
    ground = station("--speedup", "4")
    arm_and_climb(ground, 6)
    sea_m = ground.until("ALTITUDE").altitude_amsl
    global_frame, change_mode, nan = (
        mavlink.MAV_FRAME_GLOBAL,
        mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE,
        math.nan,
    )
    assert (
        ground.command_int(REPOSITION, global_frame, -1, change_mode, 0, nan, *place(12, 9), sea_m)
        == ACCEPTED
    )
    until_there(ground, 12, 9, 6)
    assert (
        ground.command_int(REPOSITION, global_frame, -1, change_mode, 0, nan, *place(2, 9), sea_m) == ACCEPTED
    )
    ground.until("LOCAL_POSITION_NED", lambda at: at.vx < -1)
    assert ground.command(REPOSITION, -1, change_mode, 0, nan, nan, nan, nan) == ACCEPTED  # pause
    stopped = ground.until("LOCAL_POSITION_NED", lambda at: abs(at.vx) < 0.05)
    assert 2.5 < stopped.x < 12
    assert (
        ground.command(REPOSITION, -1, change_mode, 0, nan, nan, nan, sea_m + 2) == ACCEPTED
    )  # change altitude
    until_there(ground, stopped.x, stopped.y, 8)
    ground.set_mode(Mode.RETURN.custom_mode)
    until_there(ground, 0, 0, 0)
    ground.until("HEARTBEAT", lambda beat: not beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)


def test_qgroundcontrol_sets_a_parameter_and_sees_why_another_value_is_refused(
    station: Callable[..., QGroundControl],
) -> None:
    ground = station()
    assert ground.set_parameter("MIS_TAKEOFF_ALT", 7.5) == 7.5
    assert ground.set_parameter("MIS_TAKEOFF_ALT", 1000) == 7.5
    ground.until_said("allowed is 0.5 to 80 m")
    parameters = ground.parameters()
    assert parameters.values["MIS_TAKEOFF_ALT"] == 7.5
    assert parameters.checksum == parameters.computed


def test_qgroundcontrol_uploads_a_plan_starts_it_and_follows_it_to_its_end(
    station: Callable[..., QGroundControl],
) -> None:
    ground = station("--speedup", "6")
    plan = [
        waypoint(TAKE_OFF, 0, 0, 5),
        waypoint(WAYPOINT, 8, 6, 6),
        waypoint(WAYPOINT, 10, 14, 6),
        waypoint(LAND, 10, 14, 0),
    ]
    assert ground.upload(MISSION, plan) == mavlink.MAV_MISSION_ACCEPTED
    assert same(ground.download(MISSION), plan)
    ground.set_mode(AUTO_MISSION)
    assert ground.command(ARM, 1) == ACCEPTED
    for number in (1, 2):
        ground.until("MISSION_CURRENT", lambda current, number=number: current.seq == number)
    ground.until("HEARTBEAT", lambda beat: not beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    until_there(ground, 10, 14, 0)
    assert ground.clear(MISSION) == mavlink.MAV_MISSION_ACCEPTED
    assert ground.download(MISSION) == []


@pytest.mark.full
def test_qgroundcontrol_draws_a_fence_that_the_vehicle_keeps(station: Callable[..., QGroundControl]) -> None:
    ground = station("--speedup", "4")
    fence = [
        *polygon(INCLUSION, (-20, -20), (-20, 40), (40, 40), (40, -20)),
        *polygon(EXCLUSION, (10, 10), (10, 14), (14, 14), (14, 10)),
    ]
    assert ground.upload(FENCE, fence) == mavlink.MAV_MISSION_ACCEPTED
    assert same(ground.download(FENCE), fence)
    arm_and_climb(ground, 5)
    sea_m = ground.until("ALTITUDE").altitude_amsl
    forbidden = ground.command_int(
        REPOSITION,
        mavlink.MAV_FRAME_GLOBAL,
        -1,
        mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE,
        0,
        math.nan,
        *place(12, 12),
        sea_m,
    )
    assert forbidden == mavlink.MAV_RESULT_DENIED
    ground.until_said("fence")
    assert ground.clear(FENCE) == mavlink.MAV_MISSION_ACCEPTED


@pytest.mark.full
def test_qgroundcontrol_returns_to_the_nearest_of_its_rally_points(
    station: Callable[..., QGroundControl],
) -> None:
    ground = station("--speedup", "4")
    points = [waypoint(RALLY_POINT, 16, 16, 5), waypoint(RALLY_POINT, 4, 16, 5)]
    assert ground.upload(RALLY, points) == mavlink.MAV_MISSION_ACCEPTED
    assert same(ground.download(RALLY), points)
    arm_and_climb(ground, 5)
    sea_m = ground.until("ALTITUDE").altitude_amsl
    change_mode = mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
    ground.command_int(
        REPOSITION, mavlink.MAV_FRAME_GLOBAL, -1, change_mode, 0, math.nan, *place(12, 12), sea_m
    )
    until_there(ground, 12, 12, 5)
    ground.set_mode(Mode.RETURN.custom_mode)
    until_there(ground, 16, 16, 0)


@pytest.mark.full
def test_qgroundcontrol_is_refused_what_the_vehicle_lacks(station: Callable[..., QGroundControl]) -> None:
    ground = station()
    for name in (
        "REQUEST_STORAGE_INFORMATION",
        "REQUEST_CAMERA_INFORMATION",
        "PREFLIGHT_CALIBRATION",
        "PREFLIGHT_REBOOT_SHUTDOWN",
        "DO_SET_ROI_LOCATION",
        "DO_ORBIT",
    ):
        assert ground.command(getattr(mavlink, f"MAV_CMD_{name}")) == UNSUPPORTED, name
