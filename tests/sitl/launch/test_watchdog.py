"""Protects the watchdog over silent parts, with a simulated clock: it names a hanging part in time, and
never any other.
"""

import math

import pytest

from sitl.launch.watchdog import Watchdog

PARTS = ("router", "uav", "estimator", "agent", "recorder")


class Flight:
    """A mission with a simulated clock: one second passes between two checks, and every part not listed as
    silent reports each second.
    """

    def __init__(self, patience_s: float = 30.0, spoken: bool = True) -> None:
        self.said: list[str] = []
        self.now_s = 1000.0
        self.silent: set[str] = set()
        self.watchdog = Watchdog(PARTS, patience_s, self.now_s, self.said.append)
        if spoken:
            self.goes_on(1)

    def goes_on(self, seconds: int) -> str:
        """Let time pass; returns why the mission ends, and stops there."""
        for _ in range(seconds):
            self.now_s += 1.0
            connected = "router" not in self.silent
            for part in PARTS[1:]:
                if part not in self.silent and connected:
                    self.watchdog.heard(part, self.now_s)
            if reason := self.watchdog.look(self.now_s, connected):
                return reason
        return ""


def test_as_long_as_all_speak_nothing_is_said() -> None:
    flight = Flight()
    assert flight.goes_on(1000) == ""
    assert flight.said == []


@pytest.mark.parametrize("part", ["router", "uav", "estimator", "agent"])
def test_a_silent_part_is_told_after_five_seconds_once_and_ends_the_mission_after_the_patience(
    part: str,
) -> None:
    flight = Flight(patience_s=12.0)
    flight.silent = {part}
    assert flight.goes_on(4) == ""
    assert flight.said == []
    assert flight.goes_on(7) == ""
    assert flight.said == [f"warning: the {part} has said nothing for 5 s"]
    assert flight.goes_on(1) == f"the {part} has said nothing for 12 s (--patience S waits longer)"


def test_a_part_that_speaks_again_is_told_and_counts_anew() -> None:
    flight = Flight(patience_s=12.0)
    for _ in range(2):
        flight.silent = {"agent"}
        assert flight.goes_on(10) == ""
        flight.silent = set()
        assert flight.goes_on(1) == ""
    assert flight.said == ["warning: the agent has said nothing for 5 s", "the agent is back"] * 2


def test_infinite_patience_only_tells() -> None:
    flight = Flight(patience_s=math.inf)
    flight.silent = {"uav"}
    assert flight.goes_on(10_000) == ""
    assert flight.said == ["warning: the uav has said nothing for 5 s"]


def test_the_recorder_is_told_and_never_ends_the_mission() -> None:
    flight = Flight(patience_s=12.0)
    flight.silent = {"recorder"}
    assert flight.goes_on(10_000) == ""
    assert flight.said == ["warning: the recorder has said nothing for 5 s"]
    flight.watchdog.ended("recorder")
    flight.silent = set()
    flight.goes_on(10)
    assert len(flight.said) == 1


def test_where_the_router_is_silent_nobody_else_is_blamed_for_it() -> None:
    flight = Flight(patience_s=20.0)
    flight.silent = {"router"}
    assert flight.goes_on(19) == ""
    flight.silent = set(PARTS[1:])  # they have not reconnected to it yet
    assert flight.goes_on(4) == ""
    assert flight.said == ["warning: the router has said nothing for 5 s", "the router is back"]


def test_a_part_that_compiles_before_its_first_word_is_waited_for_and_told() -> None:
    flight = Flight(patience_s=12.0, spoken=False)
    flight.silent = {"estimator"}
    assert flight.goes_on(120) == ""
    assert flight.said == ["waiting for the estimator to start"]
    flight.silent = set()
    assert flight.goes_on(10) == ""
    assert len(flight.said) == 1
    flight.silent = {"estimator"}
    assert "the estimator has said nothing for 12 s" in flight.goes_on(12)


def test_a_part_that_never_starts_ends_the_mission_at_last() -> None:
    flight = Flight(patience_s=12.0, spoken=False)
    flight.silent = {"agent"}
    assert flight.goes_on(299) == ""
    assert (
        flight.goes_on(1)
        == "the agent has said nothing for 300 s since it was started (--patience S waits longer)"
    )


def test_patience_beyond_the_limit_for_a_start_holds_for_the_start_too() -> None:
    flight = Flight(patience_s=1000.0, spoken=False)
    flight.silent = {"agent"}
    assert flight.goes_on(999) == ""
    assert flight.goes_on(1) != ""


def test_what_a_script_cuts_off_is_not_counted_until_it_is_mended() -> None:
    flight = Flight(patience_s=12.0)
    flight.watchdog.disturb("uav")
    flight.silent = {"uav"}
    assert flight.goes_on(600) == ""
    assert flight.said == []
    flight.watchdog.mend("uav", flight.now_s)
    assert flight.goes_on(11) == ""
    assert "the uav has said nothing" in flight.goes_on(1)


def test_a_part_that_is_cut_off_twice_is_not_counted_until_both_are_mended() -> None:
    flight = Flight(patience_s=12.0)
    flight.watchdog.disturb("agent")
    flight.watchdog.disturb("agent")
    flight.silent = {"agent"}
    flight.watchdog.mend("agent", flight.now_s)
    assert flight.goes_on(100) == ""
    flight.watchdog.mend("agent", flight.now_s)
    assert "the agent has said nothing" in flight.goes_on(12)


def test_a_part_that_was_killed_and_started_again_has_the_time_of_a_start() -> None:
    flight = Flight(patience_s=12.0)
    flight.watchdog.disturb("estimator")
    flight.silent = {"estimator"}
    flight.goes_on(10)
    flight.watchdog.mend("estimator", flight.now_s)
    flight.watchdog.begins("estimator", flight.now_s)
    assert flight.goes_on(299) == ""
    assert "since it was started" in flight.goes_on(1)


def test_time_in_which_the_watch_itself_was_held_up_says_nothing_about_the_parts() -> None:
    flight = Flight(patience_s=12.0)
    flight.now_s += 3600.0  # Ctrl-Z, or a terminal that took no more
    assert flight.watchdog.look(flight.now_s, connected=True) == ""
    assert flight.said == []
    flight.silent = {"agent"}
    assert flight.goes_on(8) == ""
    assert "the agent has said nothing for 12 s" in flight.goes_on(5)


def test_strangers_are_not_watched() -> None:
    flight = Flight()
    flight.watchdog.heard("stranger", flight.now_s)
    assert flight.goes_on(100) == ""
    assert flight.said == []


def test_a_vehicle_that_hangs_is_named_but_does_not_end_the_search_of_the_others() -> None:
    flight = Flight(patience_s=12.0)
    flight.watchdog.spare(["uav"])
    flight.silent = {"uav"}
    assert flight.goes_on(100) == ""
    assert flight.said == ["warning: the uav has said nothing for 5 s"]
    assert flight.watchdog.is_lost("uav", flight.now_s)
    assert not flight.watchdog.is_lost("agent", flight.now_s)
