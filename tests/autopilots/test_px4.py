"""Protects the PX4 double: it does what PX4 1.15 is known to do towards a companion."""

import math
import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.autopilot import ACCEPTED, REJECTED
from tests.autopilots.bench import STATION, Bench, heartbeat, target

SET_MODE, ARM, TAKE_OFF = (
    mavlink.MAV_CMD_DO_SET_MODE,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    mavlink.MAV_CMD_NAV_TAKEOFF,
)
POSCTL, HOLD, RTL, LAND, OFFBOARD = (3, 0), (4, 3), (4, 5), (4, 6), (6, 0)
HOME = (1.2, -0.7, -0.4)
ABOVE = (HOME[0], HOME[1], HOME[2] - 5.0)


def offboard(bench: Bench) -> int | None:
    return bench.command(SET_MODE, 129, 6, 0)


def ready(*faults: str, **settings: Any) -> Bench:
    """On the ground with a position, 20 s after boot."""
    bench = Bench("px4", *faults, **settings)
    bench.run(20)
    return bench


def flying(*faults: str, **settings: Any) -> Bench:
    """In OFFBOARD, 5 m above home, 35 s after boot; targets come at about 17 Hz."""
    bench = ready(*faults, **settings)
    bench.stream = target(ABOVE)
    bench.run(2)
    assert [offboard(bench), bench.command(ARM, 1)] == [ACCEPTED, ACCEPTED]
    bench.run(35 - bench.wire.autopilot.now_s)
    return bench


def test_telemetry_streams_unasked() -> None:
    bench = ready()
    assert {"HEARTBEAT", "LOCAL_POSITION_NED", "ATTITUDE", "EXTENDED_SYS_STATE", "SYS_STATUS"} <= {
        one.get_type() for _, one in bench.heard
    }
    assert bench.last("HEARTBEAT").autopilot == mavlink.MAV_AUTOPILOT_PX4


def test_before_the_ekf_is_ready_arming_is_refused_and_the_local_position_is_zero() -> None:
    bench = Bench("px4")
    bench.run(5)
    assert bench.command(ARM, 1) == REJECTED
    assert bench.texts == [
        "Preflight Fail: ekf2 missing data",
        "Arming denied: Resolve system health failures first",
    ]
    assert bench.at == (0.0, 0.0, 0.0)


def test_offboard_takes_off_while_targets_come() -> None:
    bench = flying()
    assert bench.mode == OFFBOARD
    assert bench.at == pytest.approx(ABOVE, abs=0.15)
    assert bench.last("EXTENDED_SYS_STATE").landed_state == mavlink.MAV_LANDED_STATE_IN_AIR


def test_arming_into_offboard_needs_targets_faster_than_2_hz_for_a_second() -> None:
    bench = ready()
    assert offboard(bench) == ACCEPTED  # disarmed, any mode is
    assert bench.command(ARM, 1) == REJECTED
    for _ in range(4):
        bench.send(target(ABOVE))
        bench.run(0.7)
    assert bench.command(ARM, 1) == REJECTED
    bench.stream = target(ABOVE)
    bench.run(0.5)
    assert bench.command(ARM, 1) == REJECTED
    bench.run(1)
    assert bench.command(ARM, 1) == ACCEPTED


def test_offboard_in_the_air_is_refused_without_targets() -> None:
    bench = flying()
    assert bench.command(SET_MODE, 129, 4, 3) == ACCEPTED
    assert bench.mode == HOLD
    bench.stream = None
    bench.run(2)
    assert offboard(bench) == REJECTED
    assert bench.texts[-1] == "Switching to Offboard is currently not available"


@pytest.mark.parametrize(("action", "mode"), [(0, RTL), (3, RTL), (4, LAND), (5, HOLD)])
def test_without_targets_it_does_what_com_obl_rc_act_says(action: int, mode: tuple[int, int]) -> None:
    bench = flying(parameters={"COM_OBL_RC_ACT": action})
    bench.stream = None
    bench.run(0.8)
    assert bench.mode == OFFBOARD
    bench.run(0.5)
    assert bench.mode == mode  # Position needs a radio: without, it returns
    assert "Failsafe activated" in bench.texts


def test_targets_that_come_again_bring_offboard_back_unless_another_mode_was_chosen() -> None:
    for chosen in (False, True):
        bench = flying(parameters={"COM_OBL_RC_ACT": 5})
        bench.stream = None
        bench.run(3)
        assert bench.mode == HOLD
        if chosen:
            bench.command(SET_MODE, 129, 4, 3)
        bench.stream = target(ABOVE)
        bench.run(3)
        assert bench.mode == (HOLD if chosen else OFFBOARD)


def test_with_a_radio_it_falls_back_to_position_mode_and_com_of_loss_t_says_when() -> None:
    bench = flying(radio=True, parameters={"COM_OF_LOSS_T": 3.0})
    bench.stream = None
    bench.run(2.7)
    assert bench.mode == OFFBOARD
    bench.run(0.5)
    assert bench.mode == POSCTL


@pytest.mark.parametrize(("exceptions", "stays"), [(0, False), (4, True)])
def test_a_lost_radio_ends_offboard_unless_com_rcl_except_has_the_bit_of_value_4(
    exceptions: int, stays: bool
) -> None:
    bench = flying("rc@40", radio=True, parameters={"COM_RCL_EXCEPT": exceptions})
    bench.run(6)
    assert bench.mode == (OFFBOARD if stays else HOLD)
    bench.run(5)
    assert bench.mode == (OFFBOARD if stays else RTL)


def test_with_nav_dll_act_it_does_not_arm_without_a_station() -> None:
    bench = ready(parameters={"NAV_DLL_ACT": 2})
    bench.send(heartbeat())  # a companion is not a station
    bench.run(1)
    assert bench.command(ARM, 1) == REJECTED
    assert "Preflight Fail: No connection to the ground control station" in bench.texts
    bench.send(heartbeat(mavlink.MAV_TYPE_GCS), system=STATION)
    bench.run(1)
    assert bench.command(ARM, 1) == ACCEPTED


def test_take_off_is_told_the_altitude_above_sea_level() -> None:
    bench = ready()
    bench.command(ARM, 1)
    assert (
        bench.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5.0) == ACCEPTED
    )  # meant above home: 483 m below the ground
    assert "Already higher than takeoff altitude" in bench.texts
    bench.run(12)
    assert not bench.armed
    bench.command(ARM, 1)
    ground_m = bench.last("GLOBAL_POSITION_INT").alt / 1000.0
    assert bench.command(TAKE_OFF, 0, 0, 0, math.nan, math.nan, math.nan, ground_m + 5.0) == ACCEPTED
    bench.run(10)
    assert bench.at[2] == pytest.approx(HOME[2] - 5.0, abs=0.3)
    assert bench.mode == HOLD


def test_land_and_return_end_on_the_ground_disarmed() -> None:
    for command, place in (
        (mavlink.MAV_CMD_NAV_LAND, (8.0, 3.0)),
        (mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, HOME[:2]),
    ):
        bench = flying()
        bench.stream = target((8.0, 3.0, ABOVE[2]))
        bench.run(10)
        assert bench.command(command) == ACCEPTED
        bench.run_until(lambda bench=bench: not bench.armed)
        assert bench.at[:2] == pytest.approx(place, abs=0.4)


def test_unset_fields_of_the_target_and_the_wind_are_nan() -> None:
    bench = flying()
    said = bench.last("POSITION_TARGET_LOCAL_NED")
    assert (said.x, said.y, said.z) == pytest.approx(ABOVE)
    assert all(map(math.isnan, (said.vx, said.vy, said.vz, said.afx, said.yaw, said.yaw_rate)))
    assert math.isnan(bench.last("WIND_COV").wind_z)


def test_without_gps_the_position_flows_on_and_it_comes_down() -> None:
    bench = flying("gps@40")
    bench.run(12)
    assert not bench.last("ESTIMATOR_STATUS").flags & 16
    assert bench.mode == LAND
    before = len(bench.all("LOCAL_POSITION_NED"))
    bench.run(2)
    assert len(bench.all("LOCAL_POSITION_NED")) > before
    bench.run_until(lambda: not bench.armed)


def test_a_pilot_a_battery_and_a_fence_change_the_mode() -> None:
    for fault, mode in (("pilot@36", POSCTL), ("critical@36", RTL), ("fence@36", HOLD)):
        bench = flying(fault)
        bench.run(8)
        assert bench.mode == mode, fault


def test_an_integer_parameter_travels_as_its_bytes() -> None:
    bench = ready()
    (as_float,) = struct.unpack("<f", struct.pack("<i", 4))
    bench.send(
        mavlink.MAVLink_param_set_message(1, 1, b"COM_RCL_EXCEPT", as_float, mavlink.MAV_PARAM_TYPE_INT32)
    )
    bench.run(0.1)
    said = bench.last("PARAM_VALUE")
    assert said.param_type == mavlink.MAV_PARAM_TYPE_INT32
    assert struct.pack("<f", said.param_value) == struct.pack("<i", 4)
    assert bench.wire.autopilot.parameters["COM_RCL_EXCEPT"] == 4.0
