"""Protects the processes that fly sweeps: all results come, none is awaited for ever, and no worker is
left behind.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from agent.trials.workers import HANDED_OUT, WorkerLost, as_flown
from link.early import INTERRUPTED

pytestmark = pytest.mark.slow


def square(number: int) -> int:
    return number * number


def killed_at(fatal: int, number: int) -> int:
    if number == fatal:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def refused_at(bad: int, number: int) -> int:
    if number == bad:
        raise ValueError(f"{number} is not allowed")
    return number


def hangs(folder: Path, number: int) -> int:
    """All but the first task take for ever; each says who flies it."""
    (folder / str(os.getpid())).touch()
    if number:
        threading.Event().wait()
    return number


def gone(pid: int) -> bool:
    """Whether a process has ended; it may not have been waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.parametrize("workers", [1, 2])
def test_each_task_comes_back_once_with_its_result(workers: int) -> None:
    assert sorted(as_flown(square, range(30), workers)) == [(number, number**2) for number in range(30)]


def test_nothing_to_do_starts_nothing() -> None:
    assert list(as_flown(square, (), 2)) == []


def test_tasks_are_drawn_as_they_are_flown_and_not_all_at_once() -> None:
    drawn: list[int] = []

    def tasks() -> Iterator[int]:
        for number in range(10_000_000):
            drawn.append(number)
            yield number

    flown = as_flown(square, tasks(), 1)
    for count in range(1, 20):
        next(flown)
        assert len(drawn) < count + 2 * HANDED_OUT
    flown.close()


def test_a_killed_worker_ends_the_work_with_an_error_after_all_that_had_ended() -> None:
    flown: list[int] = []
    with pytest.raises(WorkerLost, match="a worker process was killed"):  # noqa: PT012
        for number, _ in as_flown(partial(killed_at, 6), range(100), 1):
            flown.append(number)
    assert sorted(flown) == [0, 1, 2, 3, 4, 5]  # two that ended at once come in any order


def test_what_a_task_raises_comes_after_all_that_had_ended() -> None:
    flown: list[int] = []
    with pytest.raises(ValueError, match="6 is not allowed"):  # noqa: PT012
        for number, _ in as_flown(partial(refused_at, 6), range(100), 1):
            flown.append(number)
    assert set(flown) >= {0, 1, 2, 3, 4, 5}


def test_who_stops_listening_leaves_no_worker_behind(tmp_path: Path, wait_until: Callable) -> None:
    flown = as_flown(partial(hangs, tmp_path), range(100), 2)
    assert next(flown) == (0, 0)
    wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
    flown.close()
    assert all(gone(int(path.name)) for path in tmp_path.iterdir())


HUNG_UP = """
import time
from agent.trials.workers import as_flown
from link import cli
def fly():
    for _ in as_flown(time.sleep, [0, 600], 1):
        print("flying", flush=True)
cli.run(fly)
"""


def test_a_terminal_that_closes_ends_them_all_without_a_word() -> None:
    """It sends SIGHUP to each of them."""
    command = [sys.executable, "-c", HUNG_UP]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **streams, text=True, start_new_session=True) as flying:  # type: ignore[call-overload]
        assert flying.stdout.readline() == "flying\n"
        os.killpg(flying.pid, signal.SIGHUP)
        assert flying.communicate(timeout=400) == ("", "")
    assert flying.returncode == INTERRUPTED
