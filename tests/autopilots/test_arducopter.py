"""Protects the ArduCopter double: it does what ArduCopter 4.6.3 was seen to do, also what surprises a
companion.
"""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.autopilot import ACCEPTED, DENIED, FAILED, REJECTED, UNSUPPORTED
from tests.autopilots.bench import POSITION, STATION, VELOCITY, Bench, heartbeat, target

SET_MODE, ARM, TAKE_OFF = (
    mavlink.MAV_CMD_DO_SET_MODE,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    mavlink.MAV_CMD_NAV_TAKEOFF,
)
STABILIZE, GUIDED, LOITER, RTL, LAND, BRAKE = (0,), (4,), (5,), (6,), (9,), (17,)
STREAMS = (32, 30, 33, 24, 193, 1, 245, 85)


def set_mode(bench: Bench, number: int) -> int | None:
    return bench.command(SET_MODE, 1, number)


def hovering(*faults: str, **settings: Any) -> Bench:
    """In GUIDED, 5 m above home, 60 s after boot."""
    bench = Bench("ardupilot", *faults, **settings)
    bench.run(45)
    assert [set_mode(bench, 4), bench.command(ARM, 1), bench.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5)] == [
        ACCEPTED
    ] * 3
    bench.ask(*STREAMS, hz=10)
    bench.run(60 - bench.wire.autopilot.now_s)
    return bench


def above_home(bench: Bench, north: float, east: float) -> tuple[float, float, float]:
    """A place 5 m above home, from the EKF's origin."""
    home = bench.home()
    return home[0] + north, home[1] + east, home[2] - 5.0


def test_only_heartbeats_stream_until_a_message_is_asked_for() -> None:
    bench = Bench("ardupilot")
    bench.run(60)
    assert {one.get_type() for _, one in bench.heard} == {"HEARTBEAT", "STATUSTEXT"}
    assert len(bench.all("HEARTBEAT")) == 60
    bench.ask(30, hz=4)
    bench.run(10)
    assert len(bench.all("ATTITUDE")) == pytest.approx(40, abs=1)


def test_a_message_that_it_does_not_know_cannot_be_asked_for() -> None:
    bench = Bench("ardupilot")
    assert bench.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 9999, 100000) == DENIED
    assert bench.command(mavlink.MAV_CMD_DO_ORBIT) == UNSUPPORTED


def test_the_local_position_and_flag_16_come_41_s_after_boot() -> None:
    bench = Bench("ardupilot")
    bench.ask(32, 193, hz=10)
    bench.run(50)
    first = next(at for at, one in bench.heard if one.get_type() == "LOCAL_POSITION_NED")
    good = next(at for at, one in bench.heard if one.get_type() == "EKF_STATUS_REPORT" and one.flags & 16)
    assert first == pytest.approx(41, abs=0.2)
    assert good == pytest.approx(41, abs=0.2)


def test_guided_and_arming_are_accepted_long_before_it_can_fly_and_take_off_is_refused() -> None:
    bench = Bench("ardupilot")
    bench.run(15)
    assert set_mode(bench, 4) == ACCEPTED
    assert bench.command(ARM, 1) == ACCEPTED
    assert bench.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5) == FAILED
    bench.run(11)
    assert not bench.armed


def test_arming_soon_after_boot_is_refused_with_a_reason() -> None:
    bench = Bench("ardupilot")
    bench.run(5)
    assert set_mode(bench, 4) == ACCEPTED
    assert bench.command(ARM, 1) == FAILED
    assert bench.texts == ["Arm: Need Position Estimate"]


def test_a_refusal_to_arm_says_why() -> None:
    bench = Bench("ardupilot", "arm:50")
    bench.run(45)
    assert bench.command(ARM, 1) == FAILED
    assert bench.texts[-1] == "Arm: Compass not healthy"
    bench.run(10)
    assert bench.command(ARM, 1) == ACCEPTED


def test_it_disarms_10_s_after_arming_without_take_off() -> None:
    bench = Bench("ardupilot")
    bench.run(45)
    set_mode(bench, 4)
    assert bench.command(ARM, 1) == ACCEPTED
    bench.run(9)
    assert bench.armed
    bench.run(2.1)
    assert not bench.armed


def test_the_local_origin_is_not_home_and_take_off_counts_from_home() -> None:
    bench = hovering(home=(3.0, 4.0, -2.0))
    assert bench.home() == (3.0, 4.0, -2.0)
    assert bench.at == pytest.approx((3.0, 4.0, -7.0), abs=0.15)
    assert bench.last("GLOBAL_POSITION_INT").relative_alt == pytest.approx(5000, abs=150)


def test_a_second_take_off_in_the_air_fails() -> None:
    assert hovering().command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5) == FAILED


def test_take_off_needs_guided_and_motors() -> None:
    bench = Bench("ardupilot")
    bench.run(45)
    assert bench.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5) == FAILED
    bench.command(ARM, 1)
    assert bench.mode == STABILIZE
    assert bench.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5) == FAILED


def test_a_step_of_1_m_takes_1_6_s_to_30_cm_and_2_s_to_10_cm() -> None:
    bench = hovering()
    bench.ask(32, hz=50)
    goal = above_home(bench, 1.0, 0.0)
    bench.send(target(goal))
    assert bench.run_until(lambda: math.dist(bench.at, goal) < 0.3) == pytest.approx(1.6, abs=0.15)
    assert 1.6 + bench.run_until(lambda: math.dist(bench.at, goal) < 0.1) == pytest.approx(2.0, abs=0.25)


def test_a_long_leg_overshoots_by_40_cm_and_comes_back() -> None:
    bench = hovering()
    goal = above_home(bench, 20.0, 0.0)
    bench.send(target(goal))
    bench.run(20)
    north = [one.x for one in bench.all("LOCAL_POSITION_NED")]
    assert max(north) - goal[0] == pytest.approx(0.4, abs=0.15)
    assert north[-1] == pytest.approx(goal[0], abs=0.1)


def test_the_target_can_be_read_back() -> None:
    bench = hovering()
    bench.send(target((4.0, 5.0, -6.0)))
    bench.run(0.2)
    said = bench.last("POSITION_TARGET_LOCAL_NED")
    assert (said.x, said.y, said.z, said.type_mask) == (4.0, 5.0, -6.0, POSITION)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("another system", target((9.0, 0.0, -5.0), system=7)),
        ("not a number", target((math.nan, 0.0, -5.0))),
    ],
)
def test_a_target_is_ignored_silently(words: str, message: object) -> None:
    bench = hovering()
    bench.send(target(above_home(bench, 0.0, 0.0)))
    bench.run(1)
    before, heard = bench.last("POSITION_TARGET_LOCAL_NED"), len(bench.heard)
    bench.send(message)
    bench.run(1)
    after = bench.last("POSITION_TARGET_LOCAL_NED")
    assert (after.x, after.y, after.z) == (before.x, before.y, before.z), words
    assert not {"COMMAND_ACK", "STATUSTEXT"} & {one.get_type() for _, one in bench.heard[heard:]}


def test_a_target_outside_guided_is_ignored_silently() -> None:
    bench = hovering()
    assert set_mode(bench, 17) == ACCEPTED
    said = len(bench.all("POSITION_TARGET_LOCAL_NED"))
    bench.send(target(above_home(bench, 9.0, 0.0)))
    bench.run(5)
    assert bench.mode == BRAKE
    assert math.dist(bench.at, above_home(bench, 0.0, 0.0)) < 0.3
    assert len(bench.all("POSITION_TARGET_LOCAL_NED")) <= said + 1


@pytest.mark.parametrize("mask", [POSITION | 1, POSITION | 4, 0x0FFF, POSITION & ~0x1C0])
def test_a_mask_without_all_three_axes_of_the_position_stops_the_vehicle(mask: int) -> None:
    bench = hovering()
    bench.send(target(above_home(bench, 30.0, 0.0)))
    bench.run(4)
    bench.send(target(above_home(bench, 30.0, 0.0), mask=mask))
    bench.run(6)
    assert bench.last("POSITION_TARGET_LOCAL_NED").type_mask & 7
    assert bench.at[0] < 20.0
    assert math.hypot(bench.last("LOCAL_POSITION_NED").vx, bench.last("LOCAL_POSITION_NED").vy) < 0.1


def test_a_velocity_lasts_3_s_and_a_position_lasts() -> None:
    bench = hovering()
    bench.send(target((1.0, 0.0, 0.0), mask=VELOCITY))
    bench.run(2.9)
    assert bench.last("LOCAL_POSITION_NED").vx == pytest.approx(1.0, abs=0.1)
    bench.run(4)
    assert bench.last("LOCAL_POSITION_NED").vx == pytest.approx(0.0, abs=0.05)
    goal = above_home(bench, 30.0, 0.0)
    bench.send(target(goal))
    bench.run(30)
    assert math.dist(bench.at, goal) < 0.2


def test_loiter_without_a_radio_descends_and_brake_and_guided_hold() -> None:
    for number, falls in ((5, True), (17, False), (4, False)):
        bench = hovering()
        assert set_mode(bench, number) == ACCEPTED
        bench.run(8)
        assert (bench.at[2] > bench.home()[2] - 0.5) is falls, number


def test_a_mode_is_set_by_number_and_unknown_ones_are_refused() -> None:
    bench = Bench("ardupilot")
    assert set_mode(bench, 99) == FAILED
    assert bench.command(SET_MODE, 0, 4) == DENIED
    assert set_mode(bench, 4) == ACCEPTED
    assert bench.mode == GUIDED


def test_rtl_comes_home_lands_and_disarms() -> None:
    bench = hovering()
    bench.send(target(above_home(bench, 10.0, -5.0)))
    bench.run(10)
    assert set_mode(bench, 6) == ACCEPTED
    bench.run_until(lambda: not bench.armed)
    assert math.dist(bench.at, bench.home()) < 0.3
    assert max(-one.z for one in bench.all("LOCAL_POSITION_NED")) > 14.0
    assert bench.last("EXTENDED_SYS_STATE").landed_state == 1


def test_disarming_in_the_air_is_refused_unless_forced() -> None:
    bench = hovering()
    assert bench.command(ARM, 0) == FAILED
    assert bench.command(ARM, 0, 21196) == ACCEPTED
    bench.run(3)
    assert bench.at[2] > bench.home()[2] - 0.2


def test_a_command_to_another_vehicle_gets_no_answer() -> None:
    assert Bench("ardupilot").command(SET_MODE, 1, 4, target=9) is None


def test_a_busy_autopilot_rejects_for_now_and_a_slow_one_says_so_first() -> None:
    bench = Bench("ardupilot", "busy:2", "progress@2")
    assert set_mode(bench, 4) == REJECTED
    bench.run(2)
    assert set_mode(bench, 4) == mavlink.MAV_RESULT_IN_PROGRESS
    bench.run(1.1)
    assert bench.last("COMMAND_ACK").result == ACCEPTED


def test_the_wind_reads_0_until_it_flies_and_always_without_the_model_of_its_drag() -> None:
    for parameters, speed in (({}, 0.0), ({"EK3_DRAG_MCOEF": 0.2}, 4.0)):
        bench = hovering(parameters=parameters, wind=(90.0, 4.0))
        assert bench.all("WIND") == []
        bench.ask(168)
        bench.run(1)
        assert bench.last("WIND").speed == speed
    bench = Bench("ardupilot", parameters={"EK3_DRAG_MCOEF": 0.2}, wind=(90.0, 4.0))
    bench.ask(168)
    bench.run(1)
    assert (bench.last("WIND").direction, bench.last("WIND").speed) == (-180.0, 0.0)


def test_the_station_failsafe_watches_the_configured_station_alone() -> None:
    quiet = hovering(parameters={"FS_GCS_ENABLE": 1})
    quiet.run(20)
    assert quiet.mode == GUIDED  # a station that was never heard is not missed
    bench = hovering(parameters={"FS_GCS_ENABLE": 1})
    bench.send(heartbeat(), system=STATION)
    for _ in range(4):
        bench.send(heartbeat())  # a companion does not count
        bench.run(1)
    assert bench.mode == GUIDED
    bench.run(2)
    assert bench.mode == RTL
    assert "GCS Failsafe" in bench.texts


def test_parameters_are_floats_that_can_be_set() -> None:
    bench = Bench("ardupilot")
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"FS_GCS_ENABLE", 5.0, 9))
    bench.run(0.1)
    assert (bench.last("PARAM_VALUE").param_id, bench.last("PARAM_VALUE").param_value) == (
        "FS_GCS_ENABLE",
        5.0,
    )


def test_the_same_seed_and_the_same_messages_give_the_same_bytes() -> None:
    def frames(seed: int) -> list[bytes]:
        bench = hovering("drop@60:5", "gps@63", seed=seed)
        bench.run(15)
        return [bytes(one.get_msgbuf()) for _, one in bench.heard]

    first = frames(0)
    assert first == frames(0)
    assert first != frames(1)
