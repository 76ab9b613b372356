"""Protects the answers of every policy with every sensor, and of a few with little known: they must be as
they were recorded.
"""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.policies import OURS
from ground.replay import verify
from link.record.reader import read
from link.record.writer import Writer
from tests.golden.__main__ import FIELD, FOLDER, GOLDEN, PAPER, SENSORS, changes, path, renew
from tests.system.live import Services, run_sitl


@pytest.fixture
def services(monkeypatch: pytest.MonkeyPatch, router: str) -> Iterator[Services]:
    with Services(monkeypatch, router) as running:
        yield running


def test_there_is_a_small_golden_record_of_every_policy_with_every_sensor() -> None:
    assert set(PAPER) == {f"{policy}-{sensor}" for policy in OURS for sensor in SENSORS}
    assert {name.removesuffix("-field") for name in FIELD} < set(PAPER)
    records = {record.stem: record.stat().st_size for record in FOLDER.glob("*.mcap")}
    assert set(records) == set(GOLDEN), "make golden"
    assert max(records.values()) < 450_000


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", GOLDEN)
def test_a_golden_mission_is_answered_as_it_was(
    name: str,
    router: str,
    services: Services,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    services.start(read(path(name)).about["parts"])
    status, out, err = run_sitl(
        monkeypatch, capsys, "replay", str(path(name)), "--verify", "--speedup", "0", "--connect", router
    )
    assert status == 0, (out, err)
    assert out[-1].startswith("verified: ")


@pytest.mark.parametrize(
    "name", ["ppo-hits", pytest.param("infotaxis-gaussian-field", marks=pytest.mark.full)]
)
def test_so_it_is_by_the_command_and_its_own_processes(start, name: str) -> None:
    replay = start("sitl", "replay", str(path(name)), "--verify", "--speedup", "0")
    assert replay.ended() == 0, replay.err[-1]


def test_the_golden_missions_cover_stops_and_spent_budgets() -> None:
    said = {name: verify.said(read(path(name)).entries) for name in GOLDEN}
    stopped = {name for name, answers in said.items() if any(kind == "stop" for _, kind in answers)}
    assert all({f"{policy}-{sensor}" for policy in OURS} & stopped for sensor in SENSORS)
    assert set(FIELD) & stopped
    assert set(GOLDEN) - stopped


@pytest.mark.full
def test_one_that_says_something_else_now_is_recorded_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    golden = read(path("greedy-gaussian"))
    writer = Writer(tmp_path / "greedy-gaussian.mcap", golden.about)
    for entry in golden.entries:
        writer.write(
            entry._replace(payload=entry.payload.replace(b'"step":3,', b'"step":33,')), entry.published_ns
        )
    writer.close()
    monkeypatch.setattr("tests.golden.__main__.FOLDER", tmp_path)
    told = renew("greedy-gaussian")
    assert ": step was 33, is 3; ceased after " in told
    assert changes(golden, read(tmp_path / "greedy-gaussian.mcap")) == ""
    assert renew("greedy-gaussian") == "unchanged"


def test_making_them_anew_tells_what_changed() -> None:
    then = read(path("greedy-gaussian"))
    assert changes(then, then) == ""
    fewer = then._replace(entries=[entry for entry in then.entries if entry.key != "agdc/stop"])
    assert ": it was estimate [" in changes(then, fewer)
    assert changes(then, fewer).count("ceased after ") == 2
    words = [*then.about["parts"]["agent"], "--headings", "8"]
    told = changes(
        then, then._replace(about={**then.about, "parts": {**then.about["parts"], "agent": words}})
    )
    assert told.startswith("agent was started with --policy greedy ")
    assert told.endswith(" --headings 8")


COMPILES = """
from numba.core.dispatcher import Dispatcher
def compiled(self, *arguments, **words):
    raise AssertionError(f"{self.py_func.__name__} is compiled in flight")
Dispatcher._compile_for_args = compiled
from agent.trials.rollout import mission
ceased = [step.belief.ceased for assume in ("paper", "field") for step in mission(26, "homing", 100, 0.9, 60, assume=assume).steps]
print(sum(ceased))
"""


def test_nothing_is_compiled_in_flight() -> None:
    """A stop once came a third of a second late: what only it calls was compiled then."""
    flown = subprocess.run([sys.executable, "-c", COMPILES], capture_output=True, text=True, timeout=300)
    assert (flown.returncode, flown.stdout) == (0, "2\n"), flown.stderr
