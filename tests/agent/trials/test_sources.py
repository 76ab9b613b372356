"""Protects what a journal is bound to: a policy or a world that has been edited resumes no mission of before."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.trials.sources import of_policy, of_world
from agent.trials.sweep import Sweep, journal_of
from plume.worlds.names import named
from tests.agent.test_bundle import a_bundle

THEIRS = "def theirs(belief, particles, reach, rng): return {}, 2"
BUILDINGS = "buildings: [{{footprint: [[{}, 10], [14, 10], [14, 14]], height: 5}}]"
Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Install the package `strangers`, whose `tools` plug in one entry point, as pip would."""
    (tmp_path / "strangers").mkdir()
    (tmp_path / "strangers" / "__init__.py").touch()
    said = tmp_path / "strangers-1.0.dist-info"
    said.mkdir()
    (said / "METADATA").write_text("Metadata-Version: 2.1\nName: strangers\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("strangers", "strangers.tools"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    named.cache_clear()

    def put(group: str, name: str) -> None:
        (said / "entry_points.txt").write_text(f"[plumeward.{group}]\n{name} = strangers.tools:theirs\n")

    return put


def written(path: Path, text: str) -> Path:
    """Write a file anew, later than before even where the clock is coarse."""
    before_ns = path.stat().st_mtime_ns if path.exists() else 0
    path.write_text(text)
    os.utime(path, ns=(before_ns + 10**9,) * 2)
    return path


def test_an_edited_plug_in_has_another_journal(tmp_path: Path, install: Install) -> None:
    install("policies", "theirs")
    sweep = Sweep(("theirs",), range(1))
    journals = []
    for x in (1, 3, 1):
        written(tmp_path / "strangers" / "tools.py", THEIRS.format(x))
        journals.append(journal_of(sweep, tmp_path))
    assert journals[0] == journals[2] != journals[1]
    written(tmp_path / "strangers" / "beside.py", "x = 5")  # what the plug-in may import
    assert journal_of(sweep, tmp_path) != journals[0]


def test_an_edited_plug_in_of_a_world_has_another_journal(tmp_path: Path, install: Install) -> None:
    install("worlds", "theirs")
    written(tmp_path / "strangers" / "tools.py", "def theirs(truth, seed): return 1")
    sweep = Sweep(("greedy",), range(1), worlds=("theirs",))
    before = journal_of(sweep, tmp_path)
    assert journal_of(sweep, tmp_path) == before
    written(tmp_path / "strangers" / "tools.py", "def theirs(truth, seed): return 2")
    assert journal_of(sweep, tmp_path) != before


def test_an_edited_file_of_a_world_has_another_journal(tmp_path: Path) -> None:
    path = written(tmp_path / "yard.yaml", BUILDINGS.format(10))
    sweep = Sweep(("greedy",), range(1), worlds=(f"walls:file={path}",))
    before = journal_of(sweep, tmp_path)
    assert journal_of(sweep, tmp_path) == before
    written(path, BUILDINGS.format(11))
    assert journal_of(sweep, tmp_path) != before


def test_an_edited_bundle_has_another_journal(tmp_path: Path) -> None:
    sweep, journals = Sweep((str(tmp_path / "a.zip"),), range(1)), []
    for seed in (0, 1, 0):
        a_bundle(tmp_path / "a.zip", seed=seed)
        journals.append(journal_of(sweep, tmp_path))
    assert journals[0] == journals[2] != journals[1]


def test_our_own_policies_and_worlds_are_known_by_our_code() -> None:
    """So a sweep of more of them goes on in the same journal."""
    assert {of_policy("homing"), of_policy("greedy")} == {""}
    assert {of_world("as-modelled"), of_world("puffs:share=0.2+wind-30"), of_world("walls")} == {""}
