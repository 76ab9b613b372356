"""Protects the status: missing, starting, stale or refusing parts are recognised from health messages
alone, without a common clock.
"""

import argparse

import pytest

from ground.desk.status import Board, add_arguments
from link.bus.messages import Health


def health(service: str, uptime_s: float, refused_lately: int = 0) -> Health:
    return Health(service, "ready", -1, 0.0, uptime_s, {}, refused_lately=refused_lately)


def board(*alive: str, only: tuple[str, ...] = ()) -> Board:
    return Board(only or ("uav", "estimator", "agent"), alive, now_s=1000.0, only_wanted=bool(only))


def speak(b: Board, service: str, at_s: float, refused_lately: int = 0) -> None:
    """A part's cached health message, followed by a new one."""
    b.hears(health(service, 10.0), at_s - 0.5)
    b.hears(health(service, 11.0, refused_lately), at_s)


def test_who_speaks_is_ok() -> None:
    b = board("uav", "estimator", "agent")
    for service in ("uav", "estimator", "agent"):
        assert not b.settled(1001.0)
        speak(b, service, 1001.0)
    assert b.settled(1001.0)
    assert {name: part["status"] for name, part in b.report(1001.0).items()} == {
        "uav": "ok",
        "estimator": "ok",
        "agent": "ok",
    }


def test_who_is_not_there_is_missing_at_once() -> None:
    b = board("uav", "agent")
    speak(b, "uav", 1001.0)
    speak(b, "agent", 1001.0)
    assert b.settled(1001.0)
    assert b.verdict("estimator", 1001.0) == "missing"


def test_who_is_there_but_has_not_said_that_it_is_ready_is_starting() -> None:
    b = board("estimator")
    assert b.verdict("estimator", 1001.0) == "starting"
    assert not b.settled(1004.9)
    assert b.settled(1005.0)


def test_what_the_bus_has_kept_is_no_sign_of_life() -> None:
    b = board("estimator", only=("estimator",))
    b.hears(health("estimator", 10.0), 1000.1)
    b.hears(health("estimator", 10.0), 1003.0)  # the same message again: a late copy
    assert not b.settled(1004.0)
    assert b.settled(1005.0)
    assert b.verdict("estimator", 1005.0) == "stale"


def test_who_falls_silent_is_stale_after_five_seconds_and_ok_when_it_speaks_again() -> None:
    b = board("agent", only=("agent",))
    speak(b, "agent", 1001.0)
    assert b.verdict("agent", 1005.9) == "ok"
    assert b.verdict("agent", 1006.0) == "stale"
    b.hears(health("agent", 17.0), 1007.0)
    assert b.verdict("agent", 1007.0) == "ok"


def test_who_has_refused_something_lately_is_refusing() -> None:
    b = board("agent", only=("agent",))
    speak(b, "agent", 1001.0, refused_lately=1)
    assert b.verdict("agent", 1001.0) == "refusing"


def test_a_part_that_comes_back_starts_anew() -> None:
    b = board("agent", only=("agent",))
    speak(b, "agent", 1001.0)
    b.lives("agent", False, 1002.0)
    assert b.verdict("agent", 1002.0) == "missing"
    b.lives("agent", True, 1003.0)
    assert b.verdict("agent", 1003.0) == "starting"
    speak(b, "agent", 1004.0)
    assert b.verdict("agent", 1004.0) == "ok"


def test_others_that_are_there_are_shown_behind_and_leave_without_a_trace() -> None:
    b = board("recorder", "uav")
    assert list(b.report(1001.0)) == ["uav", "estimator", "agent", "recorder"]
    b.lives("recorder", False, 1002.0)
    assert list(b.report(1002.0)) == ["uav", "estimator", "agent"]


def test_vehicles_of_a_search_have_a_row_each_also_those_that_came_late_and_are_gone() -> None:
    b = board("estimator")
    assert list(b.report(1001.0)) == ["uav", "estimator", "agent"]
    for vehicle in ("uav/2", "uav/1"):
        b.lives(vehicle, True, 1002.0)
        speak(b, vehicle, 1002.0)
    b.lives("uav/2", False, 1003.0)
    told = {name: part["status"] for name, part in b.report(1003.0).items()}
    assert told == {"uav/1": "ok", "uav/2": "missing", "estimator": "starting", "agent": "missing"}
    assert list(told) == ["uav/1", "uav/2", "estimator", "agent"]


@pytest.mark.parametrize(
    ("about", "rows"),
    [
        ("3 vehicles", ["uav/1", "uav/2", "uav/3"]),
        ("3 vehicles, without uav/1, uav/3", ["uav/2"]),  # who has left, or comes late, is not missed
        ("", ["uav"]),
    ],
)
def test_vehicles_that_the_estimator_searches_with_have_a_row_each_though_none_is_there(
    about: str, rows: list[str]
) -> None:
    b = board("estimator")
    told = f"1000 particles, assume field, stop spread:0.5{about and ', '}{about}"
    b.hears(Health("estimator", "ready", -1, 0.0, 10.0, {}, about=told), 1001.0)
    assert list(b.report(1001.0)) == [*rows, "estimator", "agent"]
    assert b.wanted == sorted([*rows, "estimator", "agent"])
    assert [b.verdict(row, 1001.0) for row in rows] == ["missing"] * len(rows)


def test_where_parts_are_named_uav_stands_for_all_vehicles_of_a_search() -> None:
    b = board("uav/2", only=("uav", "agent"))
    about = "1000 particles, assume field, stop spread:0.5, 2 vehicles"
    b.hears(Health("estimator", "ready", -1, 0.0, 10.0, {}, about=about), 1001.0)
    assert list(b.report(1001.0)) == ["uav/1", "uav/2", "agent"]


@pytest.mark.parametrize("other", ["uav", "recorder"])
def test_where_parts_are_named_all_others_are_left_out(other: str) -> None:
    b = board("estimator", other, only=("estimator",))
    b.lives(other, True, 1000.5)
    speak(b, other, 1001.0)
    assert list(b.report(1001.0)) == ["estimator"]


@pytest.mark.parametrize("text", ["", "agent,", "estimator, agent"])
def test_a_part_without_a_name_is_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args(["--parts", text])
    assert "is not allowed; wanted a part, such as agent or uav/1" in capsys.readouterr().err
