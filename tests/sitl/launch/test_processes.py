"""Protects the launcher from its parts: whatever they print or leave behind, the launcher continues, and
all of them end.
"""

import contextlib
import os
import queue
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from link.bus.inbox import WAITING_MESSAGES, Inbox
from link.bus.log import Log
from link.bus.session import SIGNAL_POLL_S
from link.bus.tally import OVERFLOW, Tally
from link.early import INTERRUPTED
from sitl.launch import processes as module
from sitl.launch.processes import FLYING, KINDS, RECORDER, Ended, LogLine, MissionFailed, Processes

TOLD = "tests.sitl.launch.told"
LEAVE = """
import subprocess, sys
left = subprocess.Popen(["sleep", "600"], start_new_session={alone})
print("left", left.pid, file=sys.stderr, flush=True)
"""


class Launched:
    """The parts of a test and their events so far."""

    def __init__(self) -> None:
        self.inbox = Inbox()
        self.processes = Processes(self.inbox)
        self._came: list[Any] = []

    @property
    def came(self) -> list[Any]:
        with contextlib.suppress(queue.Empty):
            while True:
                self._came.append(self.inbox.get(timeout=0))
        return self._came

    def lines(self) -> list[str]:
        return [item.line for item in self.came if isinstance(item, LogLine)]

    def ends(self) -> list[Ended]:
        return [item for item in self.came if isinstance(item, Ended)]


@pytest.fixture
def launched() -> Iterator[Launched]:
    given = Launched()
    with given.processes:
        yield given


def runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_part_may_print_what_it_likes_and_it_is_shown_with_its_name(
    launched: Launched, wait_until: Callable
) -> None:
    launched.processes.start(
        "agent", TOLD, "for n in range(2000): print(f'{n:060d}')"
    )  # 120 kB: more than a pipe's 64 kB
    wait_until(launched.ends)
    assert launched.lines() == [f"agent: {n:060d}" for n in range(2000)]
    assert launched.ends() == [Ended("agent", 0, "none")]


def test_bytes_that_are_no_text_and_a_line_without_end_do_no_harm(
    launched: Launched, wait_until: Callable
) -> None:
    source = """
import sys
out = sys.stderr.buffer
out.write(b"caf\\xe9\\n\\n  \\n" + b"x" * 10_000_000)
out.write(b"\\n" + b"y" * 4000 + b"\\nlast")
"""
    launched.processes.start("agent", TOLD, source)
    wait_until(launched.ends)
    assert launched.lines() == ["caf\ufffd", "x" * 4000 + " …", "y" * 4000, "last"]
    assert launched.ends() == [Ended("agent", 0, "last")]


@pytest.mark.parametrize(
    ("said", "last"),
    [
        (["info"], "none"),
        (["warning", "info"], "uav: warning: a warning"),
        (["a traceback", "debug"], "a traceback"),
        (["keeper: warning: it goes on"], "keeper: warning: it goes on"),
        (["warning", "error: link lost", "keeper: warning: it goes on"], "error: link lost"),
    ],
)
def test_the_last_words_of_a_part_are_not_about_its_everyday_work(
    said: list[str], last: str, launched: Launched, wait_until: Callable
) -> None:
    logged = {
        level: f'time=2026-11-29T02:10:18.291Z level={level} service=uav mission=uav/1 step=-1 event="a {level}"'
        for level in ("debug", "info", "warning")
    }
    lines = [logged.get(each, each) for each in said]
    source = (
        f"import os, sys; print(*{lines!r}, sep='\\n', file=sys.stderr, flush=True); os.kill(os.getpid(), 9)"
    )
    launched.processes.start("uav", TOLD, source)
    wait_until(launched.ends)
    assert launched.ends() == [Ended("uav", -9, last)]


def test_of_lines_that_nobody_takes_the_oldest_are_dropped_and_counted(
    launched: Launched, wait_until: Callable
) -> None:
    written = 20 * WAITING_MESSAGES
    child = launched.processes.start("agent", TOLD, f"for n in range({written}): print(n)")
    wait_until(lambda: child.wait(0.01))  # a part blocked on its output would not end
    child.join()
    assert launched.inbox.waiting() == WAITING_MESSAGES + 1
    log = Log("mission", "uav/1", Tally())
    launched.inbox.tell_dropped(log)
    assert log.tally.refused[OVERFLOW] == written - WAITING_MESSAGES
    assert launched.lines() == [f"agent: {n}" for n in range(written - WAITING_MESSAGES, written)]
    assert launched.ends()


@pytest.mark.parametrize("alone", [False, True], ids=["in its group", "in a session of its own"])
def test_what_a_part_leaves_behind_does_not_delay_its_end(
    launched: Launched, wait_until: Callable, alone: bool
) -> None:
    launched.processes.start("agent", TOLD, LEAVE.format(alone=alone))
    wait_until(launched.ends, timeout_s=20)
    (words,) = launched.lines()
    left = int(words.split()[1])
    try:
        if not alone:  # it holds the part's stderr open as long as it lives
            wait_until(lambda: not runs(left))
        assert launched.ends() == [Ended("agent", 0, words)]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(left, signal.SIGKILL)


def test_all_that_a_part_has_started_ends_with_it(launched: Launched, wait_until: Callable) -> None:
    launched.processes.start("agent", TOLD, LEAVE.format(alone=False) + "left.wait()")
    wait_until(launched.lines)
    left = int(launched.lines()[0].split()[1])
    launched.processes.stop()
    wait_until(lambda: not runs(left))


def test_a_stopped_part_is_ended(launched: Launched, wait_until: Callable) -> None:
    launched.processes.start(
        "agent", TOLD, "import os, sys, time; print(os.getpid(), flush=True); time.sleep(600)"
    )
    wait_until(launched.lines)
    pid = int(launched.lines()[0].split()[1])
    os.kill(pid, signal.SIGSTOP)
    launched.processes.stop()
    assert not runs(pid)


@pytest.mark.parametrize("hangs", [False, True])
def test_the_recorder_may_take_its_time_to_write_the_end_of_the_record(
    launched: Launched,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    hangs: bool,
) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.1)
    kind = replace(KINDS[RECORDER], last_task_s=0.3 if hangs else 30.0)
    record = tmp_path / "record"
    source = f"""
import pathlib, signal, time
def write(*_):
    time.sleep({600 if hangs else 0.5})
    pathlib.Path({str(record)!r}).write_text("whole")
    raise SystemExit
signal.signal(signal.SIGTERM, write)
print("recording", flush=True)
time.sleep(600)
"""
    launched.processes.answer(launched.processes.start("recorder", TOLD, source, kind=kind))
    launched.processes.stop()
    assert record.exists() is not hangs
    told = capsys.readouterr().err
    warning = "warning: the recorder hangs and is killed: the record may lack its end\n"
    assert told == "waiting for the recorder to write the end of the record\n" + warning * hangs


def test_a_recorder_that_says_that_it_goes_on_is_waited_for(
    launched: Launched, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It takes longer than its time, but is never as long without a word, also on a busy machine."""
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.1)
    kind = replace(KINDS[RECORDER], last_task_s=10.0)
    record = tmp_path / "record"
    source = f"""
import pathlib, signal, sys, time
def write(*_):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    for _ in range(22):
        time.sleep(0.5)
        print("left", file=sys.stderr, flush=True)
    pathlib.Path({str(record)!r}).write_text("whole")
    raise SystemExit
signal.signal(signal.SIGTERM, write)
print("recording", flush=True)
time.sleep(600)
"""
    launched.processes.answer(launched.processes.start("recorder", TOLD, source, kind=kind))
    launched.processes.stop()
    assert record.exists()
    told = capsys.readouterr().err
    assert "is killed" not in told
    assert "recorder: left\n" in told


FLIES = """
import signal, sys, time, pathlib
def home(*_):
    alive = pathlib.Path("/proc/{other}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    time.sleep({takes_s})
    pathlib.Path({told!r}).write_text("home, and the estimator is " + ("there" if alive else "gone"))
    sys.exit()
signal.signal(signal.SIGTERM, home)
print("flying", flush=True)
time.sleep(600)
"""


def test_a_part_that_flies_a_real_vehicle_ends_first_and_has_time_to_send_it_home(
    launched: Launched,
    wait_until: Callable,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.2)
    said = tmp_path / "said"
    estimator = launched.processes.start(
        "estimator", TOLD, "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    )
    wait_until(launched.lines)
    other = int(launched.lines()[0].split()[1])
    launched.processes.start("uav", TOLD, FLIES.format(other=other, takes_s=0.6, told=str(said)), kind=FLYING)
    wait_until(lambda: "uav: flying" in launched.lines())
    launched.processes.stop()
    assert estimator.wait(0.0)
    assert said.read_text() == "home, and the estimator is there"
    assert capsys.readouterr().err == "waiting for the uav to leave the vehicle safe\n"


def test_a_part_that_flies_a_real_vehicle_and_hangs_is_killed_in_the_end_and_people_are_told(
    launched: Launched,
    wait_until: Callable,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.2)
    source = FLIES.format(other=os.getpid(), takes_s=600, told=os.devnull)
    child = launched.processes.start("uav", TOLD, source, kind=replace(FLYING, last_task_s=0.2))
    wait_until(launched.lines)
    launched.processes.stop()
    assert child.wait(0.0)
    assert "warning: the uav hangs and is killed: its keeper has the vehicle" in capsys.readouterr().err


DEAF = """
import signal, sys, time
def hear(*_):
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
signal.signal(signal.SIGTERM, hear)
print("flying", flush=True)
while True:
    time.sleep(0.05)
"""


def test_a_part_that_has_lost_its_signal_is_told_again(
    launched: Launched,
    wait_until: Callable,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.2)
    launched.processes.start("uav", TOLD, DEAF, kind=FLYING)
    wait_until(launched.lines)
    launched.processes.stop()
    assert (
        capsys.readouterr().err == "waiting for the uav to leave the vehicle safe\n"
    )  # and not that it hangs and is killed


def test_a_part_that_answers_is_waited_for_and_its_answer_is_not_shown(
    launched: Launched, wait_until: Callable
) -> None:
    child = launched.processes.start("recorder", TOLD, "print('recording'); print('more')")
    assert launched.processes.answer(child) == "recording"
    wait_until(launched.ends)
    assert launched.lines() == ["recorder: more"]


def test_a_part_that_ends_instead_of_answering_says_why(launched: Launched) -> None:
    child = launched.processes.start(
        "recorder", TOLD, "import sys; print('error: no room', file=sys.stderr); sys.exit(2)"
    )
    with pytest.raises(MissionFailed, match=r"^no room$") as raised:
        launched.processes.answer(child)
    assert raised.value.status == 2


def test_a_part_that_never_answers_is_told_and_given_up(
    launched: Launched, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "START_WARN_S", SIGNAL_POLL_S)
    monkeypatch.setattr(module, "START_LIMIT_S", 3 * SIGNAL_POLL_S)
    child = launched.processes.start("router", TOLD, "import time; time.sleep(600)")
    with pytest.raises(MissionFailed, match=r"the router has said nothing in 0\.6 s since it was started"):
        launched.processes.answer(child)
    assert capsys.readouterr().err == "waiting for the router to start\n"


def test_why_the_recording_stopped_is_told_also_at_the_missions_end(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A disk that is full when the end of the record is written: nobody reads the inbox any more."""
    launched = Launched()
    launched.inbox.put(Ended("recorder", 1, "recorder: warning: record stopped: No space left on device"))
    launched.processes.stop()
    assert (
        capsys.readouterr().err
        == "warning: the recording stopped: recorder: warning: record stopped: No space left on device\n"
    )


HANGS = """
import os, sys
from link import cli
def in_circles():
    print("going", flush=True)
    while True:
        pass
def command():
    in_circles()
cli.run(command)
"""


@pytest.mark.parametrize("stopped", [False, True], ids=["busy", "stopped"])
def test_before_a_part_that_hangs_is_killed_it_tells_where_it_is(
    launched: Launched, wait_until: Callable, capsys: pytest.CaptureFixture[str], stopped: bool
) -> None:
    child = launched.processes.start("agent", TOLD, "import os; print(os.getpid(), flush=True)" + HANGS)
    wait_until(lambda: "agent: going" in launched.lines())
    if stopped:
        child.signal(signal.SIGSTOP)
    launched.processes.tell_stack("agent")
    launched.processes.tell_stack("of nobody")
    if stopped:
        child.signal(signal.SIGCONT)
    shown = ""

    def told() -> bool:
        nonlocal shown
        shown += capsys.readouterr().err
        return "in_circles" in shown

    wait_until(told)
    launched.processes.stop()
    assert "agent: Stack (most recent call first):" in shown
    assert " in in_circles" in shown
    assert not any("in_circles" in line for line in launched.lines())


def test_a_part_that_would_not_survive_the_question_is_not_asked_for_its_stack(
    launched: Launched, wait_until: Callable
) -> None:
    child = launched.processes.start(
        "agent", TOLD, "import time; print('there', flush=True); time.sleep(600)"
    )
    wait_until(launched.lines)
    launched.processes.tell_stack("agent")
    assert not child.wait(0.2)


def test_a_recorder_that_is_interrupted_before_it_begins_is_no_warning(
    launched: Launched, capsys: pytest.CaptureFixture[str]
) -> None:
    launched.inbox.put(Ended("recorder", INTERRUPTED, "no last words"))
    launched.processes.stop()
    assert capsys.readouterr().err == ""
    assert not launched.processes.has_answered(RECORDER)


def test_a_recorders_answer_counts_even_if_nobody_has_waited_for_it(launched: Launched) -> None:
    child = launched.processes.start("recorder", TOLD, "print('recording')")
    child.join()
    assert launched.processes.has_answered(RECORDER)
