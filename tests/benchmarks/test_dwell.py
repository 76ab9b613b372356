"""Protects the tables on dwells: what a find takes, and that rows are read as they were written."""

from pathlib import Path

from benchmarks.dwell import (
    HELD_OUT_SEED,
    PAGE,
    Search,
    cells,
    held_out_line,
    line,
    of_cell,
    page,
    read,
    write,
)
from plume.scenario import AS_MODELLED

FIRST = cells()[0]


def searched(seed: int, located: bool, time_s: float, advised_s: float = 0.0) -> Search:
    at = 12 if advised_s else None
    return Search(AS_MODELLED, 0.0, seed, True, located, 40, 39.0, time_s, 0.25, 0.5, 1.0, advised_s, at)


SEARCHES = [
    searched(FIRST.first_seed, True, 100.0, 2.0),
    searched(FIRST.first_seed + 1, False, 50.0),
    searched(FIRST.first_seed + 2, True, 60.0),
    searched(FIRST.first_seed + 3, True, 30.0, 1.0),
]


def test_a_find_takes_the_time_of_all_searches_by_the_number_that_found_the_source() -> None:
    told = line(SEARCHES)
    assert told[:3] == [AS_MODELLED, "0", "4"]
    assert told[3].startswith("75 [")
    assert told[4].startswith("25.0 [")
    assert told[5:7] == ["39", "60"]
    assert told[7].startswith("80 [")  # 240 s for three finds
    assert told[8:] == ["0.50 / 0.25", "25: 1 s, 25: 2 s"]
    assert held_out_line(SEARCHES)[-1] == "12 of 40"


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    write(SEARCHES, tmp_path / "rows.csv")
    assert read(tmp_path / "rows.csv") == SEARCHES
    assert read(tmp_path / "nothing.csv") == []


def test_seeds_that_test_the_advice_are_not_those_that_chose_it() -> None:
    tested = searched(HELD_OUT_SEED, True, 1.0)
    (held_out,) = [cell for cell in cells() if cell.world == AS_MODELLED and cell.first_seed == HELD_OUT_SEED]
    assert of_cell([*SEARCHES, tested], FIRST) == SEARCHES
    assert of_cell([*SEARCHES, tested], held_out) == [tested]


def test_the_page_gets_its_tables_and_keeps_its_prose() -> None:
    text = page(PAGE.read_text(), SEARCHES)
    assert "| as-modelled | 0 | 4 | 75 [" in text
    assert page(text, SEARCHES) == text
    strip = text.partition("<!-- dwell -->")
    assert strip[0] == PAGE.read_text().partition("<!-- dwell -->")[0]
