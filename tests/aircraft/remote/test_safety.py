"""Protects what people are told of the autopilot's parameters: what acts if the program is killed or the
battery low, and the fence.
"""

import math

import pytest

from aircraft.firmware import ARDUCOPTER, PX4
from aircraft.remote.safety import Check, Verdict, checks

HOVERS = {"FS_GCS_ENABLE": 0.0, "SYSID_MYGCS": 255.0}
RETURNS = {"COM_OBL_RC_ACT": 3.0, "COM_OF_LOSS_T": 1.5, "NAV_DLL_ACT": 0.0, "COM_RCL_EXCEPT": 4.0}


def said(firmware, parameters: dict[str, float], system: int = 1) -> dict[str, Check]:
    return {line.about: line for line in checks(firmware, parameters, system, math.hypot(30.0, 30.0), 5.0)}


def if_killed(firmware, parameters: dict[str, float], system: int = 1) -> Check:
    return said(firmware, parameters, system)["if this computer fails"]


def test_an_arducopter_that_would_hover_for_ever_gets_a_warning() -> None:
    line = if_killed(ARDUCOPTER, HOVERS)
    assert line.verdict is Verdict.WARNS
    assert "FS_GCS_ENABLE is 0" in line.text
    assert "hovers" in line.text


def test_a_failsafe_that_watches_a_ground_station_does_not_watch_us() -> None:
    for name in ("SYSID_MYGCS", "MAV_GCS_SYSID"):
        line = if_killed(ARDUCOPTER, {"FS_GCS_ENABLE": 1.0, name: 255.0})
        assert line.verdict is Verdict.WARNS
        assert "watches system 255" in line.text


def test_a_failsafe_that_watches_us_is_told_with_its_time() -> None:
    line = if_killed(ARDUCOPTER, {"FS_GCS_ENABLE": 1.0, "SYSID_MYGCS": 7.0, "FS_GCS_TIMEOUT": 4.0}, 7)
    assert line.verdict is Verdict.OK
    assert "after 4 s" in line.text


@pytest.mark.parametrize(
    ("highest", "verdict"),
    [(0.0, Verdict.WARNS), (6.0, Verdict.WARNS), (7.0, Verdict.OK), (250.0, Verdict.OK)],
)
def test_arducopter_4_7_may_watch_a_range_of_systems(highest: float, verdict: Verdict) -> None:
    """From MAV_GCS_SYSID to MAV_GCS_SYSID_HI; a HI below the first means the first alone."""
    assert (
        if_killed(
            ARDUCOPTER, {"FS_GCS_ENABLE": 1.0, "MAV_GCS_SYSID": 5.0, "MAV_GCS_SYSID_HI": highest}, 7
        ).verdict
        is verdict
    )


def test_parameters_that_could_not_be_read_give_a_warning() -> None:
    for firmware in (ARDUCOPTER, PX4):
        assert {line.verdict for line in said(firmware, {}).values()} == {Verdict.WARNS}


def test_px4_acts_when_the_setpoints_stop() -> None:
    line = if_killed(PX4, RETURNS)
    assert line.verdict is Verdict.OK
    assert "RETURN after 1.5 s" in line.text


def test_px4_that_will_not_arm_without_a_ground_station_gets_a_warning() -> None:
    lines = said(PX4, {**RETURNS, "COM_OBL_RC_ACT": 0.0, "NAV_DLL_ACT": 2.0})
    assert "without a pilot to RETURN" in lines["if this computer fails"].text
    assert lines["ground station"].verdict is Verdict.WARNS
    assert "NAV_DLL_ACT" in lines["ground station"].text


@pytest.mark.parametrize(
    ("firmware", "name", "value", "verdict", "text"),
    [
        (ARDUCOPTER, "BATT_FS_LOW_ACT", 0.0, Verdict.WARNS, "BATT_FS_LOW_ACT is 0: the autopilot only warns"),
        (ARDUCOPTER, "BATT_FS_LOW_ACT", 2.0, Verdict.OK, "changes to RTL"),
        (ARDUCOPTER, "BATT_FS_LOW_ACT", 1.0, Verdict.OK, "changes to LAND"),
        (PX4, "COM_LOW_BAT_ACT", 0.0, Verdict.WARNS, "COM_LOW_BAT_ACT is 0: the autopilot only warns"),
        (PX4, "COM_LOW_BAT_ACT", 3.0, Verdict.OK, "changes to RETURN"),
    ],
)
def test_what_the_autopilot_does_on_low_battery_is_told(
    firmware, name: str, value: float, verdict: Verdict, text: str
) -> None:
    line = said(firmware, {name: value})["on low battery"]
    assert line.verdict is verdict
    assert text in line.text


@pytest.mark.parametrize(
    ("firmware", "parameters", "verdict"),
    [
        (ARDUCOPTER, {"FENCE_ENABLE": 0.0, "FENCE_TYPE": 7.0, "FENCE_RADIUS": 10.0}, None),
        (
            ARDUCOPTER,
            {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 7.0, "FENCE_RADIUS": 300.0, "FENCE_ALT_MAX": 100.0},
            Verdict.OK,
        ),
        (
            ARDUCOPTER,
            {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 1.0, "FENCE_RADIUS": 10.0, "FENCE_ALT_MAX": 100.0},
            Verdict.OK,
        ),
        (ARDUCOPTER, {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 2.0, "FENCE_RADIUS": 42.0}, Verdict.WARNS),
        (ARDUCOPTER, {"FENCE_ENABLE": 1.0, "FENCE_TYPE": 1.0, "FENCE_ALT_MAX": 4.0}, Verdict.WARNS),
        (PX4, {"GF_ACTION": 2.0, "GF_MAX_HOR_DIST": 0.0, "GF_MAX_VER_DIST": 0.0}, None),
        (PX4, {"GF_ACTION": 2.0, "GF_MAX_HOR_DIST": 30.0, "GF_MAX_VER_DIST": 0.0}, Verdict.WARNS),
        (PX4, {"GF_ACTION": 0.0, "GF_MAX_HOR_DIST": 30.0, "GF_MAX_VER_DIST": 0.0}, None),
    ],
)
def test_a_fence_that_is_nearer_than_the_areas_far_corner_or_lower_than_the_search_gets_a_warning(
    firmware, parameters: dict[str, float], verdict: Verdict | None
) -> None:
    """The far corner of 30 m x 30 m is 42.4 m from home; the search flies at 5 m."""
    fence = said(firmware, parameters).get("fence")
    assert (fence and fence.verdict) == verdict
