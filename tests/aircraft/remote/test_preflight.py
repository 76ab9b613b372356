"""Protects what comes before arming: one list, told once; nothing flies that it forbids; and no wait is
without a reason or an end.
"""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from aircraft.remote.safety import Check, Verdict
from aircraft.state import VehicleFailed
from aircraft.together import Berth
from plume.geodesy import HOME as PLACE
from plume.problem import Fenced
from sitl.autopilot.config import VehicleConfig
from tests.aircraft.remote.cockpit import Cockpit

KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)
ORIGIN, HOME = mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, mavlink.MAVLINK_MSG_ID_HOME_POSITION
SERVICES = {"payload", "estimator", "agent"}


def gives_up(cockpit: Cockpit, most_s: float = 200.0) -> str:
    """Let time pass until the wait is over; returns the last line."""
    with pytest.raises(VehicleFailed) as failure:
        cockpit.run(most_s)
    return str(failure.value)


def silent_about(cockpit: Cockpit, *numbers: int) -> None:
    """The autopilot never says these messages."""
    cockpit.ap.says = {**cockpit.ap.says, **dict.fromkeys(numbers, lambda _: None)}


# ---- the list ----


@pytest.mark.parametrize(
    ("kind", "vehicle", "lost", "battery"),
    [
        (
            "ardupilot",
            "ArduCopter, system 1, in STABILIZE",
            "FS_GCS acts after 5 s (FS_GCS_ENABLE 1)",
            "the autopilot changes to RTL",
        ),
        (
            "px4",
            "PX4, system 1, in HOLD",
            "PX4 changes to POSITION, without a pilot to RETURN after 1 s",
            "the autopilot changes to RETURN",
        ),
    ],
)
def test_one_list_is_told_once_and_before_arming(kind: str, vehicle: str, lost: str, battery: str) -> None:
    parameters = {"FS_GCS_ENABLE": 1, "SYSID_MYGCS": 1} if kind == "ardupilot" else {"COM_RCL_EXCEPT": 4}
    cockpit = Cockpit(kind, parameters=parameters, wind=(90.0, 3.0))
    cockpit.reads(2)
    lines = cockpit.checks
    assert [line.split(":")[0] for line in lines] == [
        "vehicle",
        "position and home",
        "battery",
        "wind",
        "if this computer fails",
        "on low battery",
    ]
    assert all(": ok, " in line for line in lines)
    assert lines[0] == f"vehicle: ok, {vehicle}"
    assert "the area of 30 m x 30 m lies north and east of home" in lines[1]
    assert "(1.20, -0.70) m north, east of the EKF's origin" in lines[1]
    assert lines[2] == "battery: ok, 100%"
    assert lines[3] == "wind: ok, given by --wind"
    assert lost in lines[4]
    assert battery in lines[5]
    assert cockpit.said.index("Check: " + lines[-1]) < cockpit.said.index("Arming")


def test_the_names_of_arducopter_4_7_are_asked_for_too() -> None:
    cockpit = Cockpit("ardupilot", parameters={"FS_GCS_ENABLE": 1, "MAV_GCS_SYSID": 1, "MAV_GCS_SYSID_HI": 0})
    del cockpit.ap.parameters["SYSID_MYGCS"]
    cockpit.reads(1)
    assert "if this computer fails: ok, FS_GCS acts after 5 s (FS_GCS_ENABLE 1)" in cockpit.checks


@both
def test_a_battery_below_the_limit_is_not_flown_until_it_is_charged(kind: str) -> None:
    cockpit = Cockpit(kind)
    cockpit.ap.battery_percent = 14
    cockpit.run(40.0)
    assert "battery: not ok, 14% is below 15%: charge or change it" in cockpit.checks
    assert "14% is below 15%" in cockpit.search.waits_for
    assert not cockpit.ap.armed
    cockpit.ap.battery_percent = 90
    cockpit.reads(1)
    assert sum(line.startswith("battery") for line in cockpit.checks) == 1


@both
def test_an_unknown_battery_is_said_and_flown(kind: str) -> None:
    cockpit = Cockpit(kind)
    cockpit.ap.battery_percent = -1
    cockpit.reads(1)
    assert "battery: warning, not known: the autopilot does not say how much is left" in cockpit.checks


def test_without_any_wind_there_is_no_flight_and_the_list_says_so() -> None:
    cockpit = Cockpit("ardupilot", ready_s=20.0)
    cockpit.run(10.0)
    cockpit.wind = Check("wind", Verdict.FORBIDS, "no wind for the readings")
    assert gives_up(cockpit) == "no wind for the readings"
    assert "wind: not ok, no wind for the readings" in cockpit.checks


# ---- the wait ----


@both
def test_a_vehicle_that_is_never_heard_is_waited_for_no_longer_than_was_said(kind: str) -> None:
    cockpit = Cockpit(kind, "mute", wait_s=20.0)
    assert gives_up(cockpit).startswith("the search has not begun in 20 s (--wait): no HEARTBEAT")
    assert 20.0 <= cockpit.now_s < 21.0
    assert [line.split(",")[0] for line in cockpit.checks] == ["vehicle: not ok"]


def test_the_last_line_says_where_it_was_expected() -> None:
    cockpit = Cockpit("ardupilot", "mute", wait_s=20.0)
    cockpit.radio.state = "at tcp:127.0.0.1:5760 (Connection refused)"
    assert gives_up(cockpit).endswith("no HEARTBEAT at tcp:127.0.0.1:5760 (Connection refused)")


@both
def test_a_position_that_does_not_come_is_waited_for_and_told(kind: str) -> None:
    cockpit = Cockpit(kind, ready_s=1e6, wait_s=20.0)
    last = gives_up(cockpit)
    assert "no position yet" in last
    assert "is GPS outside, with a fix?" in last
    assert any(line.startswith("position and home: not ok, no position yet") for line in cockpit.checks)


@pytest.mark.parametrize(("number", "name"), [(ORIGIN, "GPS_GLOBAL_ORIGIN"), (HOME, "HOME_POSITION")])
@both
def test_an_autopilot_that_never_says_its_origin_or_home_is_given_up_with_that_word(
    kind: str, number: int, name: str
) -> None:
    cockpit = Cockpit(kind, wait_s=30.0)
    silent_about(cockpit, number)
    assert f"no {name}, though it is asked for" in gives_up(cockpit)
    asked = [
        message
        for message in cockpit.radio.sent
        if message.get_type() == "COMMAND_LONG" and message.param1 == number
    ]
    assert mavlink.MAV_CMD_REQUEST_MESSAGE in {message.command for message in asked}


STANDS_AT = 47.3977527, 8.5455845
"""Where the double's home is."""
NORTH_DEG = 1 / 111_195
"""A metre north, on a sphere of 6,371 km."""


@both
def test_a_vehicle_that_stands_elsewhere_than_its_fence_was_drawn_for_does_not_fly(kind: str) -> None:
    meant = STANDS_AT[0] + 40 * NORTH_DEG, STANDS_AT[1]
    cockpit = Cockpit(kind, wait_s=30.0, config=VehicleConfig(home_meant=meant))
    last = gives_up(cockpit)
    assert "is 40.0 m from the problem's, 47.3981124, 8.5455845" in last
    assert last.endswith("its area would lie elsewhere by as much; wanted within 2 m")
    assert not any(line.startswith("Arming") for line in cockpit.said)


@both
def test_ways_that_stay_further_from_the_fence_leave_home_more_room(kind: str) -> None:
    meant = STANDS_AT[0], STANDS_AT[1] + 3 * NORTH_DEG / 0.677  # cos 47.4°
    around = ((0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0))
    near, far = (
        VehicleConfig(
            area=Fenced((0.0, 0.0), (30.0, 30.0), keep_in=around, clearance_m=clearance_m), home_meant=meant
        )
        for clearance_m in (3.5, 2.5)
    )
    Cockpit(kind, config=near).reads(1)
    assert "is 3.0 m from the problem's" in gives_up(Cockpit(kind, wait_s=30.0, config=far))


def test_a_home_that_arming_moves_away_is_noticed_before_the_climb() -> None:
    cockpit = Cockpit("ardupilot", config=VehicleConfig(home_meant=STANDS_AT))
    says = cockpit.ap.says[HOME]

    def elsewhere(*given: Any) -> Any:
        message = says(*given)
        if message is not None and cockpit.ap.armed:
            message.latitude += 500  # 5.6 m
        return message

    cockpit.ap.says = {**cockpit.ap.says, HOME: elsewhere}
    cockpit.run(60.0)
    assert cockpit.vehicle.failure.startswith("Take-off refused: home, 47.3978027, 8.5455845, is 5.6 m from")
    assert not cockpit.ap.armed
    assert not cockpit.readings


@both
def test_an_origin_that_is_not_streamed_is_asked_for(kind: str) -> None:
    cockpit = Cockpit(kind)
    command = cockpit.ap.command

    def no_stream(number: int, values: list[float]) -> Any:
        refused = number == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and values[0] == ORIGIN
        return 3 if refused else command(number, values)

    cockpit.ap.command = no_stream
    cockpit.reads(1)


def test_a_check_that_fails_before_arming_is_waited_for_no_longer_than_was_said() -> None:
    cockpit = Cockpit("px4", parameters={"NAV_DLL_ACT": 2}, wait_s=30.0)
    assert "a check before arming fails" in gives_up(cockpit)
    assert any(line.startswith("arming: not ok, a check") for line in cockpit.checks)


@both
def test_a_refused_arming_is_named_where_the_wait_ends_first(kind: str) -> None:
    cockpit = Cockpit(kind, "arm", wait_s=30.0)
    assert "Compass not healthy" in gives_up(cockpit)


@pytest.mark.parametrize(
    ("kind", "mode", "start"), [("ardupilot", "LOITER", "GUIDED"), ("px4", "POSCTL", "HOLD")]
)
def test_a_pilot_on_the_ground_is_waited_for_and_told_how_to_give_the_vehicle(
    kind: str, mode: str, start: str
) -> None:
    cockpit = Cockpit(kind, radio=True, wait_s=40.0)
    cockpit.run(4.0)
    cockpit.ap.change(mode)
    last = gives_up(cockpit)
    assert "a pilot has chosen" in last
    assert f"{start} gives the vehicle to the search" in last
    assert any(line.startswith("pilot: not ok, ") for line in cockpit.checks)


@both
def test_a_pilot_in_flight_is_waited_for_no_longer_than_was_said(kind: str) -> None:
    """The program begins while somebody flies the vehicle."""
    cockpit = Cockpit(kind, wait_s=20.0, radio=True)
    cockpit.ap.armed, cockpit.ap.body.position[2] = True, -10.0
    last = gives_up(cockpit)
    assert "a pilot flies the vehicle; the search begins when the vehicle stands disarmed" in last


@both
def test_services_that_are_not_there_are_waited_for_no_longer_than_was_said(kind: str) -> None:
    cockpit = Cockpit(kind, wait_s=60.0)
    cockpit.absent = {"payload", "agent"}
    assert gives_up(cockpit).endswith(
        "(--wait): no agent, payload: the first lines of this log say how to start it"
    )
    assert 60.0 <= cockpit.now_s < 61.0


def test_what_is_missing_of_both_is_told() -> None:
    cockpit = Cockpit("ardupilot", "mute", wait_s=20.0)
    cockpit.absent = {"payload"}
    last = gives_up(cockpit)
    assert "no HEARTBEAT" in last
    assert "no payload" in last


@both
def test_services_that_a_launcher_starts_are_its_to_wait_for(kind: str) -> None:
    """They compile for minutes on a slow machine; the vehicle's own time begins when they are there."""
    cockpit = Cockpit(kind, wait_s=20.0, launched=True)
    cockpit.absent = SERVICES
    cockpit.run(300.0)
    cockpit.absent = set()
    cockpit.reads(1)


def test_under_a_launcher_the_vehicle_is_waited_for_no_longer_whatever_the_services_do() -> None:
    cockpit = Cockpit("ardupilot", "mute", wait_s=20.0, launched=True)
    cockpit.absent = SERVICES
    assert "no HEARTBEAT" in gives_up(cockpit)


@both
def test_once_it_flies_there_is_no_such_limit(kind: str) -> None:
    cockpit = Cockpit(kind, wait_s=15.0)
    cockpit.reads(8)
    assert cockpit.now_s > 25.0


# ---- one of several that search together ----


@both
def test_one_of_several_reads_in_the_plane_of_the_search_wherever_its_home_is(kind: str) -> None:
    home = (1.2, -0.7, -0.4)
    cockpit = Cockpit(kind, home=home, berth=Berth((2.0, 2.0), [(28.0, 28.0)], 3.0, PLACE))
    cockpit.reads(2)
    for (_, place), truth in zip(cockpit.readings, cockpit.truths, strict=True):
        for axis in (0, 1):
            assert place[axis] == pytest.approx(truth[axis] + home[axis], abs=0.05)
        assert place[2] == pytest.approx(truth[2], abs=0.05)  # heights are above its own home
    assert any("(--home); the vehicle's own home is (-0.7" in line for line in cockpit.said)


def test_one_of_several_does_not_fly_from_a_home_whose_way_could_meet_another_s() -> None:
    cockpit = Cockpit("ardupilot", wait_s=30.0, berth=Berth((28.0, 28.0), [(2.0, 2.0)], 3.0, PLACE))
    last = gives_up(cockpit)
    assert (
        "is not nearer by 3 m (--separation) to its start (28.0, 28.0) than to another's (2.0, 2.0)" in last
    )
    assert not cockpit.ap.armed


def test_one_of_several_waits_for_the_others_by_name() -> None:
    cockpit = Cockpit("ardupilot", wait_s=30.0)
    cockpit.absent = {"uav/3", "uav/2"}
    assert gives_up(cockpit).endswith("(--wait): uav/2, uav/3 not ready to take off")
