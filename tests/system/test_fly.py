"""Protects `python -m sitl`: what it prints, what it leaves behind, and how it ends when a part dies or somebody interrupts."""

import json
import os
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from link.record.reader import read

PARTS = ["router", "uav", "estimator", "agent"]
LONG = ("sitl", "fly", "--policy", "random", "--speedup", "4")  # 300 moves take 87 s at this speed-up


def runs(pid: int) -> bool:
    """True if a process still runs; an ended one whose parent was killed may stay for a while until init collects it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def nothing_is_left(pids: dict[str, int]) -> bool:
    return not any(map(runs, pids.values()))


def test_it_flies_to_a_stop_and_says_what_it_found(start, tmp_path: Path) -> None:
    mission = start("sitl", "--seed", "1", "--speedup", "0", "--json", cwd=tmp_path)
    assert mission.ended() == 0
    said = "".join(mission.err)
    for words in ("router at tcp/127.0.0.1:", "step   0/300", "spread", "located after", "estimate (", "source   (14.85, 14.67), error"):
        assert words in said
    result = json.loads(mission.out[-1])
    assert result["ceased"]
    assert result["error_m"] == pytest.approx(
        ((result["estimate"][0] - result["source"][0]) ** 2 + (result["estimate"][1] - result["source"][1]) ** 2) ** 0.5
    )
    assert sorted(path.suffix for path in (tmp_path / "runs").iterdir()) == [".json", ".mcap", ".tlog"]
    (summary,) = (tmp_path / "runs").glob("*.json")
    written = json.loads(summary.read_text())
    assert written["outcome"]["estimate"] == result["estimate"]
    assert len(written["outcome"]["trace"]) == result["steps"] + 1
    assert written["mission"]["seed"] == 1


def test_the_first_flight_says_once_that_it_compiles(start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))  # empty; estimator and agent compile at the same time
    brief = ("sitl", "fly", "--policy", "infotaxis", "--budget", "1", "--speedup", "0", "--no-record")
    for expected in (1, 0):
        mission = start(*brief, cwd=tmp_path)
        assert mission.ended(100) == 0
        before = mission.err[: next(number for number, line in enumerate(mission.err) if line.startswith("mission: "))]
        assert sum("compiling kernels" in line for line in mission.err) == expected
        assert sum(line == "compiling kernels, once, about 15 s\n" for line in before) == expected


def test_a_spent_budget_is_an_outcome_not_a_failure(start, tmp_path: Path) -> None:
    mission = start("sitl", "fly", "--policy", "random", "--budget", "3", "--speedup", "0", "--json", cwd=tmp_path)
    assert mission.ended() == 0
    result = json.loads(mission.out[-1])
    assert (result["ceased"], result["located"], result["steps"]) == (False, False, 3)


@pytest.mark.parametrize("flags", [(), ("--json",)], ids=["text", "json"])
def test_results_go_to_stdout_unless_json_does_and_no_line_wraps_at_60_columns(start, tmp_path: Path, flags: tuple[str, ...]) -> None:
    mission = start("sitl", "fly", "--policy", "random", "--budget", "12", "--speedup", "0", *flags, cwd=tmp_path)
    assert mission.ended() == 0
    results, progress = (mission.err[-6:], mission.err[:-6]) if flags else (mission.out, mission.err)
    assert [line.split()[0] for line in results] == ["not", "estimate", "source", "assumed", "summary", "record"]
    assert [line.split()[0] for line in progress if line.startswith(("mission", "router", "step"))] == [
        "mission:",
        "router",
        "step",
        "step",
    ]
    assert max(len(line.rstrip("\n")) for line in (*results, *progress)) <= 60
    assert len(mission.out) == (1 if flags else 6)
    assert all(Path(tmp_path, line.split()[1]).is_file() for line in results[4:])


@pytest.mark.parametrize("part", PARTS)
def test_a_part_that_dies_is_named_and_ends_the_mission(start, family, wait_until: Callable, tmp_path: Path, part: str) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    os.kill(pids[part], signal.SIGKILL)
    assert mission.ended() == 1
    assert f"error: {part} was killed by signal 9; its last words: " in mission.err[-1]
    assert nothing_is_left(pids)


def test_a_recorder_that_dies_is_told_and_the_mission_goes_on(start, family, wait_until: Callable, tmp_path: Path) -> None:
    mission = start("sitl", "fly", "--policy", "random", "--budget", "12", cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    os.kill(family(mission.process.pid)["record"], signal.SIGKILL)
    assert mission.ended() == 0
    assert mission.says("warning: the recording stopped: ")
    assert mission.out[0].startswith("not ceased after 12 steps, ")


@pytest.mark.parametrize("hit", ["launcher", *PARTS])
def test_ctrl_c_ends_all_of_it_whichever_process_it_hits(start, family, wait_until: Callable, tmp_path: Path, hit: str) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    assert sorted(pids) == sorted([*PARTS, "record"])
    port = int(next(line for line in mission.err if "router at" in line).rpartition(":")[2])
    os.kill(mission.process.pid if hit == "launcher" else pids[hit], signal.SIGINT)
    assert mission.ended() == 130
    assert nothing_is_left(pids)
    assert {path.suffix for path in (tmp_path / "runs").iterdir()} == {".mcap", ".tlog"}  # the flown part is recorded
    assert "Traceback" not in "".join(mission.err)
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


def test_parts_do_not_outlive_a_launcher_that_is_killed(start, family, wait_until: Callable, tmp_path: Path) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    mission.kill()
    wait_until(lambda: nothing_is_left(pids))


def test_an_interrupt_while_it_starts_leaves_nothing_behind(start, family, wait_until: Callable, tmp_path: Path) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: "router" in family(mission.process.pid))
    pids = family(mission.process.pid)
    mission.process.send_signal(signal.SIGINT)
    assert mission.ended() == 130
    assert nothing_is_left(pids)


def test_an_unknown_policy_is_one_line_and_status_2(start, tmp_path: Path) -> None:
    mission = start("sitl", "fly", "--policy", "clairvoyance", cwd=tmp_path)
    assert mission.ended() == 2
    (line,) = mission.err
    assert line.startswith("error: --policy: 'clairvoyance' is not allowed; wanted infotaxis, entrotaxis, ")


def test_an_occupied_port_is_one_line_and_status_2(start, router: str, tmp_path: Path) -> None:
    for command in (("sitl", "router"), ("sitl", "fly")):
        ended = start(*command, "--listen", router, cwd=tmp_path)
        assert ended.ended() == 2
        assert ended.err == [f"error: --listen: cannot listen on {router}: Address already in use\n"]


def test_an_unreachable_router_is_one_line_and_status_2(start) -> None:
    services = ("sitl", "uav"), ("estimator",), ("agent",)
    for ended in [start(*service, "--connect", "tcp/127.0.0.1:1") for service in services]:  # all parts wait for the router at once
        assert ended.ended() == 2
        assert ended.err == ["error: --connect: no router at tcp/127.0.0.1:1 (start one with: plumeward router)\n"]


def test_a_place_that_cannot_be_written_is_one_line_and_status_2_and_nothing_flies(start, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.mcap").mkdir()
    for place, why in (("file/flight.mcap", "cannot write 'file/flight.mcap': "), ("folder.mcap", "'folder.mcap' is a folder")):
        mission = start("sitl", "fly", "--speedup", "0", "--record", place, "--force", cwd=tmp_path)
        assert mission.ended() == 2
        (line,) = mission.err
        assert line.startswith(f"error: --record: {why}")


def test_where_runs_cannot_be_written_a_mission_without_a_record_is_flown_and_lacks_its_summary(start, tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("in the way")
    brief = ("sitl", "fly", "--budget", "2", "--speedup", "0", "--json")
    assert start(*brief, cwd=tmp_path).ended() == 2
    mission = start(*brief, "--no-record", cwd=tmp_path)
    assert mission.ended() == 0
    assert mission.says("warning: no summary written to runs/")
    assert json.loads(mission.out[-1])["steps"] == 2


def test_what_exists_is_not_overwritten_without_force(start, wait_until: Callable, tmp_path: Path) -> None:
    for name in ("good.mcap", "good.tlog"):
        (tmp_path / name).write_text("old")
    brief = ("sitl", "fly", "--budget", "2", "--speedup", "0", "--record", "good.mcap")
    refused = start(*brief, cwd=tmp_path)
    assert refused.ended() == 2
    assert refused.err == ["error: --record: 'good.mcap' exists; wanted another name, or --force\n"]
    for flags in ((), ("--force",)):
        assert start(*brief, *flags, "--prior", "nonsense", cwd=tmp_path).ended() == 2
        assert {path.name: path.read_text() for path in tmp_path.iterdir() if path.is_file()} == {"good.mcap": "old", "good.tlog": "old"}
    forced = start(*brief, "--force", cwd=tmp_path)
    assert forced.ended() == 0
    assert forced.out[-1] == "record   good.mcap\n"
    assert read(tmp_path / "good.mcap").complete
    assert (tmp_path / "good.tlog").stat().st_size > 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.mcap", "good.tlog", "runs"]


def test_a_second_launch_of_the_same_record_is_refused_and_leaves_the_firsts(start, wait_until: Callable, tmp_path: Path) -> None:
    first = start(*LONG, "--record", "flight.mcap", cwd=tmp_path)
    wait_until(lambda: first.says("step   0"))
    second = start(*LONG, "--record", "flight.mcap", cwd=tmp_path)
    assert second.ended() == 2
    assert second.err == ["error: --record: 'flight.mcap' exists; wanted another name, or --force\n"]
    first.process.send_signal(signal.SIGINT)
    assert first.ended() == 130
    assert read(tmp_path / "flight.mcap").complete


def test_without_a_record_there_is_none_and_a_chosen_place_is_kept_to(start, tmp_path: Path) -> None:
    brief = ("sitl", "fly", "--budget", "2", "--speedup", "0")
    assert start(*brief, "--no-record", cwd=tmp_path).ended() == 0
    assert [path.suffix for path in (tmp_path / "runs").iterdir()] == [".json"]
    assert start(*brief, "--record", "mine/flight.mcap", cwd=tmp_path).ended() == 0
    assert sorted(path.name for path in (tmp_path / "mine").iterdir()) == ["flight.mcap", "flight.tlog"]


def test_at_log_level_debug_each_service_tells_each_step_and_otherwise_only_what_goes_wrong(start, tmp_path: Path) -> None:
    brief = ("sitl", "fly", "--budget", "5", "--speedup", "0", "--no-record")
    quiet, loud = (start(*brief, *level, cwd=tmp_path) for level in ((), ("--log-level", "debug")))
    assert quiet.ended() == loud.ended() == 0
    assert not quiet.says("ready")
    assert loud.says("estimator: ready: 1000 particles")
    for line in ("estimator: answered after ", "agent: answered after ", "uav: reading "):  # the last ones may be cut off by the end
        assert sum(said.startswith(line) for said in loud.err) >= 1
