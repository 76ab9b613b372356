"""Protects the project's own vehicle as an autopilot like any other: what holds on the doubles holds on
it, and it acts as it says.
"""

from collections.abc import Callable

import pytest

from aircraft.search.search import LANDED
from link.modes import Mode
from tests.aircraft.remote import test_flight, test_pilot, test_reactions
from tests.aircraft.remote.cockpit import Cockpit
from tests.autopilots.own import WIND

ALIKE = (
    test_flight.test_it_flies_reads_at_each_waypoint_and_comes_home,
    test_flight.test_the_altitude_is_kept_over_many_waypoints,
    test_flight.test_readings_at_the_edge_of_the_area_are_taken_inside_it,
    test_flight.test_readings_are_taken_at_rest,
    test_flight.test_it_is_a_companion_with_a_heartbeat_once_a_second,
    test_flight.test_someone_on_the_bus_may_pause_and_resume,
    test_reactions.test_an_agent_that_does_not_answer_for_30_s_brings_it_home,
    test_pilot.test_a_search_that_a_pilot_ends_says_by_whom_and_how,
    test_reactions.test_a_short_silence_is_told_and_the_search_goes_on,
    test_reactions.test_a_link_that_stays_lost_ends_the_mission_after_a_minute,
    test_reactions.test_an_autopilot_that_starts_again_in_flight_ends_the_mission,
    test_reactions.test_a_program_that_ends_while_it_holds_sends_it_home_too,
    test_reactions.test_a_program_that_is_interrupted_within_a_procedure_still_sends_it_home,
)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("test", ALIKE, ids=lambda test: test.__name__.removeprefix("test_"))
def test_as_on_the_doubles(test: Callable[[str], None]) -> None:
    test("plumeward")


def test_lost_frames_need_nothing_but_patience() -> None:
    test_flight.test_lost_frames_and_slow_answers_need_nothing_but_patience("plumeward", ("drop:5",))


def test_one_that_starts_again_before_the_flight_is_asked_for_its_origin_again() -> None:
    cockpit = test_flight.searching("plumeward", "reboot@1")
    assert not cockpit.vehicle.failure


@pytest.mark.parametrize(("after_stop", "mode"), [("land", Mode.LAND), ("hold", Mode.HOLD)])
def test_what_comes_after_the_stop_is_done(after_stop: str, mode: Mode) -> None:
    test_flight.test_what_comes_after_the_stop_is_done("plumeward", after_stop, mode)


def test_its_own_wind_is_that_of_the_readings() -> None:
    cockpit = test_flight.searching("plumeward")
    assert cockpit.vehicle.wind == WIND


@pytest.mark.parametrize("parameters", [{}, {"COM_OF_LOSS_T": 5.0}])
def test_it_tells_its_failsafe_and_does_so_when_the_setpoints_stop(parameters: dict[str, float]) -> None:
    loss_s = parameters.get("COM_OF_LOSS_T", 30.0)
    cockpit = test_flight.searching("plumeward", parameters=parameters)
    assert cockpit.heard(f"PX4 changes to RETURN after {loss_s:g} s")
    assert not cockpit.heard("could not be read")
    assert not cockpit.heard("No parameter"), "it has all that it is asked for"
    stopped_s = cockpit.ap.now_s
    while cockpit.ap.mode == "OFFBOARD":
        cockpit.radio.advance()  # the program does nothing
    assert cockpit.ap.mode == "RTL"
    assert cockpit.ap.now_s - stopped_s == pytest.approx(loss_s, abs=0.2)


def test_targets_that_do_not_come_through_make_it_return_and_fail() -> None:
    cockpit = Cockpit("plumeward", "ignore@#3")
    assert "RETURN by its failsafe: No setpoint for 30 s: returning home" in cockpit.fails()
    assert cockpit.ap.landed


def test_a_second_search_flies_the_same_vehicle_after_it_has_landed() -> None:
    first = test_flight.searching("plumeward")
    first.finds()
    first.until(lambda: first.search.state == LANDED)
    second = Cockpit("plumeward")
    second.wire = second.radio.wire = first.wire
    second.reads(3)
    assert not second.vehicle.failure
