"""Protects the table of docs/fleet.md: it is that of the rows, and its shares and first stops are right."""

from pathlib import Path

import pytest

from benchmarks.rows import read
from benchmarks.together import OF_WIDE, ROWS, Cell, Flown, cells_of, first_of, fly, table

ROOT = Path(__file__).parents[2]


def row(
    vehicles: int, how: str, seed: int, moves: int, ceased: bool = True, false_stop: bool = False
) -> Flown:
    flying = vehicles if how == "together" else 1
    return Flown("homing", "corners", vehicles, how, seed, ceased, false_stop, moves, float(moves * flying))


@pytest.mark.parametrize("rows", [ROWS, OF_WIDE], ids=str)
def test_the_page_shows_the_table_of_the_rows(rows: Path) -> None:
    assert table(read(ROOT / rows, Flown)) in (ROOT / "docs" / "fleet.md").read_text()


def test_what_was_not_flown_has_no_column() -> None:
    heading, _, one = table(
        [row(1, "together", 1, 40), row(1, "together", 2, 1000, ceased=False)]
    ).splitlines()
    assert heading.count("|") == one.count("|") == 13
    assert "alone" not in heading
    assert "told" not in heading
    assert "| 2 | 1 | 520.0 " in one


def test_the_first_to_stop_ends_the_search_of_vehicles_that_share_nothing() -> None:
    one = {
        1: row(1, "together", 1, 40),
        2: row(1, "together", 2, 10, ceased=False),
        3: row(1, "together", 3, 9),
    }
    two = {1: row(2, "alone", 1, 30, false_stop=True), 2: row(2, "alone", 2, 50)}
    first = first_of([one, two])
    assert {seed: (said.moves, said.distance_m, said.false_stop) for seed, said in first.items()} == {
        1: (30, 60.0, True),
        2: (50, 100.0, False),
    }


def test_a_share_is_of_the_same_seeds() -> None:
    rows = [row(1, "together", 1, 40), row(1, "together", 2, 20), row(2, "together", 1, 20)]
    assert "| 0.50 [0.50, 0.50] |" in table(rows)


def test_medians_do_not_depend_on_when_a_search_is_given_up() -> None:
    tables = [
        table(
            [
                *(row(1, "together", seed, moves) for seed, moves in enumerate((40, 60, 60, 62))),
                row(1, "together", 4, given_up_at, ceased=False),
                *(row(2, "together", seed, 30) for seed in range(5)),
            ]
        )
        for given_up_at in (100, 1000)
    ]
    assert all("| 30 | 0.50 [" in each for each in tables)  # 30 of 60
    assert "| 30.0 [30.0, 30.0] | 0.47 [" in tables[0]  # of a mean of 64.4
    assert "| 30.0 [30.0, 30.0] | 0.12 [" in tables[1]  # of 244.4


def test_who_is_alone_is_flown_once_for_all_fleets_and_from_an_edge_not_at_all() -> None:
    cells = cells_of(["homing"], 3)
    assert len(cells) == len(set(cells)) == 22
    assert Cell("homing", "corners", 3, "alone") in cells
    assert not [cell for cell in cells if cell.how == "alone" and "edge" in cell]


@pytest.mark.full
def test_a_fleet_that_is_told_where_the_source_is_needs_fewer_moves_than_one_that_searches() -> None:
    searching, told = [Cell("homing", "corners", 2, how) for how in ("together", "told")]
    rows = [row for seed in range(1, 6) for row in fly(seed, [searching, told])]
    moves = {cell: sum(row.moves for row in rows if row.cell == cell) for cell in (searching, told)}
    assert all(row.ceased and not row.false_stop for row in rows)
    assert 0.5 * moves[searching] < moves[told] < moves[searching]
