"""Protects missions from parts that hang, print without end or leave processes behind, and parts from a
launcher that is gone.
"""

import contextlib
import json
import os
import pty
import select
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.agent.test_policies import install
from tests.system.test_fly import LONG, nothing_is_left, runs

STRANGER = """
    import subprocess

    def loud(belief, particles, reach, rng):
        print("a thought\\n" * 12_000, flush=True)
        return belief.mean

    def messy(belief, particles, reach, rng):
        with open("left.txt", "a") as file:
            print(subprocess.Popen(["sleep", "600"]).pid, file=file)
        return belief.mean
"""


def state(pid: int) -> str:
    """The state of a process in /proc: R or S while it runs, T while it is stopped."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.mark.parametrize(
    "part",
    ["agent", *(pytest.param(part, marks=pytest.mark.full) for part in ("router", "uav", "estimator"))],
)
def test_a_part_that_hangs_is_told_and_ends_the_mission_with_a_line(
    start, family: Callable, wait_until: Callable, tmp_path: Path, part: str
) -> None:
    mission = start(*LONG, "--patience", "10", cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    os.kill(pids[part], signal.SIGSTOP)
    assert mission.ended() == 1
    assert mission.says(f"warning: the {part} has said nothing for 5 s")
    assert mission.err[-1] == f"error: the {part} has said nothing for 10 s (--patience S waits longer)\n"
    assert nothing_is_left(pids)


@pytest.mark.full
def test_a_part_that_comes_back_is_told_and_the_mission_goes_on(
    start, family: Callable, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(
        "sitl",
        "fly",
        "--policy",
        "random",
        "--budget",
        "12",
        "--silence",
        "600",
        "--patience",
        "inf",
        cwd=tmp_path,
    )
    wait_until(lambda: mission.says("step   0"))
    agent = family(mission.process.pid)["agent"]
    os.kill(agent, signal.SIGSTOP)
    wait_until(lambda: mission.says("warning: the agent has said nothing for 5 s"))
    os.kill(agent, signal.SIGCONT)
    assert mission.ended() == 0
    assert mission.says("the agent is back")


@pytest.mark.full
def test_a_recorder_that_hangs_is_told_and_the_mission_ends_without_it(
    start, family: Callable, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start("sitl", "fly", "--policy", "random", "--budget", "20", "--speedup", "2", cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    os.kill(pids["record"], signal.SIGSTOP)
    assert mission.ended() == 0
    assert mission.says("warning: the recorder has said nothing for 5 s")
    assert mission.says("warning: the record lacks the last readings")
    assert mission.out[0].startswith("not ceased after 20 steps, ")
    assert nothing_is_left(pids)


@pytest.mark.full
def test_a_remote_service_that_hangs_ends_the_mission_too(
    start, router: str, wait_until: Callable, tmp_path: Path
) -> None:
    start("estimator", "--connect", router)
    agent = start("agent", "--connect", router, "--policy", "random")
    mission = start(
        "sitl",
        "fly",
        "default-release",
        "--connect",
        router,
        "--speedup",
        "1",
        "--patience",
        "10",
        cwd=tmp_path,
    )
    wait_until(lambda: mission.says("step   0"))
    agent.process.send_signal(signal.SIGSTOP)
    assert mission.ended() == 1
    assert mission.err[-1] == "error: the agent has said nothing for 10 s (--patience S waits longer)\n"


@pytest.mark.full
def test_what_a_script_cuts_off_for_longer_than_the_patience_is_no_hang(start, tmp_path: Path) -> None:
    script = tmp_path / "mission.yaml"
    script.write_text(
        "speedup: 0\nvehicle: {silence_s: 600}\nagent: {policy: random, budget: 4}\n"
        "events: [{step: 1, do: cut, part: agent, for_s: 14}, {step: 3, do: kill, part: estimator, "
        "restart_after_s: 13}]\n"
    )
    mission = start("sitl", "fly", str(script), "--patience", "12", cwd=tmp_path)
    assert mission.ended() == 0, "".join(mission.err)
    assert mission.says("script: link of agent restored")
    assert mission.says("script: estimator started again")


@pytest.fixture
def plugged_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies of another package, available to processes started from now on."""
    (tmp_path / "packages").mkdir()
    install(tmp_path / "packages", "stranger", STRANGER, loud="loud", messy="messy")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "packages"))


@pytest.mark.full
@pytest.mark.usefixtures("plugged_in")
def test_a_policy_that_prints_much_neither_stops_its_mission_nor_mixes_with_the_outcome(
    start, tmp_path: Path
) -> None:
    mission = start(
        "sitl",
        "fly",
        "--policy",
        "loud",
        "--budget",
        "3",
        "--speedup",
        "0",
        "--json",
        "--log-level",
        "info",
        cwd=tmp_path,
    )
    assert mission.ended() == 0
    (outcome,) = mission.out
    assert json.loads(outcome)["steps"] == 3
    assert mission.says("agent: a thought")


@pytest.mark.full
@pytest.mark.usefixtures("plugged_in")
def test_processes_that_a_policy_leaves_behind_end_with_the_mission(
    start, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start("sitl", "fly", "--policy", "messy", "--budget", "3", "--speedup", "0", cwd=tmp_path)
    try:
        assert mission.ended() == 0
        left = {word: int(word) for word in (tmp_path / "left.txt").read_text().split()}
        assert len(left) == 3
        wait_until(lambda: nothing_is_left(left))
    finally:
        for word in (tmp_path / "left.txt").read_text().split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(word), signal.SIGKILL)


@pytest.mark.full
def test_parts_that_have_only_been_started_do_not_outlive_a_launcher_that_is_killed(
    start, family: Callable, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: "router" in family(mission.process.pid))
    pids = family(mission.process.pid)
    mission.kill()
    wait_until(lambda: nothing_is_left(pids))


@pytest.mark.full
def test_ctrl_z_stops_all_of_it_and_it_goes_on_together(
    start, family: Callable, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid) | {"launcher": mission.process.pid}
    mission.process.send_signal(signal.SIGTSTP)
    wait_until(lambda: {state(pid) for pid in pids.values()} == {"T"})
    mission.process.send_signal(signal.SIGCONT)
    wait_until(lambda: "T" not in {state(pid) for pid in pids.values()})
    mission.process.send_signal(signal.SIGINT)
    assert mission.ended() == 130
    assert nothing_is_left(pids)


@pytest.mark.full
def test_ctrl_c_in_a_terminal_ends_all_of_it_in_order(
    family: Callable, wait_until: Callable, tmp_path: Path
) -> None:
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(tmp_path)
        os.execv(sys.executable, [sys.executable, "-m", *LONG])
    shown = b""

    def says(words: bytes) -> bool:
        nonlocal shown
        with contextlib.suppress(OSError):  # it has ended
            while select.select([terminal], [], [], 0.0)[0] and (data := os.read(terminal, 65536)):
                shown += data
        return words in shown

    try:
        wait_until(lambda: says(b"step   0"))
        pids = family(pid)
        assert len(pids) == 5
        os.write(terminal, b"\x03")
        wait_until(lambda: says(b"interrupted") and not runs(pid))
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 130
        assert nothing_is_left(pids)
        assert b"Traceback" not in shown
        assert b"record   runs/" in shown
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        os.close(terminal)
