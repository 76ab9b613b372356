"""Protects a mission in which time_boot_ms wraps, which it does after 49.7 days: nothing but the times is
another.
"""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from link.bus.mavlink import unpack_reading
from link.record.reader import read
from scene.follow.history import History
from scene.scene import Backdrop
from sitl.launch.processes import Child, Processes
from tests.system.live import run_agent, run_sitl

pytestmark = pytest.mark.slow

WRAP_S = 4_294_967.296
MISSION = """
seed: 5
speedup: 0
agent: {policy: homing, budget: 30}
estimator: {particles: 200}
events:
  - {time_s: 4294969, do: kill, part: estimator}
"""


@pytest.fixture
def up_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let missions be flown by a vehicle that has been up for almost 49.7 days."""
    start: Callable[..., Child] = Processes.start

    def late(processes: Processes, part: str, module: str, *words: str, **options: Any) -> Child:
        module = "tests.system.up_for_long" if part == "uav" else module
        return start(processes, part, module, *words, **options)

    monkeypatch.setattr(Processes, "start", late)


@pytest.mark.full
def test_a_mission_in_which_time_wraps_has_the_same_trace_and_is_recorded_followed_and_replayed_as_any_other(
    up_for_long: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mission.yaml").write_text(MISSION)

    def run(how: Callable[..., tuple[int, list[str], list[str]]], *words: str) -> Any:
        status, out, err = how(monkeypatch, capsys, *words, "--json")
        assert status == 0, err
        return json.loads(out[-1]), err

    flown, told = run(run_sitl, "fly", "mission.yaml", "--record", "run.mcap", "--trace")
    chosen = ("--seed", "5", "--policy", "homing", "--budget", "30", "--particles", "200")
    rolled, _ = run(run_agent, "rollout", *chosen, "--trace")
    assert flown["trace"] == rolled["trace"]
    assert any("estimator killed" in line for line in told)

    entries = read(Path("run.mcap")).entries
    times = [unpack_reading(entry.payload).time_boot_ms for entry in entries if entry.key == "reading"]
    assert any(after < before - 2**31 for before, after in pairwise(times))
    history = History(Backdrop("uav/1"))
    for entry in entries:
        history.take(entry.key, entry.payload, entry.attachment, entry.simulation_s, entry.published_ns / 1e9)
    taken_s = [measurement.time_s for measurement in history.measurements.values]
    assert (history.missions, len(taken_s)) == (1, len(flown["trace"]))
    assert taken_s == sorted(taken_s)
    assert taken_s[0] < WRAP_S < taken_s[-1]

    summary, _ = run(run_sitl, "log", "run.mcap")
    assert not [line for line in summary["gaps"] if "belief" in line]
    assert run(run_sitl, "replay", "run.mcap", "--verify", "--speedup", "0")[0]["verified"]
