"""Protects what operators search: one line an event, whatever the text holds, with service, mission and step; people get it plain."""

import re

import pytest

from link.bus.log import Event, Log, parse
from link.bus.tally import Tally


def test_an_event_is_one_line_with_its_time_level_service_mission_and_step(capsys: pytest.CaptureFixture[str]) -> None:
    tally = Tally(step=12)
    Log("uav", "uav/3", tally).info("Landed")
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(r'time=\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z level=info service=uav mission=uav/3 step=12 event="Landed"\n', err)


@pytest.mark.parametrize(
    "text", ["two\nlines", 'said "no"', "back\\slash", "tab\tand ± and \x1b[31m", "\u2028 and \x9b31m", "a=b level=error", ""]
)
def test_whatever_is_said_stays_on_one_line_and_reads_back(capsys: pytest.CaptureFixture[str], text: str) -> None:
    Log("agent", "uav/1", Tally()).warn(text)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert parse(line) == Event("warning", f"agent: warning: {text}")


def test_people_read_the_service_and_what_it_said() -> None:
    line = 'time=2026-11-22T03:24:26.793Z level={} service=estimator mission=uav/1 step=47 event="ceased"'
    assert [parse(line.format(level)).text for level in ("debug", "info", "warning")] == [
        "estimator: ceased",
        "estimator: ceased",
        "estimator: warning: ceased",
    ]


def test_a_line_that_is_no_event_is_shown_as_it_is() -> None:
    assert parse("error: --connect: no router at tcp/127.0.0.1:1") == Event("info", "error: --connect: no router at tcp/127.0.0.1:1")


@pytest.mark.parametrize(("least", "written"), [("debug", 3), ("info", 2), ("warning", 1), ("error", 0)])
def test_what_is_below_the_level_is_not_written(capsys: pytest.CaptureFixture[str], least: str, written: int) -> None:
    log = Log("uav", "uav/1", Tally(), least)
    log.debug("a step")
    log.info("landed")
    log.warn("no setpoint")
    assert len(capsys.readouterr().err.splitlines()) == written


def test_the_last_error_is_known_even_where_it_is_not_written(capsys: pytest.CaptureFixture[str]) -> None:
    tally = Tally()
    log = Log("uav", "uav/1", tally, "error")
    log.warn("no setpoint")
    log.info("landed")
    assert tally.last_error == "no setpoint"
