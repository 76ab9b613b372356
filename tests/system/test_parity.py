"""Protects parity: a mission over Zenoh and the same mission in-process agree bit for bit."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from agent.policies import OURS
from tests.system.live import run_agent


def flown(folder: Path, *command: str) -> dict:
    """The JSON outcome of a mission flown as processes, without a record: tests/system/test_missions.py
    compares those with one.
    """
    done = subprocess.run(
        [sys.executable, "-m", *command, "--json", "--trace"],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=400,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def over_the_bus(folder: Path, *flags: str) -> dict:
    return flown(folder, "sitl", "fly", *flags, "--no-record")


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., dict]:
    """Roll a mission out in this process, with the same flags."""

    def rolled(*flags: str) -> dict:
        status, out, err = run_agent(monkeypatch, capsys, "rollout", *flags, "--json", "--trace")
        assert status == 0, err
        return json.loads(out[-1])

    return rolled


def full(*values: object) -> Any:
    """A case that only `make test-all` flies: `make test` flies one of each family of policies, sensors
    and worlds.
    """
    return pytest.param(*values, marks=pytest.mark.full)


@pytest.mark.parametrize(
    ("seed", "policy"),
    [
        (1, "infotaxis"),
        full(2, "random"),
        full(417, "infotaxis"),
        full(1_000_000, "infotaxis"),
        full(1_000_001, "random"),
    ],
)
def test_a_mission_over_the_bus_equals_the_one_in_process(
    tmp_path: Path, in_process: Callable, seed: int, policy: str
) -> None:
    chosen = ["--seed", str(seed), "--policy", policy]
    bus, rollout = over_the_bus(tmp_path, *chosen, "--speedup", "0"), in_process(*chosen)
    assert bus["trace"] == rollout["trace"]
    assert len(bus["trace"]) == bus["steps"] + 1
    for result in (bus, rollout):
        assert result.pop("search_time_s") > 0  # the one field that is measured, not computed
    assert bus == rollout


@pytest.mark.full
@pytest.mark.parametrize("policy", [policy for policy in OURS if policy != "infotaxis"])
def test_every_policy_flies_the_same_over_the_bus(tmp_path: Path, in_process: Callable, policy: str) -> None:
    chosen = ["--seed", "7", "--policy", policy, "--particles", "300", "--budget", "40", "--assume", "paper"]
    assert over_the_bus(tmp_path, *chosen, "--speedup", "0")["trace"] == in_process(*chosen)["trace"]


@pytest.mark.parametrize(
    "reach", [full(["--headings", "8", "--measurements", "10"]), ["--headings", "4", "--step", "0.5"]]
)
def test_how_a_planner_moves_reaches_it(tmp_path: Path, in_process: Callable, reach: list[str]) -> None:
    chosen = ["--seed", "5", "--policy", "homing", "--particles", "200", "--budget", "20"]
    moved = in_process(*chosen, *reach)["trace"]
    assert moved != in_process(*chosen)["trace"]
    assert moved == over_the_bus(tmp_path, *chosen, *reach, "--speedup", "0")["trace"]


def test_options_reach_every_part(tmp_path: Path, in_process: Callable) -> None:
    chosen = [
        "--seed",
        "5",
        "--policy",
        "random",
        "--particles",
        "200",
        "--threshold",
        "5.5",
        "--budget",
        "40",
    ]
    trace = over_the_bus(tmp_path, *chosen, "--speedup", "0", "-I", "3", "--home=-35.36,149.16,584,90")[
        "trace"
    ]
    assert trace == in_process(*chosen)["trace"]
    assert len(trace) <= 41


@pytest.mark.parametrize(
    "knowledge",
    [
        full(["--sensor", "hits", "--prior", "q=uniform:100,500", "--stop-on", "location,q=90"]),
        full(
            [
                "--sensor",
                "threshold:0.3,0.2",
                "--prior",
                "u=normal:2.5,1",
                "--prior",
                "phi=uniform:0,6.283185307179586",
            ]
        ),
        full(["--prior", "z=fixed:4", "--prior", "d=gamma:3,1.5", "--stop-on", "d=1"]),
        ["--sensor", "pid:warmup=7.5", "--world", "wind-noisy+readings-lost"],
        ["--sensor", "pid:warmup=60,dwell=40", "--budget", "3"],  # longer than the silence of 30 s
        full(["--sensor", "tgs2620", "--dwell", "3", "--world", "puffs"]),
        full(["--sensor", "tdlas", "--dwell", "1", "--assume", "paper"]),
    ],
)
def test_sensors_and_unknowns_reach_every_part(
    tmp_path: Path, in_process: Callable, knowledge: list[str]
) -> None:
    chosen = ["--seed", "5", "--particles", "300", "--budget", "60", *knowledge]
    assert (
        over_the_bus(tmp_path, *chosen, "--speedup", "0", "-I", "1")["trace"] == in_process(*chosen)["trace"]
    )


@pytest.mark.parametrize("policy", [full("homing"), "ppo"])
def test_with_little_known_it_flies_the_same_over_the_bus(
    tmp_path: Path, in_process: Callable, policy: str
) -> None:
    chosen = [
        "--seed",
        "7",
        "--policy",
        policy,
        "--particles",
        "300",
        "--budget",
        "25",
        "--assume",
        "field",
        "--stop",
        "within:1,0.9",
    ]
    bus, rollout = over_the_bus(tmp_path, *chosen, "--speedup", "0"), in_process(*chosen)
    del bus["search_time_s"], rollout["search_time_s"]
    assert bus == rollout
    assert (bus["assume"], bus["stop"]) == ("field", "within:1,0.9")
    told = [*chosen[:-3], "paper", *chosen[-2:]]
    assert in_process(*told)["trace"] != bus["trace"]  # the assumption reached both


@pytest.mark.parametrize(
    "world",
    [
        *(full("wind-30"), full("cv-1-correlated"), full("readings-lost"), full("all-at-once")),
        "puffs:meander=10,gusts=0.1+readings-lost",
        full("walls:file=courtyard+wind-10"),
    ],
)
def test_a_mission_in_another_world_is_the_same_over_the_bus(
    tmp_path: Path, in_process: Callable, world: str
) -> None:
    chosen = ["--seed", "3", "--particles", "300", "--budget", "40", "--world", world]
    bus, rollout = over_the_bus(tmp_path, *chosen, "--speedup", "0"), in_process(*chosen)
    del bus["search_time_s"], rollout["search_time_s"]
    assert bus == rollout
    assert bus["world"] == world
    usual = in_process(*chosen[:-1], "as-modelled")
    assert (bus["trace"] == usual["trace"]) == (world == "readings-lost")
    (summary,) = (tmp_path / "runs").glob("*.json")
    assert json.loads(summary.read_text())["mission"]["world"] == world


@pytest.mark.full
def test_speed_up_changes_nothing_but_the_time_it_takes(tmp_path: Path, in_process: Callable) -> None:
    chosen = ["--seed", "1", "--policy", "infotaxis", "--budget", "12"]
    assert (
        over_the_bus(tmp_path, *chosen, "--speedup", "20")["trace"] == in_process(*chosen)["trace"]
    )  # as all above are at once
