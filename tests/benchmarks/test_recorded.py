"""Protects the recorded plumes that trust is measured in: films that the worlds play with the mission's wind
and rate, and a page that shows the rows that are kept.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from agent.trials.evaluate import read_csv
from benchmarks import recorded, solver
from benchmarks.recorded import PAGE, PLUMES, film, page, read, world
from benchmarks.trust import STOPS
from plume.scenario import draw
from plume.worlds.names import named
from plume.worlds.world import World

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("films")


@pytest.fixture(scope="module")
def filmed(folder: Path) -> Path:
    return film("solver", 40.0, folder)


def test_the_gas_that_passes_a_line_downwind_is_the_missions_rate(filmed: Path) -> None:
    """Gas by wind by height, along a line across the wind 5 m downwind, over the film. On the way, 5 m by
    2.5 m/s, the lifetime of 10 s leaves exp(−0.2), whatever the pace. The film has eddies of 20 s, so the
    mean over 40 s is within a fifth.
    """
    across = np.arange(-18.0, 18.0, 0.5)
    for seed in (1_000_000, 1_000_001, 1_000_002):
        told = draw(seed)
        there = World(told, seed, name=world(filmed, seed))
        to_where = -np.array(told.wind) / told.u
        beside = np.array([-to_where[1], to_where[0]])
        places = np.zeros((len(across), 3))
        places[:, :2] = np.array(told.source) + 5.0 * to_where + across[:, None] * beside
        pace = told.u / solver.WIND_MPS
        passing = []
        for second in np.linspace(0.0, 40.0 / pace, 80, endpoint=False).tolist():
            gas, wind = there.air(places, np.full(len(places), second))
            assert wind[0] == pytest.approx(told.wind)
            passing.append(gas.sum() * 0.5 * told.u * solver.THICKNESS_M)
        assert np.mean(passing) == pytest.approx(told.q * math.exp(-0.2), rel=0.2)


def test_a_film_of_puffs_is_their_gas(folder: Path) -> None:
    """At the centres of the cells, at the times of the frames, but for the rounding to float16."""
    frames = np.load(film("puffs", 2.0, folder))
    assert frames.shape == (10, recorded.GRID.cells[1], recorded.GRID.cells[0])
    air = named(recorded.PUFFS).air(recorded.RELEASE, recorded.SEED)
    column, row = recorded.GRID.source
    gas, _ = air(np.array([[5.0, 1.5, 0.0]]), np.array([1.2]))
    assert frames[6, row + 3, column + 10] == pytest.approx(gas[0], rel=1e-3, abs=1e-7)


def test_the_page_shows_the_rows_that_are_kept() -> None:
    text, rows = PAGE.read_text(), read()
    assert page(text, rows) == text
    assert {(row.world, row.criterion) for row in rows} == {
        (name, stop.text) for name in PLUMES for stop in STOPS
    }
    with pytest.raises(ValueError, match="no lines <!-- recorded -->"):
        page("# Trust\n", [])


@pytest.mark.slow
def test_the_command_films_flies_and_writes_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = tmp_path / "trust.md"
    document.write_text("# Trust\n\n<!-- recorded -->\nold\n<!-- end -->\nMore.\n")
    monkeypatch.setattr(recorded, "PAGE", document)
    monkeypatch.setattr(recorded, "ROWS", tmp_path / "rows" / "missions.csv.gz")
    monkeypatch.setattr(recorded, "FILMS", tmp_path / "films")
    monkeypatch.setattr("sys.argv", ["recorded", "--missions", "1", "--length", "2", "--workers", "1"])
    recorded.main()
    rows = read_csv(tmp_path / "rows" / "missions.csv.gz")
    assert [(row.world, row.criterion) for row in rows] == [
        (name, stop.text) for name in PLUMES for stop in STOPS
    ]
    text = document.read_text()
    assert "old" not in text
    assert text.count("| `within:1,0.99` |") == len(PLUMES)
    assert text.endswith("<!-- end -->\nMore.\n")
