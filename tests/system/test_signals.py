"""Protects that one signal ends a part, and all of a mission, and that the record is then whole."""

import os
import pty
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from link.early import INTERRUPTED
from link.record.reader import read

LONG = ("sitl", "fly", "--policy", "random", "--budget", "100000", "--speedup", "1")
PARTS = ["router", "uav", "estimator", "agent", "record"]


def has_ended(pid: int) -> bool:
    """Whether a process is gone, or only waits to be asked for its status."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.mark.one_in(5)
@pytest.mark.parametrize("part", ["uav", "estimator", "agent", "payload", "bridge", "record"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_part_on_a_quiet_bus_ends_on_one_signal(
    start, router: str, wait_until: Callable, tmp_path: Path, part: str, number: signal.Signals
) -> None:
    words = {
        "uav": ("sitl", "uav"),
        "payload": ("sitl", "payload"),
        "bridge": ("sitl", "bridge", "udpout:127.0.0.1:14599"),
        "record": ("sitl", "record", "it.mcap"),
        "estimator": ("estimator",),
        "agent": ("agent",),
    }
    running = start(*words[part], "--connect", router, cwd=tmp_path)
    wait_until(lambda: running.err or running.out)
    running.process.send_signal(number)
    assert running.ended() in (0, INTERRUPTED)
    assert "Traceback" not in "".join(running.err)


def flying(folder: Path, family: Callable, wait_until: Callable) -> tuple[int, int, dict[str, int]]:
    """Begin a mission on a terminal of its own; returns its process, the terminal's other end, and its
    parts once they record.
    """
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(folder)
        os.execv(sys.executable, [sys.executable, "-m", *LONG])
    said = b""
    while b"step" not in said:
        said += os.read(terminal, 1000)
    parts = family(pid)
    assert sorted(parts) == sorted(PARTS)
    return pid, terminal, parts


@pytest.mark.full
def test_a_mission_whose_terminal_is_closed_ends_and_its_record_is_whole(
    family, wait_until: Callable, tmp_path: Path
) -> None:
    pid, terminal, parts = flying(tmp_path, family, wait_until)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == INTERRUPTED
    assert all(map(has_ended, parts.values()))
    (record,) = (tmp_path / "runs").glob("*.mcap")
    assert read(str(record)).complete


def test_a_hangup_ends_a_mission_as_sigterm_does_with_its_line(
    start, family, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    parts = family(mission.process.pid)
    mission.process.send_signal(signal.SIGHUP)
    assert mission.ended() == INTERRUPTED
    assert mission.err[-1] == "interrupted\n"
    assert all(map(has_ended, parts.values()))
    (record,) = (tmp_path / "runs").glob("*.mcap")
    assert read(str(record)).complete
