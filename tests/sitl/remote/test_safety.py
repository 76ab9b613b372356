"""Protects what people are told at the start: which failsafe acts if the program is killed."""

from sitl.remote.firmware import ARDUCOPTER, PX4
from sitl.remote.safety import Advice, advice


def only(said: list[Advice]) -> Advice:
    (line,) = said
    return line


def test_an_arducopter_that_would_hover_for_ever_gets_a_warning() -> None:
    line = only(advice(ARDUCOPTER, {"FS_GCS_ENABLE": 0.0, "SYSID_MYGCS": 255.0}, 1))
    assert line.warns
    assert "FS_GCS_ENABLE is 0" in line.text
    assert "hovers" in line.text


def test_a_failsafe_that_watches_a_ground_station_does_not_watch_us() -> None:
    for name in ("SYSID_MYGCS", "MAV_GCS_SYSID"):
        line = only(advice(ARDUCOPTER, {"FS_GCS_ENABLE": 1.0, name: 255.0}, 1))
        assert line.warns
        assert "watches system 255" in line.text


def test_a_failsafe_that_watches_us_is_told_with_its_time() -> None:
    line = only(advice(ARDUCOPTER, {"FS_GCS_ENABLE": 1.0, "SYSID_MYGCS": 7.0, "FS_GCS_TIMEOUT": 4.0}, 7))
    assert not line.warns
    assert "after 4 s" in line.text


def test_parameters_that_could_not_be_read_give_a_warning() -> None:
    assert only(advice(ARDUCOPTER, {}, 1)).warns
    assert only(advice(PX4, {}, 1)).warns


def test_px4_acts_when_the_setpoints_stop() -> None:
    line = only(advice(PX4, {"COM_OBL_RC_ACT": 3.0, "COM_OF_LOSS_T": 1.5, "NAV_DLL_ACT": 0.0, "COM_RCL_EXCEPT": 4.0}, 1))
    assert not line.warns
    assert "RETURN after 1.5 s" in line.text


def test_px4_that_will_not_arm_without_a_ground_station_gets_a_warning() -> None:
    said = advice(PX4, {"COM_OBL_RC_ACT": 0.0, "COM_OF_LOSS_T": 1.0, "NAV_DLL_ACT": 2.0, "COM_RCL_EXCEPT": 4.0}, 1)
    assert [line.warns for line in said] == [False, True]
    assert "without a pilot to RETURN" in said[0].text
    assert "NAV_DLL_ACT" in said[1].text
