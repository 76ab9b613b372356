"""Protects `python -m sitl`: what it prints, what it leaves behind, and how it ends when a part dies or
somebody interrupts.
"""

import json
import math
import os
import shutil
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from link.bus.opening import NoRouter
from link.record.reader import read
from plume.geodesy import HOME
from tests.system.conftest import Part
from tests.system.live import run_sitl

PARTS = ["router", "uav", "estimator", "agent"]
LONG = ("sitl", "fly", "--policy", "random", "--speedup", "4")  # 300 moves take 87 s at this speed-up
SURVEY = Path(__file__).parents[2] / "docs" / "examples" / "lawnmower.csv"
M_PER_DEGREE = 6_371_000 * math.pi / 180  # to the north


class Flight(NamedTuple):
    """What a mission printed, line by line, and the folder that it was flown in."""

    out: list[str]
    err: list[str]
    folder: Path


def fly(folder: Path, *words: str) -> Flight:
    """A mission as fast as it goes."""
    part = Part("sitl", "fly", "--speedup", "0", *words, cwd=folder)
    assert part.ended() == 0, "".join(part.err)
    return Flight(part.out, part.err, folder)


def runs(pid: int) -> bool:
    """True if a process still runs; an ended one whose parent was killed may stay for a while until init
    collects it.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def nothing_is_left(pids: dict[str, int]) -> bool:
    return not any(map(runs, pids.values()))


@pytest.fixture(scope="module")
def to_the_stop(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """A mission that finds its source, with its result as JSON, and its findings."""
    return fly(tmp_path_factory.mktemp("stop"), "--seed", "1", "--json", "--findings", "found")


@pytest.fixture(scope="module")
def in_vain(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """A mission whose budget is spent before it finds anything, with its result as text."""
    return fly(tmp_path_factory.mktemp("vain"), "--policy", "random", "--budget", "12")


@pytest.fixture(scope="module")
def talkative(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """A short mission at the log level debug, without a record."""
    return fly(
        tmp_path_factory.mktemp("debug"),
        "--policy",
        "random",
        "--budget",
        "5",
        "--no-record",
        "--log-level",
        "debug",
        "--json",
    )


def test_it_flies_to_a_stop_and_says_what_it_found(to_the_stop: Flight) -> None:
    said = "".join(to_the_stop.err)
    for words in (
        "router at tcp/127.0.0.1:",
        "step   0/300",
        "spread",
        "located after",
        "estimate (",
        "source   (14.85, 14.67), error",
    ):
        assert words in said
    result = json.loads(to_the_stop.out[-1])
    assert result["ceased"]
    assert result["error_m"] == pytest.approx(
        (
            (result["estimate"][0] - result["source"][0]) ** 2
            + (result["estimate"][1] - result["source"][1]) ** 2
        )
        ** 0.5
    )


def test_it_leaves_a_summary_a_record_and_a_telemetry_log(to_the_stop: Flight) -> None:
    assert sorted(path.suffix for path in (to_the_stop.folder / "runs").iterdir()) == [
        ".json",
        ".mcap",
        ".tlog",
    ]
    (summary,) = (to_the_stop.folder / "runs").glob("*.json")
    result, written = json.loads(to_the_stop.out[-1]), json.loads(summary.read_text())
    assert written["outcome"]["estimate"] == result["estimate"]
    assert len(written["outcome"]["trace"]) == result["steps"] + 1
    assert written["mission"]["seed"] == 1


def test_its_findings_say_the_same_as_its_result_and_where_on_earth_that_is(to_the_stop: Flight) -> None:
    found = to_the_stop.folder / "found"
    assert {path.suffix for path in found.iterdir()} == {".html", ".geojson", ".kml", ".json", ".csv"}
    result, findings = json.loads(to_the_stop.out[-1]), json.loads((found / "findings.json").read_text())
    assert findings["verdict"] == "found"
    for name in ("latitude_deg", "longitude_deg", "rate_gs"):
        assert findings[name] == pytest.approx(result[name], rel=1e-5)
    east, north = result["estimate"]
    latitude_deg = HOME[0] + north / M_PER_DEGREE
    assert result["latitude_deg"] == pytest.approx(latitude_deg, abs=1e-8)
    longitude_deg = HOME[1] + east / M_PER_DEGREE / math.cos(math.radians(latitude_deg))
    assert result["longitude_deg"] == pytest.approx(longitude_deg, abs=1e-8)
    xx, _, yy = result["covariance_m2"]
    assert xx + yy == pytest.approx(result["spread_m"] ** 2)
    low, high = result["rate_interval_gs"]
    assert low < result["rate_gs"] < high
    assert low < result["scenario"]["q"] < high
    assert {"_deg", "_gs", "_m2"} <= {ending.removeprefix("*") for ending in result["units"]}


@pytest.mark.full
def test_a_spent_budget_is_an_outcome_not_a_failure(talkative: Flight) -> None:
    result = json.loads(talkative.out[-1])
    assert (result["ceased"], result["located"], result["steps"]) == (False, False, 5)


@pytest.mark.full
def test_results_go_to_stdout_unless_json_does_and_no_line_wraps_at_60_columns(
    in_vain: Flight, to_the_stop: Flight
) -> None:
    found = next(i for i, line in enumerate(to_the_stop.err) if line.startswith("located"))
    sentence = next(i for i, line in enumerate(to_the_stop.err) if line.startswith("A source was found"))
    assert to_the_stop.err[sentence + 1 :] == ["findings found/findings.html\n"]
    for mission, results, progress, verdict in (
        (in_vain, in_vain.out, in_vain.err, "not"),
        (to_the_stop, to_the_stop.err[found:sentence], to_the_stop.err[:found], "located"),
    ):
        gas = ["gas"] if any(line.startswith("assumed  field") for line in results) else []
        assert [line.split()[0] for line in results] == [
            verdict,
            "estimate",
            "source",
            "assumed",
            *gas,
            "summary",
            "record",
        ]
        heads = [line.split()[0] for line in progress if line.startswith(("mission", "router", "step"))]
        assert heads[:3] == ["mission:", "router", "step"]
        assert set(heads[3:]) == {"step"}
        assert max(len(line.rstrip("\n")) for line in (*results, *progress)) <= 60
        assert all(Path(mission.folder, line.split()[1]).is_file() for line in results[4 + len(gas) :])
    assert len(to_the_stop.out) == 1


@pytest.mark.parametrize(
    "part",
    ["uav", *(pytest.param(part, marks=pytest.mark.full) for part in ("router", "estimator", "agent"))],
)
def test_a_part_that_dies_is_named_and_ends_the_mission(
    start, family, wait_until: Callable, tmp_path: Path, part: str
) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    os.kill(pids[part], signal.SIGKILL)
    assert mission.ended() == 1
    assert f"error: {part} was killed by signal 9; its last words: " in mission.err[-1]
    assert nothing_is_left(pids)


@pytest.mark.full
def test_a_recorder_that_dies_is_told_and_the_mission_goes_on(
    start, family, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start("sitl", "fly", "--policy", "random", "--budget", "12", cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    os.kill(family(mission.process.pid)["record"], signal.SIGKILL)
    assert mission.ended() == 0
    assert mission.says("warning: the recording stopped: the recorder was killed by signal 9")
    assert mission.out[0].startswith("not ceased after 12 steps, ")


@pytest.mark.parametrize("hit", ["launcher", *(pytest.param(part, marks=pytest.mark.full) for part in PARTS)])
def test_ctrl_c_ends_all_of_it_whichever_process_it_hits(
    start, family, wait_until: Callable, tmp_path: Path, hit: str
) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    assert sorted(pids) == sorted([*PARTS, "record"])
    port = int(next(line for line in mission.err if "router at" in line).rpartition(":")[2])
    os.kill(mission.process.pid if hit == "launcher" else pids[hit], signal.SIGINT)
    assert mission.ended() == 130
    assert nothing_is_left(pids)
    assert {path.suffix for path in (tmp_path / "runs").iterdir()} == {
        ".mcap",
        ".tlog",
    }  # the flown part is recorded
    assert "Traceback" not in "".join(mission.err)
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


def test_parts_do_not_outlive_a_launcher_that_is_killed(
    start, family, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    pids = family(mission.process.pid)
    mission.kill()
    wait_until(lambda: nothing_is_left(pids))


def test_an_interrupt_while_it_starts_leaves_nothing_behind(
    start, family, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(*LONG, cwd=tmp_path)
    wait_until(lambda: "router" in family(mission.process.pid))
    pids = family(mission.process.pid)
    mission.process.send_signal(signal.SIGINT)
    assert mission.ended() == 130
    assert nothing_is_left(pids)


def test_an_interrupt_while_the_recorder_starts_leaves_a_whole_record_and_names_it(
    start, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(*LONG, "--record", "flight.mcap", cwd=tmp_path)
    wait_until((tmp_path / "flight.mcap").exists)
    mission.process.send_signal(signal.SIGINT)
    assert mission.ended() == 130
    assert mission.err[-2:] == ["record   flight.mcap\n", "interrupted\n"]
    assert not mission.says("warning")
    assert read(tmp_path / "flight.mcap").complete


def test_an_interrupt_while_the_recorder_starts_leaves_older_files_alone(
    start, wait_until: Callable, tmp_path: Path
) -> None:
    for name in ("flight.mcap", "flight.tlog"):
        (tmp_path / name).write_text("old")
    mission = start(*LONG, "--record", "flight.mcap", "--force", cwd=tmp_path)
    wait_until(lambda: [*tmp_path.glob(".flight-*.mcap")])
    mission.process.send_signal(signal.SIGINT)
    assert mission.ended() == 130
    assert mission.err[-1] == "interrupted\n"
    assert not mission.says("warning")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "flight.mcap": "old",
        "flight.tlog": "old",
    }


def test_an_unknown_policy_is_one_line_and_status_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, (line,) = run_sitl(monkeypatch, capsys, "fly", "--policy", "clairvoyance")
    assert (status, out) == (2, [])
    assert line.startswith("error: --policy: 'clairvoyance' is not allowed; wanted infotaxis, entrotaxis, ")


def test_an_occupied_port_is_one_line_and_status_2(start, router: str, tmp_path: Path) -> None:
    for command in (("sitl", "router"), ("sitl", "fly")):
        ended = start(*command, "--listen", router, cwd=tmp_path)
        assert ended.ended() == 2
        assert ended.err == [f"error: --listen: cannot listen on {router}: Address already in use\n"]


@pytest.mark.full
def test_an_unreachable_router_is_one_line_and_status_2(start) -> None:
    services = ("sitl", "uav"), ("estimator",), ("agent",)
    for ended in [
        start(*service, "--connect", "tcp/127.0.0.1:1") for service in services
    ]:  # all parts wait for the router at once
        assert ended.ended() == 2
        assert ended.err == [
            "error: --connect: no router at tcp/127.0.0.1:1 (start one with: plumeward router)\n"
        ]


def test_a_mission_that_is_refused_leaves_no_folder_for_its_findings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(SURVEY, "survey.csv")
    Path("old.mcap").touch()
    nowhere = ("--connect", "tcp/127.0.0.1:1", "--findings", "found")
    for words in (("fly", *nowhere), ("replay", "survey.csv", *nowhere)):
        with pytest.raises(NoRouter):
            run_sitl(monkeypatch, capsys, *words)
        assert not Path("found").exists()
    status, _, (line,) = run_sitl(monkeypatch, capsys, "fly", "--findings", "found", "--record", "old.mcap")
    assert status == 2
    assert line.startswith("error: --record: 'old.mcap' exists; ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["old.mcap", "survey.csv"]


def test_a_place_that_cannot_be_written_is_one_line_and_status_2_and_nothing_flies(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.mcap").mkdir()
    for place, why in (
        ("file/flight.mcap", "cannot write 'file/flight.mcap': "),
        ("folder.mcap", "'folder.mcap' is a folder"),
    ):
        status, _, (line,) = run_sitl(
            monkeypatch, capsys, "fly", "--speedup", "0", "--record", place, "--force"
        )
        assert status == 2
        assert line.startswith(f"error: --record: {why}")


@pytest.mark.full
def test_where_runs_cannot_be_written_a_mission_without_a_record_is_flown_and_lacks_its_summary(
    start, tmp_path: Path
) -> None:
    (tmp_path / "runs").write_text("in the way")
    brief = ("sitl", "fly", "--budget", "2", "--speedup", "0", "--json")
    assert start(*brief, cwd=tmp_path).ended() == 2
    mission = start(*brief, "--no-record", cwd=tmp_path)
    assert mission.ended() == 0
    assert mission.says("warning: no summary written to runs/")
    assert json.loads(mission.out[-1])["steps"] == 2


@pytest.mark.full
def test_what_exists_is_not_overwritten_without_force(
    start, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("good.mcap", "good.tlog"):
        (tmp_path / name).write_text("old")
    brief = ("fly", "--budget", "2", "--speedup", "0", "--record", "good.mcap")
    refused = run_sitl(monkeypatch, capsys, *brief)
    assert refused == (2, [], ["error: --record: 'good.mcap' exists; wanted another name, or --force"])
    for flags in ((), ("--force",)):
        assert run_sitl(monkeypatch, capsys, *brief, *flags, "--prior", "nonsense")[0] == 2
        assert {path.name: path.read_text() for path in tmp_path.iterdir() if path.is_file()} == {
            "good.mcap": "old",
            "good.tlog": "old",
        }
    forced = start("sitl", *brief, "--force", cwd=tmp_path)
    assert forced.ended() == 0
    assert forced.out[-1] == "record   good.mcap\n"
    assert read(tmp_path / "good.mcap").complete
    assert (tmp_path / "good.tlog").stat().st_size > 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.mcap", "good.tlog", "runs"]
    assert [path.suffix for path in (tmp_path / "runs").iterdir()] == [
        ".json"
    ]  # the record is where it was wanted


@pytest.mark.full
def test_a_second_launch_of_the_same_record_is_refused_and_leaves_the_firsts(
    start, wait_until: Callable, tmp_path: Path
) -> None:
    first = start(*LONG, "--record", "flight.mcap", cwd=tmp_path)
    wait_until(lambda: first.says("step   0"))
    second = start(*LONG, "--record", "flight.mcap", cwd=tmp_path)
    assert second.ended() == 2
    assert second.err == ["error: --record: 'flight.mcap' exists; wanted another name, or --force\n"]
    first.process.send_signal(signal.SIGINT)
    assert first.ended() == 130
    assert read(tmp_path / "flight.mcap").complete


def test_without_a_record_there_is_none(talkative: Flight) -> None:
    assert [path.suffix for path in (talkative.folder / "runs").iterdir()] == [".json"]


def test_at_log_level_debug_each_service_tells_each_step_and_otherwise_only_what_goes_wrong(
    in_vain: Flight, talkative: Flight
) -> None:
    assert not any("ready" in line for line in in_vain.err)
    assert any("estimator: ready: 1000 particles" in line for line in talkative.err)
    for line in (
        "estimator: answered after ",
        "agent: answered after ",
        "uav: reading ",
    ):  # the last ones may be cut off by the end
        assert any(said.startswith(line) for said in talkative.err)
