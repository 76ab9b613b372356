"""Protects the command `evaluate`: its figures, its errors, and that an interrupt loses nothing."""

import csv
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.system.live import run_agent

QUICK = (
    "agent",
    "evaluate",
    "--policy",
    "greedy,thompson",
    "--first-seed",
    "7",
    "--particles",
    "100",
    "--budget",
    "40",
    "--workers",
    "2",
)


def test_it_prints_the_figures_as_json_and_writes_a_row_a_mission(start, tmp_path: Path) -> None:
    sweep = start(*QUICK, "--scenarios", "3", "--json", "--missions", "missions.csv", cwd=tmp_path)
    assert sweep.ended() == 0, "".join(sweep.err)
    figures = json.loads(sweep.out[-1])
    assert list(figures) == ["greedy", "thompson"]
    wanted = {
        "missions",
        "ceased",
        "located",
        "false_stop",
        "mtd_m",
        "mtd_floors",
        "nees_mean",
        "search_time_s",
        "decision_ms",
        "update_ms",
    }
    assert wanted < set(figures["greedy"])
    rows = list(csv.DictReader((tmp_path / "missions.csv").read_text().splitlines()))
    assert [(row["policy"], row["seed"]) for row in rows] == [
        (name, seed) for name in figures for seed in "789"
    ]
    assert figures["greedy"]["ceased"] == pytest.approx(sum(row["ceased"] == "True" for row in rows[:3]) / 3)
    assert not list((tmp_path / "runs").iterdir())  # a completed sweep removes its journal


@pytest.mark.full
def test_an_interrupted_sweep_goes_on_where_it_was(start, tmp_path: Path, wait_until: Callable) -> None:
    command = (*QUICK, "--scenarios", "300", "--json")
    first = start(*command, cwd=tmp_path)
    wait_until(lambda: any(path.read_bytes().count(b"\n") > 5 for path in tmp_path.glob("runs/*.jsonl")))
    first.process.send_signal(signal.SIGINT)
    assert first.ended() == 130
    assert any("Run the command again: it resumes" in line for line in first.err)
    (journal,) = tmp_path.glob("runs/*.jsonl")
    kept = journal.read_bytes()
    second = start(*command, cwd=tmp_path)
    wait_until(lambda: len(journal.read_bytes()) > len(kept))
    assert journal.read_bytes().startswith(kept)
    second.process.send_signal(signal.SIGINT)
    assert second.ended() == 130


def workers(pid: int) -> list[int]:
    """The worker processes of a sweep."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in children if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()]


def gone(pid: int) -> bool:
    """True if a process has ended, also if nobody has waited for it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def flying(sweep, folder: Path) -> bool:
    """True if some missions have been flown."""
    return len(workers(sweep.process.pid)) == 2 and any(
        path.read_bytes().count(b"\n") > 5 for path in folder.glob("runs/*.jsonl")
    )


@pytest.mark.full
def test_a_killed_worker_ends_the_sweep_with_a_line_and_nothing_is_lost(
    start, tmp_path: Path, wait_until: Callable
) -> None:
    command = (*QUICK, "--scenarios", "5000")
    sweep = start(*command, cwd=tmp_path)
    wait_until(lambda: flying(sweep, tmp_path))
    first, second = workers(sweep.process.pid)
    os.kill(first, signal.SIGKILL)
    assert sweep.ended() == 1
    (journal,) = tmp_path.glob("runs/*.jsonl")
    kept = journal.read_bytes()
    count = len([line for line in kept.splitlines() if line])
    assert sweep.err[-1] == (
        "error: a worker process was killed; the memory may have run out; "
        f"{count} of 10000 missions are saved. Run the command again: it resumes\n"
    )
    assert not sweep.says("Traceback")
    assert gone(second)
    again = start(*command, cwd=tmp_path)
    wait_until(lambda: len(journal.read_bytes()) > len(kept) + 1)
    assert journal.read_bytes().startswith(kept)
    again.process.send_signal(signal.SIGINT)
    assert again.ended() == 130


@pytest.mark.parametrize("when", ["as it flies", pytest.param("as it starts", marks=pytest.mark.full)])
def test_an_interrupt_from_the_terminal_is_one_line_and_leaves_no_worker(
    start, tmp_path: Path, wait_until: Callable, when: str
) -> None:
    sweep = start(*QUICK, "--scenarios", "5000", cwd=tmp_path)
    wait_until(lambda: flying(sweep, tmp_path) if when == "as it flies" else workers(sweep.process.pid))
    pids = workers(sweep.process.pid)
    for pid in (*pids, sweep.process.pid):  # as a terminal does: to all processes
        os.kill(pid, signal.SIGINT)
    assert sweep.ended() == 130
    assert sweep.err[-1].startswith("interrupted: ")
    assert not sweep.says("Traceback")
    assert not sweep.says("KeyboardInterrupt")
    assert all(map(gone, pids))


@pytest.mark.full
def test_workers_do_not_outlive_a_killed_sweep(start, tmp_path: Path, wait_until: Callable) -> None:
    sweep = start(*QUICK, "--scenarios", "5000", cwd=tmp_path)
    wait_until(lambda: flying(sweep, tmp_path))
    pids = workers(sweep.process.pid)
    sweep.process.kill()
    wait_until(lambda: all(map(gone, pids)))


@pytest.mark.full
def test_a_table_that_exists_is_written_over_only_when_asked_to(start, tmp_path: Path) -> None:
    table = tmp_path / "missions.csv"
    table.write_text("a year's work\n")
    command = (*QUICK, "--scenarios", "2", "--missions", "missions.csv")
    refused = start(*command, cwd=tmp_path)
    assert refused.ended() == 2
    assert refused.err == ["error: --missions: 'missions.csv' exists; wanted another name, or --force\n"]
    assert [path.name for path in tmp_path.iterdir()] == ["missions.csv"]  # nothing was flown
    assert table.read_text() == "a year's work\n"
    assert start(*command, "--force", cwd=tmp_path).ended() == 0
    assert len(table.read_text().splitlines()) == 1 + 2 * 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["missions.csv", "runs"]


@pytest.mark.full
def test_a_table_can_go_through_a_pipe(start, tmp_path: Path) -> None:
    sweep = start(*QUICK, "--scenarios", "1", "--missions", "/dev/stdout", cwd=tmp_path)
    assert sweep.ended() == 0, "".join(sweep.err)
    assert [row["policy"] for row in csv.DictReader(sweep.out)] == ["greedy", "thompson"]


@pytest.mark.full
def test_a_table_that_cannot_be_written_loses_nothing(start, tmp_path: Path) -> None:
    command = (*QUICK, "--scenarios", "2", "--missions")
    refused = start(*command, "/dev/full", cwd=tmp_path)
    assert refused.ended() == 2
    assert "error: --missions: " in refused.err[-1]
    (journal,) = tmp_path.glob("runs/*.jsonl")
    kept = [line for line in journal.read_bytes().splitlines() if line]
    assert len(kept) == 2 * 2
    assert start(*command, "missions.csv", cwd=tmp_path).ended() == 0
    assert len((tmp_path / "missions.csv").read_text().splitlines()) == 1 + len(kept)


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (("--policy", "greedy,clairvoyance"), "--policy: 'clairvoyance' is not allowed; wanted infotaxis, "),
        (
            ("--particles", "100,3"),
            "--particles: '3' is not allowed; wanted a whole number from 10 to 1000000",
        ),
        (("--threshold", "0.5,"), "--threshold: '' is not allowed; wanted a number above 0 up to 100"),
        (("--scenarios", "0"), "--scenarios: '0' is not allowed"),
        (("--headings", "5"), "--headings: 5 is not allowed; wanted 4 or 8"),
        (("--missions", "/tmp"), "--missions: '/tmp' is a folder; wanted a file"),
        (
            ("--missions", "nowhere/missions.csv"),
            "--missions: 'nowhere/missions.csv' cannot be written: No such file or directory",
        ),
        (
            ("--missions", "/proc/missions.csv"),
            "--missions: '/proc/missions.csv' cannot be written: No such file or directory",
        ),
        (("--assume", "paper", "--stop-on", "q=3"), "--stop-on: 'q=3' is not allowed"),
    ],
)
def test_bad_input_is_one_line_that_says_what_is_allowed(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    flags: tuple[str, str],
    error: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    status, _, err = run_agent(monkeypatch, capsys, *QUICK[1:], *flags)
    assert status == 2
    (line,) = err
    assert error in line


def test_bad_input_is_the_end_of_the_command_with_status_2(start, tmp_path: Path) -> None:
    sweep = start(*QUICK, "--scenarios", "0", cwd=tmp_path)
    assert sweep.ended() == 2
    assert len(sweep.err) == 1
