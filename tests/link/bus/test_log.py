"""Protects the log: one line per event, whatever its text, with service, mission and step; and its
readable form.
"""

import io
import logging
import os
import re
import sys
import threading
from collections.abc import Callable

import pytest

from link.bus.log import Log, parse
from link.bus.tally import Tally


def test_an_event_is_one_line_with_its_time_level_service_mission_and_step(
    capsys: pytest.CaptureFixture[str],
) -> None:
    tally = Tally(step=12)
    Log("uav", "uav/3", tally).info("Landed")
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(
        r"time=\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z level=info service=uav mission=uav/3 step=12 "
        r'event="Landed"\n',
        err,
    )


@pytest.mark.parametrize(
    "text",
    [
        "two\nlines",
        'said "no"',
        "back\\slash",
        "tab\tand ± and \x1b[31m",
        "\u2028 and \x9b31m",
        "a=b level=error",
        "",
    ],
)
def test_whatever_is_said_stays_on_one_line_and_reads_back(
    capsys: pytest.CaptureFixture[str], text: str
) -> None:
    Log("agent", "uav/1", Tally()).warning(text)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    indented = text.replace("\n", "\n  ")  # a service's text never looks like another service's line
    assert parse(line) == ("warning", f"agent: warning: {indented}")


def test_people_read_the_service_and_what_it_said() -> None:
    line = 'time=2026-11-22T03:24:26.793Z level={} service=estimator mission=uav/1 step=47 event="ceased"'
    assert [parse(line.format(level))[1] for level in ("debug", "info", "warning")] == [
        "estimator: ceased",
        "estimator: ceased",
        "estimator: warning: ceased",
    ]


def test_a_line_that_is_no_event_is_shown_as_it_is() -> None:
    assert parse("error: --connect: no router at tcp/127.0.0.1:1") == (
        "info",
        "error: --connect: no router at tcp/127.0.0.1:1",
    )


@pytest.mark.parametrize(("least", "written"), [("debug", 3), ("info", 2), ("warning", 1), ("error", 0)])
def test_what_is_below_the_level_is_not_written(
    capsys: pytest.CaptureFixture[str], least: str, written: int
) -> None:
    log = Log("uav", "uav/1", Tally(), least)
    log.debug("a step")
    log.info("landed")
    log.warning("no setpoint")
    assert len(capsys.readouterr().err.splitlines()) == written


def test_the_last_error_is_known_even_where_it_is_not_written(capsys: pytest.CaptureFixture[str]) -> None:
    tally = Tally()
    log = Log("uav", "uav/1", tally, "error")
    log.warning("no setpoint")
    log.info("landed")
    assert tally.last_error == "no setpoint"


def test_two_of_one_service_each_write_their_own_line_at_their_own_level(
    capsys: pytest.CaptureFixture[str],
) -> None:
    tallies = Tally(step=1), Tally(step=2)
    one, two = (
        Log("uav", mission, tally, least)
        for mission, tally, least in zip(("uav/1", "uav/2"), tallies, ("debug", "warning"), strict=True)
    )
    one.debug("a step")
    two.debug("a step")
    two.warning("no setpoint")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == [
        'level=debug service=uav mission=uav/1 step=1 event="a step"',
        'level=warning service=uav mission=uav/2 step=2 event="no setpoint"',
    ]
    assert [tally.last_error for tally in tallies] == ["", "no setpoint"]


def test_the_users_own_logging_is_left_alone(capsys: pytest.CaptureFixture[str]) -> None:
    root, heard = logging.getLogger(), io.StringIO()
    before = root.level, root.handlers[:]
    handler = logging.StreamHandler(heard)
    root.addHandler(handler)
    try:
        Log("uav", "uav/1", Tally()).warning("no setpoint")
        logging.getLogger("theirs").warning("theirs")
    finally:
        root.removeHandler(handler)
    assert heard.getvalue() == "theirs\n"
    assert "theirs" not in capsys.readouterr().err
    assert (root.level, root.handlers) == before


def test_what_other_code_says_to_our_logger_is_a_line_too(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.getLogger("plumeward.udp")
    try:
        raise ValueError("no\nframe")
    except ValueError:
        logger.exception("%s was not handled", "HEARTBEAT")
    logger.critical("the end")
    first, second = capsys.readouterr().err.splitlines()
    level, text = parse(first)
    assert level == "error"
    assert text.startswith("plumeward.udp: error: HEARTBEAT was not handled\n  Traceback")
    assert text.endswith("ValueError: no\n  frame")
    assert parse(second) == ("error", "plumeward.udp: error: the end")


@pytest.mark.parametrize(
    "event", ['"a"time=1 level=info service=uav mission=uav/1 step=1 event="b"', '"\\"', '"\\x"']
)
def test_a_line_that_two_wrote_into_is_shown_as_it_is(event: str) -> None:
    line = f"time=1 level=info service=uav mission=uav/1 step=1 event={event}"
    assert parse(line) == ("info", line)


def test_a_level_that_there_is_not_is_no_event() -> None:
    line = 'time=1 level=fatal service=uav mission=uav/1 step=1 event="gone"'
    assert parse(line) == ("info", line)


def test_threads_do_not_write_into_each_others_lines(capsys: pytest.CaptureFixture[str]) -> None:
    log = Log("uav", "uav/1", Tally())
    threads = [threading.Thread(target=lambda: [log.info("x" * 200) for _ in range(200)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {parse(line)[1] for line in capsys.readouterr().err.splitlines()} == {"uav: " + "x" * 200}


def test_a_log_that_cannot_be_written_ends_no_service(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Broken())
    Log("uav", "uav/1", Tally()).info("Landed")


def test_each_line_is_flushed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines logged before a service is killed are not lost."""

    class Pipe(io.StringIO):
        flushed = ""

        def flush(self) -> None:
            self.flushed = self.getvalue()

    pipe = Pipe()
    monkeypatch.setattr(sys, "stderr", pipe)
    log = Log("uav", "uav/1", Tally())
    for count in (1, 2):
        log.info("Landed")
        assert pipe.flushed.count("Landed") == count


def test_a_log_that_nobody_reads_never_waits_and_says_later_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, wait_until: Callable[..., None]
) -> None:
    """A launcher that is stopped, or a terminal: the loop of a vehicle in the air must go on."""
    read_end, write_end = os.pipe()
    with open(read_end) as reader, open(write_end, "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        log = Log("uav", "uav/1", Tally())

        def write() -> None:
            for number in range(500):
                log.info(
                    f"{number} {'x' * 5000}"
                )  # more than a pipe's 64 kB in all, and each more than it takes at once

        writer = threading.Thread(target=write, daemon=True)
        writer.start()
        wait_until(lambda: not writer.is_alive(), 60.0)
        os.set_blocking(read_end, False)
        read = reader.read()
        assert 'event="0 xxx' in read
        log.info("on")
        *_, missing, last = [parse(line) for line in reader.read().splitlines()]
        assert last == ("info", "uav: on")
        assert missing[0] == "warning"
        assert (
            int(missing[1].split()[2]) + len([line for line in read.splitlines() if line.endswith('"')])
            == 500
        )
