"""Protects parity: a mission over Zenoh and the same mission in-process agree to the last bit."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from agent.policies import OURS


def flown(folder: Path, *command: str) -> dict:
    done = subprocess.run([sys.executable, "-m", *command, "--json", "--trace"], capture_output=True, text=True, cwd=folder, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("policy", ["infotaxis", "random"])
@pytest.mark.parametrize("seed", [1, 2, 417, 1_000_000, 1_000_001])
def test_a_mission_over_the_bus_equals_the_one_in_process(tmp_path: Path, seed: int, policy: str) -> None:
    chosen = ["--seed", str(seed), "--policy", policy]
    over_the_bus = flown(tmp_path, "sitl", "fly", *chosen, "--speedup", "0")
    in_process = flown(tmp_path, "agent", "rollout", *chosen)
    assert over_the_bus["trace"] == in_process["trace"]
    assert len(over_the_bus["trace"]) == over_the_bus["steps"] + 1
    for result in (over_the_bus, in_process):
        assert result.pop("search_time_s") > 0  # the one field that is measured, not computed
    assert over_the_bus == in_process


@pytest.mark.parametrize("policy", [policy for policy in OURS if policy not in ("infotaxis", "random")])
def test_every_policy_flies_the_same_over_the_bus(tmp_path: Path, policy: str) -> None:
    chosen = ["--seed", "7", "--policy", policy, "--particles", "300", "--budget", "40"]
    over_the_bus = flown(tmp_path, "sitl", "fly", *chosen, "--speedup", "0")
    assert over_the_bus["trace"] == flown(tmp_path, "agent", "rollout", *chosen)["trace"]


@pytest.mark.parametrize("reach", [["--headings", "8", "--measurements", "10"], ["--headings", "4", "--step", "0.5"]])
def test_how_a_planner_moves_reaches_it(tmp_path: Path, reach: list[str]) -> None:
    chosen = ["--seed", "5", "--policy", "homing", "--particles", "200", "--budget", "20"]
    usual = flown(tmp_path, "agent", "rollout", *chosen)["trace"]
    in_process = flown(tmp_path, "agent", "rollout", *chosen, *reach)["trace"]
    assert in_process != usual
    assert in_process == flown(tmp_path, "sitl", "fly", *chosen, *reach, "--speedup", "0")["trace"]


def test_options_reach_every_part(tmp_path: Path) -> None:
    chosen = ["--seed", "5", "--policy", "random", "--particles", "200", "--threshold", "5.5", "--budget", "40"]
    over_the_bus = flown(tmp_path, "sitl", "fly", *chosen, "--speedup", "0", "-I", "3", "--home=-35.36,149.16,584,90")
    assert over_the_bus["trace"] == flown(tmp_path, "agent", "rollout", *chosen)["trace"]
    assert len(over_the_bus["trace"]) <= 41


@pytest.mark.parametrize(
    "knowledge",
    [
        ["--sensor", "hits", "--prior", "q=uniform:100,500", "--stop-on", "location,q=90"],
        ["--sensor", "threshold:0.3,0.2", "--prior", "u=normal:2.5,1", "--prior", "phi=uniform:0,6.283185307179586"],
        ["--prior", "z=fixed:4", "--prior", "d=gamma:3,1.5", "--stop-on", "d=1"],
    ],
)  # fmt: skip
def test_sensors_and_unknowns_reach_every_part(tmp_path: Path, knowledge: list[str]) -> None:
    chosen = ["--seed", "5", "--particles", "300", "--budget", "60", *knowledge]
    over_the_bus = flown(tmp_path, "sitl", "fly", *chosen, "--speedup", "0", "-I", "1")
    assert over_the_bus["trace"] == flown(tmp_path, "agent", "rollout", *chosen)["trace"]


def test_speed_up_changes_nothing_but_the_time_it_takes(tmp_path: Path) -> None:
    chosen = ["--seed", "1", "--policy", "infotaxis", "--budget", "12"]
    fast = flown(tmp_path, "sitl", "fly", *chosen, "--speedup", "0")
    slow = flown(tmp_path, "sitl", "fly", *chosen, "--speedup", "20")
    assert fast["trace"] == slow["trace"]
