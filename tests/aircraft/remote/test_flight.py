"""Protects a search on a real autopilot: it waits, arms, takes off, flies each waypoint, measures at rest,
comes home and lands.
"""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import SEARCH, order
from aircraft.search.search import LANDED, PAUSED, SEARCHING
from link.modes import Mode
from tests.aircraft.remote.cockpit import START, Cockpit, away_m

KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)


def searching(kind: str, *faults: str, **settings: Any) -> Cockpit:
    """A search that has taken its first reading."""
    cockpit = Cockpit(kind, *faults, **settings)
    cockpit.reads(1)
    return cockpit


@both
def test_it_flies_reads_at_each_waypoint_and_comes_home(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.reads(5)
    assert away_m(cockpit.readings[0][1], (START[1], START[0], -5.0)) < 0.3
    for (_, before), (_, place) in zip(cockpit.readings, cockpit.readings[1:], strict=False):
        assert away_m(place, (before[0], before[1] + 1.0, -5.0)) <= 0.3 + 1e-6
    cockpit.finds()
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert math.dist(cockpit.ap.body.position[:2], cockpit.ap.home[:2]) < 0.5
    assert not cockpit.vehicle.failure


@both
def test_places_are_told_from_home_wherever_the_ekf_has_its_origin(kind: str) -> None:
    cockpit = searching(kind, home=(-7.0, 12.0, 3.0))
    cockpit.reads(3)
    for (_, told), true in zip(cockpit.readings, cockpit.truths, strict=True):
        assert away_m(told, true) < 0.08, "noise of 0.03 m, and 1e-7 degrees are 0.01 m"


@both
def test_the_altitude_is_kept_over_many_waypoints(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.reads(12)
    assert all(abs(place[2] + 5.0) < 0.2 for _, place in cockpit.readings)


@both
def test_readings_at_the_edge_of_the_area_are_taken_inside_it(kind: str) -> None:
    """The estimator refuses readings from outside."""
    cockpit = Cockpit(kind)
    corners = iter([(0.0, 0.0), (0.0, 5.0), (6.0, 0.0)])
    cockpit.answers = lambda _: next(corners)
    cockpit.reads(4)
    assert all(0.0 < place[0] <= 30.0 and 0.0 < place[1] <= 30.0 for _, place in cockpit.readings)
    assert away_m(cockpit.readings[1][1][:2], (0.0, 0.0)) < 0.6 + 0.3


@both
def test_readings_are_taken_at_rest(kind: str) -> None:
    cockpit = Cockpit(kind)
    for number in range(1, 5):
        cockpit.reads(number)
        assert math.hypot(*cockpit.ap.body.velocity) < 0.3


@both
def test_time_in_which_the_link_carries_nothing_is_no_time_at_rest(kind: str) -> None:
    """A relay holds everything back for 0.8 s, just when the vehicle was first heard to be near its
    waypoint and slow.
    """
    cockpit = searching(kind)
    cockpit.reads(2)
    target = cockpit.readings[-1][1]

    def is_near() -> bool:
        known = cockpit.vehicle.flight.known
        at = known.place
        return away_m(at, (target[0], target[1] + 1.0, -5.0)) < 0.3 and math.hypot(*known.velocity) < 0.25

    cockpit.until(is_near)
    count, poll, kept = len(cockpit.readings), cockpit.radio.poll, []
    cockpit.radio.poll = lambda wait_s=0.0: kept.extend(poll()) or []  # type: ignore[method-assign]
    cockpit.run(0.8)
    assert len(cockpit.readings) == count
    cockpit.radio.poll = lambda wait_s=0.0: [*kept, *poll()]  # type: ignore[method-assign]
    cockpit.step()
    cockpit.radio.poll = poll  # type: ignore[method-assign]
    assert len(cockpit.readings) == count + 1, "the vehicle has stood there all the time"


def test_it_says_what_it_waits_for_once_and_arms_only_when_it_can_fly() -> None:
    """ArduCopter would take arming, and an empty promise, from a quarter of the time on."""
    cockpit = Cockpit("ardupilot", ready_s=20.0)
    cockpit.run(19.0)
    assert not cockpit.ap.armed
    assert sum("no position yet" in said for said in cockpit.said) == 1
    cockpit.until(lambda: cockpit.ap.armed, 5.0)


@both
def test_no_message_to_the_autopilot_holds_a_nan_that_arducopter_would_die_of(kind: str) -> None:
    cockpit = searching(kind)
    for message in cockpit.radio.sent:
        values = [value for value in message.to_dict().values() if isinstance(value, float)]
        allowed = (
            kind == "px4"
            and message.get_type() == "COMMAND_LONG"
            and message.command == mavlink.MAV_CMD_NAV_TAKEOFF
        )
        assert allowed or all(map(math.isfinite, values)), message


@both
def test_it_is_a_companion_with_a_heartbeat_once_a_second(kind: str) -> None:
    cockpit = searching(kind)
    beats = [message for message in cockpit.radio.sent if message.get_type() == "HEARTBEAT"]
    assert {message.type for message in beats} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}
    assert len(beats) == pytest.approx(cockpit.now_s, abs=2)
    assert {(message.get_srcSystem(), message.get_srcComponent()) for message in beats[3:]} == {(1, 191)}


def test_px4_gets_setpoints_at_10_hz_before_and_all_through_offboard_while_the_agent_thinks() -> None:
    cockpit = Cockpit("px4")
    cockpit.thinks_s = 6.0
    cockpit.reads(3)
    assert not cockpit.ap.failsafe
    assert cockpit.search.state == SEARCHING
    setpoints = sum(message.get_type() == "SET_POSITION_TARGET_LOCAL_NED" for message in cockpit.radio.sent)
    cockpit.run(4.0)
    after = sum(message.get_type() == "SET_POSITION_TARGET_LOCAL_NED" for message in cockpit.radio.sent)
    assert after - setpoints >= 20


@pytest.mark.parametrize(("after_stop", "mode"), [("land", Mode.LAND), ("hold", Mode.HOLD)])
@both
def test_what_comes_after_the_stop_is_done(kind: str, after_stop: str, mode: Mode) -> None:
    cockpit = searching(kind, after_stop=after_stop)
    cockpit.finds()
    cockpit.run(4.0)
    assert cockpit.mode is mode
    assert cockpit.vehicle.flight.doing is None
    assert cockpit.ap.mode in (
        {Mode.LAND: "LAND", Mode.HOLD: "BRAKE" if kind == "ardupilot" else "HOLD"}[mode],
    )


@both
def test_someone_on_the_bus_may_pause_and_resume(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.tell(order("hold", 1, SEARCH))
    cockpit.run(5.0)
    assert cockpit.search.state == PAUSED
    assert cockpit.ap.mode in ("BRAKE", "HOLD")
    count = len(cockpit.readings)
    cockpit.run(10.0)
    assert len(cockpit.readings) == count
    cockpit.tell(order("resume", 1, SEARCH))
    cockpit.reads(count + 2)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("faults", [("drop:5",), ("progress",), ("busy:9",), ("drop:5", "progress")])
@both
def test_lost_frames_and_slow_answers_need_nothing_but_patience(kind: str, faults: tuple[str, ...]) -> None:
    cockpit = searching(kind, *faults, seed=3)
    cockpit.reads(4)
    cockpit.finds()
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert not cockpit.vehicle.failure
