"""Protects that the pilot of a real vehicle always wins: what is a pilot's and what a failsafe's, and how
the search comes back.
"""

import itertools
import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from aircraft.remote.procedures import Targets
from aircraft.search.search import LANDED, PAUSED, SEARCHING, TAKING_OFF
from tests.aircraft.remote.cockpit import Cockpit, away_m

KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)
HOVER = {"ardupilot": "BRAKE", "px4": "HOLD"}
BY_HAND = {"ardupilot": "LOITER", "px4": "POSCTL"}
FENCE_HOVERS = {"ardupilot": {"FENCE_ACTION": 4.0}, "px4": {"GF_ACTION": 2.0, "COM_FAIL_ACT_T": 60.0}}
ONLY_WARNS = {"BATT_FS_LOW_ACT": 0.0}
A_RADIO = "a radio or a ground station"
STATION = "255/190 on the bus"


def searching(kind: str, *faults: str, readings: int = 2, **settings: Any) -> Cockpit:
    """A search that has taken some readings, of a pilot with a radio."""
    cockpit = Cockpit(kind, *faults, radio=True, **settings)
    cockpit.reads(readings)
    return cockpit


def paused(kind: str, **settings: Any) -> Cockpit:
    """A search whose vehicle a pilot flies."""
    cockpit = searching(kind, **settings)
    cockpit.ap.change(BY_HAND[kind])
    cockpit.until(lambda: cockpit.search.state == PAUSED)
    return cockpit


def strike(cockpit: Cockpit, name: str) -> None:
    """Something goes wrong now."""
    (one,) = [one for one in cockpit.ap.faults.all if one.name == name]
    one.when, one.clock = 0.0, "boot"


def elsewhere(cockpit: Cockpit) -> tuple[float, float, float]:
    """A place 6 m to the north-west, 2 m higher, in the EKF's frame."""
    north, east, down = cockpit.ap.body.position
    return north + 5.0, east - 3.0, down - 2.0


def said_to(cockpit: Cockpit, seconds: float) -> set[str]:
    """Let time pass; return the types of what went to the autopilot."""
    before = len(cockpit.radio.sent)
    cockpit.run(seconds)
    return {message.get_type() for message in cockpit.radio.sent[before:]}


# ---- a failsafe or a pilot ----


def test_a_pilot_who_stops_a_vehicle_whose_failsafe_struck_long_ago_is_left_alone() -> None:
    """Its flag stays up: on the way home, 10 s later, it says nothing about who has stopped it."""
    cockpit = searching("ardupilot", "low@900", parameters=ONLY_WARNS)
    strike(cockpit, "low")
    cockpit.until(lambda: cockpit.ap.mode == "RTL")
    cockpit.run(10.0)
    cockpit.ap.change("BRAKE")
    cockpit.run(20.0)
    assert cockpit.ap.mode == "BRAKE"
    assert cockpit.vehicle.left


def test_a_flag_that_a_pilot_knows_of_when_he_gives_the_search_back_neither_ends_it_nor_makes_his_stop_a_failsafe() -> (
    None
):
    """A minute after the battery's flag went up, its action being 0."""
    cockpit = searching("ardupilot", "low@900", parameters=ONLY_WARNS)
    cockpit.ap.change("LOITER")
    cockpit.run(5.0)
    strike(cockpit, "low")
    cockpit.run(60.0)
    assert cockpit.ap.mode == "LOITER"
    assert cockpit.search.give_back(STATION).accepted
    cockpit.reads(len(cockpit.readings) + 2)
    cockpit.ap.change("BRAKE")
    cockpit.run(20.0)
    assert cockpit.ap.mode == "BRAKE"
    assert not cockpit.vehicle.failure


def test_a_pilot_who_stops_a_vehicle_just_before_a_flag_rises_is_left_alone() -> None:
    """A failsafe's own change of mode has its status in the same HEARTBEAT: a status that rises later has
    not changed the mode.
    """
    cockpit = searching("ardupilot", "low@900", parameters=ONLY_WARNS)
    cockpit.ap.change("BRAKE")
    cockpit.until(lambda: cockpit.search.state == PAUSED)
    strike(cockpit, "low")
    cockpit.until(lambda: cockpit.heard("Battery Failsafe"), 3.0)
    cockpit.run(20.0)
    assert cockpit.ap.mode == "BRAKE"
    assert cockpit.vehicle.left


ORDERS = [
    pytest.param(late, marks=[pytest.mark.full] * (sum(late) > 1.0), id=f"{late}")
    for late in itertools.product((0.0, 1.0), repeat=3)
]


@pytest.mark.parametrize("late", ORDERS)
@both
def test_a_new_failsafe_that_only_hovers_is_flown_home_in_whatever_order_its_signs_come(
    kind: str, late: tuple[float, ...]
) -> None:
    cockpit = searching(kind, "fence@900", parameters=FENCE_HOVERS[kind])
    cockpit.radio.late = dict(zip(("mode", "status", "STATUSTEXT"), late, strict=True))
    cockpit.run(3.0)
    strike(cockpit, "fence")
    cockpit.until(lambda: cockpit.ap.mode == HOVER[kind], 3.0)
    cockpit.until(lambda: cockpit.ap.mode == "RTL", 5.0)
    assert cockpit.fails()


def test_a_second_failsafe_is_one_though_the_flag_of_the_first_is_up() -> None:
    cockpit = searching(
        "ardupilot", "low@900", "fence@900", parameters={**ONLY_WARNS, **FENCE_HOVERS["ardupilot"]}
    )
    cockpit.ap.change("LOITER")
    cockpit.run(5.0)
    strike(cockpit, "low")
    cockpit.run(10.0)
    cockpit.search.give_back(STATION)
    cockpit.reads(len(cockpit.readings) + 1)
    strike(cockpit, "fence")
    cockpit.until(lambda: cockpit.ap.mode == "RTL", 10.0)
    assert "breached" in cockpit.fails()


@both
def test_a_pilot_who_stops_what_a_failsafe_made_us_do_is_obeyed_at_once(kind: str) -> None:
    """One sign explains one change: the second is by someone who has seen the first."""
    cockpit = searching(kind, "fence@900", parameters=FENCE_HOVERS[kind])
    strike(cockpit, "fence")
    cockpit.until(lambda: cockpit.ap.mode == "RTL", 10.0)
    cockpit.run(1.0)
    cockpit.ap.change(HOVER[kind])
    cockpit.run(20.0)
    assert cockpit.ap.mode == HOVER[kind]


@both
def test_a_failsafe_while_a_pilot_flies_is_the_pilots(kind: str) -> None:
    cockpit = searching(kind, "fence@900", parameters=FENCE_HOVERS[kind])
    cockpit.ap.change(BY_HAND[kind])
    cockpit.until(lambda: cockpit.search.state == PAUSED)
    cockpit.run(5.0)
    strike(cockpit, "fence")
    cockpit.run(20.0)
    assert cockpit.ap.mode == HOVER[kind]
    assert cockpit.vehicle.left


def test_a_mode_that_a_client_asked_for_through_us_is_no_failsafe() -> None:
    cockpit = searching("ardupilot")
    cockpit.vehicle.flight.asked_by(STATION)
    cockpit.ap.change("BRAKE")
    cockpit.ap.failsafe = True
    cockpit.run(10.0)
    assert cockpit.ap.mode == "BRAKE"
    assert cockpit.heard(f"Search gives way: BRAKE by {STATION}")


def test_a_battery_failsafe_that_does_nothing_brings_the_vehicle_home() -> None:
    """At 18%, above our own limit."""
    cockpit = searching("ardupilot", "low@900", parameters=ONLY_WARNS)
    strike(cockpit, "low")
    reason = cockpit.fails()
    assert reason.startswith("ArduCopter's failsafe has struck: Battery 1 is low 10.40V")
    assert cockpit.heard("Returning home")
    assert cockpit.ap.landed


def test_a_battery_failsafe_that_does_nothing_leaves_the_vehicle_to_its_pilot() -> None:
    cockpit = paused("ardupilot", parameters=ONLY_WARNS)
    cockpit.run(5.0)
    cockpit.ap.failsafe = True
    assert said_to(cockpit, 30.0) == {"HEARTBEAT"}
    assert cockpit.ap.mode == "LOITER"
    assert not cockpit.vehicle.failure


# ---- who leads ----


@both
def test_a_pilot_takes_over_at_once_and_only_a_command_to_the_search_gives_it_back(kind: str) -> None:
    cockpit = searching(kind, f"pilot@#3:{BY_HAND[kind]}")
    cockpit.until(lambda: cockpit.search.state == PAUSED)
    assert cockpit.heard(f"Search gives way: {'POSITION' if kind == 'px4' else 'LOITER'}")
    count = len(cockpit.readings)
    assert said_to(cockpit, 20.0) == {"HEARTBEAT"}
    cockpit.ap.change({"ardupilot": "GUIDED", "px4": "OFFBOARD"}[kind])
    assert said_to(cockpit, 20.0) == {"HEARTBEAT"}
    assert cockpit.search.state == PAUSED
    assert len(cockpit.readings) == count
    assert cockpit.search.give_back(STATION).accepted
    cockpit.reads(count + 2)
    assert cockpit.search.state == SEARCHING
    assert cockpit.heard(f"Search resumed by {STATION}")


def test_px4_gets_setpoints_before_it_is_asked_for_offboard_again() -> None:
    cockpit = paused("px4")
    cockpit.search.give_back(STATION)
    before = len(cockpit.radio.sent)
    cockpit.until(lambda: cockpit.ap.mode == "OFFBOARD", 5.0)
    kinds = [message.get_type() for message in cockpit.radio.sent[before:]]
    assert kinds[: kinds.index("COMMAND_LONG")].count("SET_POSITION_TARGET_LOCAL_NED") > 10


@pytest.mark.parametrize("before", [(), ("BRAKE",)], ids=["searching", "stopped"])
@both
def test_a_go_to_of_a_ground_station_is_flown_and_nothing_of_ours_goes_out(
    kind: str, before: tuple[str, ...]
) -> None:
    """In GUIDED it changes no mode; PX4 changes to HOLD."""
    cockpit = searching(kind)
    cockpit.run(1.0)
    for _ in before:
        cockpit.ap.change(HOVER[kind])
        cockpit.until(lambda: cockpit.search.state == PAUSED)
        cockpit.run(5.0)
    place = elsewhere(cockpit)
    cockpit.ap.go_to(place)
    cockpit.run(1.5)
    assert cockpit.search.state == PAUSED
    assert said_to(cockpit, 20.0) == {"HEARTBEAT"}
    assert away_m(cockpit.ap.body.position, place) < 0.5
    count = len(cockpit.readings)
    cockpit.search.give_back(STATION)
    cockpit.reads(count + 2)
    assert cockpit.search.state == SEARCHING


def test_a_go_to_in_guided_says_so_and_a_velocity_is_one_too() -> None:
    cockpit = searching("ardupilot")
    cockpit.run(1.0)
    cockpit.ap.go_to(elsewhere(cockpit))
    cockpit.until(lambda: cockpit.search.state == PAUSED, 1.0)
    assert cockpit.heard("Search gives way: GUIDED to another target by the autopilot or its pilot")
    cockpit.search.give_back(STATION)
    cockpit.reads(len(cockpit.readings) + 1)
    cockpit.run(1.0)
    cockpit.ap.aim, cockpit.ap.velocity, cockpit.ap.aimed_s = "velocity", (0.0, 1.0, 0.0), cockpit.ap.now_s
    cockpit.until(lambda: cockpit.search.state == PAUSED, 1.0)


@pytest.mark.parametrize("seconds", [1.5, 4.0], ids=["climbing", "nearly there"])
def test_a_go_to_while_it_takes_off_is_the_pilots(seconds: float) -> None:
    cockpit = Cockpit("ardupilot", radio=True)
    cockpit.until(lambda: not cockpit.ap.landed)
    cockpit.run(seconds)
    place = elsewhere(cockpit)
    cockpit.ap.go_to(place)
    cockpit.until(lambda: cockpit.search.state == PAUSED, 1.5)
    assert said_to(cockpit, 15.0) == {"HEARTBEAT"}
    assert away_m(cockpit.ap.body.position, place) < 0.5


@pytest.mark.parametrize("late_s", [1.0, 2.5])
def test_targets_of_ours_that_are_read_back_late_are_ours(late_s: float) -> None:
    cockpit = searching("ardupilot")
    cockpit.radio.late = {"POSITION_TARGET_LOCAL_NED": late_s}
    cockpit.reads(8)
    assert not cockpit.heard("gives way")


@both
def test_frames_that_the_link_loses_make_no_pilot(kind: str) -> None:
    cockpit = Cockpit(kind, "drop:20", seed=5)
    cockpit.reads(8)
    assert not cockpit.heard("gives way")


def test_a_second_flight_is_not_misled_by_the_target_of_the_first() -> None:
    """ArduCopter reads back an old target while it takes off."""
    cockpit = Cockpit("ardupilot")
    cockpit.ap.last_place = (15.0, 3.0, -8.0)
    cockpit.reads(2)
    assert not cockpit.heard("gives way")


def test_what_is_read_back_is_foreign_if_it_is_neither_ours_nor_the_one_before() -> None:
    one, two, other = (1.0, 2.0, -5.0), (2.0, 2.0, -5.0), (9.0, 9.0, -5.0)
    targets = Targets()
    assert targets.takes(other), "there was nothing before"
    targets.send(one)
    assert [targets.takes(place) for place in (other, one)] == [True, True]
    targets.send(two)
    assert [targets.takes(place) for place in (one, one, two)] == [True, True, True]
    assert not targets.takes(None), "a velocity"
    targets.begin()
    assert targets.takes(None)
    targets.send(one)
    assert not targets.takes(other)


@both
def test_a_pilot_who_stops_the_take_off_keeps_the_vehicle(kind: str) -> None:
    cockpit = Cockpit(kind, f"pilot@+1:{BY_HAND[kind]}", radio=True)
    cockpit.until(lambda: cockpit.search.state == PAUSED)
    cockpit.run(20.0)
    assert cockpit.ap.mode == BY_HAND[kind]
    assert not cockpit.readings


# ---- how it ends ----


@both
def test_a_search_that_a_pilot_ends_says_by_whom_and_how(kind: str) -> None:
    cockpit = searching(kind, "pilot@#3:RTL")
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert not cockpit.vehicle.failure
    assert (
        cockpit.said[-1]
        == cockpit.search.waits_for
        == f"ended by the pilot: {'RTL' if kind == 'ardupilot' else 'RETURN'} by {A_RADIO}"
    )


@both
def test_a_search_whose_motors_are_stopped_in_flight_says_so(kind: str) -> None:
    """ArduCopter forgets its target before its HEARTBEAT tells of the motors: that target is no pilot's."""
    cockpit = searching(kind)
    cockpit.ap.disarm()
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert cockpit.said[-1] == cockpit.search.waits_for
    assert cockpit.said[-1] == "ended by a pilot or the autopilot: the motors have stopped in flight"


def test_a_pilot_who_flies_it_to_another_target_for_longer_ends_the_search_even_if_the_motors_stop() -> None:
    cockpit = searching("ardupilot")
    cockpit.ap.go_to(elsewhere(cockpit))
    cockpit.until(lambda: cockpit.search.state == PAUSED)
    cockpit.run(5.0)
    cockpit.ap.disarm()
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert cockpit.said[-1] == f"ended by the pilot: GUIDED to another target by {A_RADIO}"


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("ardupilot", "Take-off refused: the vehicle could not do it"),  # it was disarmed at its second try
        ("px4", "ended by a pilot or the autopilot: the motors have stopped while it took off"),
    ],
)
def test_a_search_whose_motors_are_stopped_while_it_takes_off_says_so(kind: str, said: str) -> None:
    cockpit = Cockpit(kind, radio=True)
    cockpit.until(lambda: cockpit.search.state == TAKING_OFF and cockpit.ap.armed)
    cockpit.ap.disarm()
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert cockpit.said[-1] == said


@both
def test_a_search_that_a_client_ends_through_us_names_the_client(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.vehicle.flight.asked_by(STATION)
    cockpit.ap.change("RTL")
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert (
        cockpit.said[-1] == f"ended by the pilot: {'RTL' if kind == 'ardupilot' else 'RETURN'} by {STATION}"
    )


@both
def test_a_search_that_has_failed_does_not_come_back(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.answer_at = None
    cockpit.until(lambda: cockpit.vehicle.failure == "No waypoint for 30 s")
    cockpit.ap.change(BY_HAND[kind])
    cockpit.run(5.0)
    refused = cockpit.search.give_back(STATION)
    assert not refused.accepted
    assert refused.reason == "Resume refused: No waypoint for 30 s"
    assert cockpit.ap.mode == BY_HAND[kind]


def test_nothing_is_given_back_before_the_flight_or_after_it() -> None:
    cockpit = Cockpit("ardupilot", ready_s=10.0)
    cockpit.run(1.0)
    assert not cockpit.search.give_back(STATION).accepted
    cockpit.reads(1)
    cockpit.finds()
    assert cockpit.search.give_back(STATION).reason == "Resume refused: the source is found"
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert not cockpit.search.give_back(STATION).accepted


# ---- what else speaks with the vehicle's ids ----


def stranger(
    autopilot: int = mavlink.MAV_AUTOPILOT_GENERIC, kind: int = mavlink.MAV_TYPE_GIMBAL
) -> mavlink.MAVLink_heartbeat_message:
    """The HEARTBEAT of what is no vehicle for a search."""
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 7, mavlink.MAV_STATE_ACTIVE, 3)


OTHERS = {
    "a gimbal": stranger(),
    "a plane": stranger(mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_FIXED_WING),
    "a number that nobody knows": stranger(250, 250),
}


@pytest.mark.parametrize("message", OTHERS.values(), ids=OTHERS)
@both
def test_an_unfit_heartbeat_with_the_vehicles_ids_is_told_once_and_ignored(
    kind: str, message: mavlink.MAVLink_heartbeat_message
) -> None:
    cockpit = searching(kind)
    for _ in range(10):
        cockpit.radio.hear(message)
        cockpit.run(0.5)
    cockpit.reads(len(cockpit.readings) + 1)
    assert sum("with the vehicle's ids, 1/1, is ignored: " in said for said in cockpit.said) == 1
    assert not cockpit.vehicle.failure


def test_another_autopilot_with_the_vehicles_ids_is_ignored() -> None:
    cockpit = searching("ardupilot")
    cockpit.radio.hear(stranger(mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_TYPE_QUADROTOR))
    cockpit.reads(4)
    assert cockpit.heard("is ignored: this is not ArduCopter")


@both
def test_a_fault_that_the_autopilots_message_meets_drops_the_message_and_is_told_once_a_type(
    kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cockpit = searching(kind)
    take = cockpit.vehicle.flight.known.take

    def faulty(message: Any, now_s: float) -> None:
        if message.get_type() == "ATTITUDE":
            raise KeyError("a fault")
        take(message, now_s)

    cockpit.vehicle.flight.known.take = faulty  # type: ignore[method-assign]
    cockpit.reads(4)
    assert cockpit.log.tally.refused["fault"] > 10
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "fault" in line]
    assert "ATTITUDE of 1/1 dropped: KeyError: 'a fault'" in line


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_parameter_that_is_no_number_is_dropped(value: float) -> None:
    cockpit = Cockpit("px4")
    cockpit.until(lambda: cockpit.vehicle.system)
    cockpit.radio.hear(
        mavlink.MAVLink_param_value_message(b"COM_OF_LOSS_T", value, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0)
    )
    cockpit.radio.hear(
        mavlink.MAVLink_param_value_message(b"COM_OBL_RC_ACT", value, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0)
    )
    cockpit.reads(1)
    assert cockpit.log.tally.refused["fault"] == 2
