"""Protects the faults of the doubles: each strikes when it is told to, and ends as on the real autopilot."""

import subprocess
import sys

import pytest

from tests.autopilots.autopilot import ACCEPTED, FAILED
from tests.autopilots.bench import Bench, target
from tests.autopilots.faults import FAULTS, fault
from tests.autopilots.test_arducopter import (
    ARM,
    GUIDED,
    LAND,
    LOITER,
    RTL,
    STABILIZE,
    TAKE_OFF,
    above_home,
    hovering,
    set_mode,
)


def test_without_gps_the_position_flows_on_the_flags_drop_and_it_lands() -> None:
    bench = hovering("gps@65")
    bench.run(8)
    assert bench.last("GPS_RAW_INT").fix_type < 3
    assert bench.last("EKF_STATUS_REPORT").flags & 16
    bench.run(4)
    assert not bench.last("EKF_STATUS_REPORT").flags & 16
    assert bench.last("EKF_STATUS_REPORT").flags & 128
    assert bench.mode == LAND
    before = len(bench.all("LOCAL_POSITION_NED"))
    bench.run(2)
    assert len(bench.all("LOCAL_POSITION_NED")) == before + 20
    bench.run_until(lambda: not bench.armed)


def test_gps_that_comes_back_in_time_changes_nothing() -> None:
    bench = hovering("gps@65:3")
    bench.run(15)
    assert bench.mode == GUIDED


def test_a_failed_ekf_lands_and_guided_is_refused() -> None:
    bench = hovering("ekf@65")
    bench.run(7)
    assert bench.last("EKF_STATUS_REPORT").velocity_variance > 1.0
    assert bench.mode == LAND
    assert "EKF Failsafe: changed to LAND Mode" in bench.texts
    assert set_mode(bench, 4) == FAILED
    assert bench.texts[-1] == "Mode change to GUIDED failed: requires position"


@pytest.mark.parametrize(("name", "mode", "volts"), [("low", RTL, 10.4), ("critical", LAND, 9.9)])
def test_a_low_battery_brings_it_home_and_a_critical_one_down(
    name: str, mode: tuple[int], volts: float
) -> None:
    bench = hovering(f"{name}@+20")
    bench.run(20)
    assert bench.mode == mode
    assert bench.last("SYS_STATUS").voltage_battery == pytest.approx(volts * 1000, abs=20)
    assert "Battery Failsafe" in bench.texts


def test_a_pilot_takes_over_with_the_third_target_and_holds() -> None:
    bench = hovering("pilot@#3:LOITER")
    for north in (1.0, 2.0):
        bench.send(target(above_home(bench, north, 0.0)))
        bench.send(target(above_home(bench, north, 0.0)))  # the same again is not another
        bench.run(3)
    assert bench.mode == GUIDED
    bench.send(target(above_home(bench, 3.0, 0.0)))
    bench.run(10)
    assert bench.mode == LOITER
    assert bench.at[2] == pytest.approx(bench.home()[2] - 5.0, abs=0.3)


def test_a_fence_is_breached_by_a_fault() -> None:
    bench = hovering("fence@65")
    bench.run(7)
    assert bench.mode == RTL
    assert "Circle breached" in bench.texts


def test_a_target_outside_the_fence_is_ignored() -> None:
    bench = hovering(parameters={"FENCE_ENABLE": 1, "FENCE_RADIUS": 20})
    bench.send(target(above_home(bench, 25.0, 0.0)))
    bench.run(15)
    assert bench.mode == GUIDED
    assert bench.at[0] < bench.home()[0] + 1.0


def test_take_off_is_refused_or_does_not_happen() -> None:
    for name, result in (("takeoff", FAILED), ("stuck", ACCEPTED)):
        bench = Bench("ardupilot", name)
        bench.run(45)
        set_mode(bench, 4)
        bench.command(ARM, 1)
        assert bench.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, 5) == result
        bench.run(12)
        assert not bench.armed


def test_guided_can_be_refused_and_targets_ignored() -> None:
    bench = Bench("ardupilot", "mode")
    assert set_mode(bench, 4) == FAILED
    bench = hovering("ignore")
    bench.send(target(above_home(bench, 9.0, 0.0)))
    bench.run(5)
    assert bench.at[0] < bench.home()[0] + 0.3


def test_a_silent_link_carries_nothing_either_way_and_the_vehicle_flies_on() -> None:
    bench = hovering("silence@65:15")
    far, near = above_home(bench, 30.0, 0.0), above_home(bench, 0.0, 0.0)
    bench.send(target(far))
    bench.run(65.1 - bench.wire.autopilot.now_s)
    before = len(bench.heard)
    bench.send(target(near))
    bench.run(14.8)
    assert len(bench.heard) == before
    bench.run(1)
    assert bench.at == pytest.approx(far, abs=0.2)


@pytest.mark.parametrize("percent", [5, 30])
def test_a_share_of_the_frames_is_lost(percent: int) -> None:
    bench = Bench("ardupilot", f"drop@2:{percent}")
    for _ in range(20):  # until one of the requests got through
        bench.command(511, 30, 20000)
    began, before = bench.wire.autopilot.now_s, len(bench.all("ATTITUDE"))
    bench.run(100)
    sent = (bench.wire.autopilot.now_s - began) * 50
    assert (len(bench.all("ATTITUDE")) - before) / sent == pytest.approx(1.0 - percent / 100.0, abs=0.03)


def test_after_a_reboot_the_clock_is_at_0_and_nothing_streams() -> None:
    bench = hovering("reboot@62")
    bench.run(10)
    assert bench.mode == STABILIZE
    assert not bench.armed
    heard = len(bench.heard)
    bench.run(5)
    assert {one.get_type() for _, one in bench.heard[heard:]} == {"HEARTBEAT"}


@pytest.mark.parametrize("text", ["gone", "gps@soon", "drop:many", "gps@+5:long"])
def test_a_wrong_fault_is_refused_with_one_line(text: str) -> None:
    with pytest.raises(ValueError, match="must be") as error:
        fault(text)
    assert "\n" not in str(error.value)


def test_the_help_lists_every_fault() -> None:
    said = subprocess.run(
        [sys.executable, "-m", "tests.autopilots", "--help"],
        capture_output=True,
        text=True,
        check=True,
        timeout=400,
    )
    assert all(f"\n  {name} " in said.stdout for name in FAULTS)
