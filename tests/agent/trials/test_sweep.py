"""Protects sweeps: a row is what a rollout says, whoever flies it and however often the sweep was cut off."""

import gzip
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from agent.trials.evaluate import named, read_csv, write_csv
from agent.trials.figures import MissionRow
from agent.trials.floor import floors_m
from agent.trials.rollout import rollout
from agent.trials.sweep import Sweep, fly, fly_all, journal_of, on_cores, ordered
from plume.scenario import draw
from plume.sensor import Hits

SMALL = Sweep(("greedy", "thompson"), range(7, 10), particles=(100, 200), thresholds_m=(0.9, 2.0, 0.5), budget=80)


def untimed(rows: list[MissionRow]) -> list[MissionRow]:
    """Rows without what is measured and not computed."""
    return [msgspec.structs.replace(row, search_time_s=0.0, decision_ms=0.0, update_ms=0.0) for row in rows]


@pytest.mark.parametrize("seed", [7, 8, 9])
def test_one_flight_gives_what_a_rollout_at_each_threshold_gives(seed: int) -> None:
    (rows,) = fly(SMALL, [("thompson", 200, seed)])
    for row, threshold_m in zip(rows, SMALL.thresholds_m, strict=True):
        alone, _ = rollout(seed, "thompson", 200, threshold_m, 80)
        assert (row.threshold_m, row.seed, row.particles) == (threshold_m, seed, 200)
        assert (row.ceased, row.located, row.steps, row.distance_m) == (alone.ceased, alone.located, alone.steps, alone.distance_m)
        assert (row.error_m, row.spread_m) == (alone.error_m, alone.spread_m)
        assert (row.estimate_x, row.estimate_y, row.source_x, row.source_y) == (*alone.estimate, *alone.source)


def test_the_number_of_workers_does_not_show(tmp_path: Path) -> None:
    one, two = (
        ordered([row for rows in fly_all(SMALL, tmp_path / f"{workers}.jsonl", on_cores(workers)) for row in rows], SMALL)
        for workers in (1, 2)
    )
    assert len(one) == 2 * 2 * 3 * 3
    assert untimed(one) == untimed(two)
    assert [(row.policy, row.particles, row.threshold_m, row.seed) for row in one[:4]] == [
        ("greedy", 100, 0.5, 7), ("greedy", 100, 0.5, 8), ("greedy", 100, 0.5, 9), ("greedy", 100, 0.9, 7),
    ]  # fmt: skip


def test_a_sweep_that_was_cut_off_goes_on_where_it_was(tmp_path: Path) -> None:
    whole = Sweep(("greedy",), range(7, 11), particles=(100,), thresholds_m=(0.9, 2.0), budget=40)
    journal = tmp_path / "deep" / "journal.jsonl"
    sweep = fly_all(whole, journal, on_cores(1))
    first = [next(sweep), next(sweep)]
    sweep.close()
    marked = [[msgspec.structs.replace(row, search_time_s=-1.0) for row in rows] for rows in first]
    journal.write_bytes(b"".join(msgspec.json.encode(rows) + b"\n" for rows in marked) + b'[{"policy":"gree')  # cut off while it wrote
    rows = ordered([row for rows in fly_all(whole, journal, on_cores(1)) for row in rows], whole)
    assert sum(row.search_time_s < 0 for row in rows) == 4  # kept, not flown again
    assert untimed(rows) == untimed(ordered([row for flight in whole.flights for rows in fly(whole, [flight]) for row in rows], whole))
    # And once more: all is in the journal now.
    again = ordered([row for rows in fly_all(whole, journal, on_cores(1)) for row in rows], whole)
    assert again == rows


def test_another_question_has_another_journal(tmp_path: Path) -> None:
    others = [replace(SMALL, budget=81), replace(SMALL, thresholds_m=(0.9,)), replace(SMALL, knowledge={"stop_on_location": False})]
    assert len({journal_of(sweep, tmp_path) for sweep in [SMALL, *others]}) == 4
    assert journal_of(replace(SMALL, seeds=range(7, 100)), tmp_path) == journal_of(SMALL, tmp_path)  # more of the same goes on


def test_figures_are_named_by_policy_and_by_what_else_differs() -> None:
    two = [("greedy", 100, 7), ("greedy", 100, 8)]
    rows = ordered([row for flight in two for rows in fly(SMALL, [flight]) for row in rows], SMALL)
    assert list(named([row for row in rows if row.threshold_m == 0.9])) == ["greedy"]
    assert list(named(rows)) == [f"greedy particles=100 threshold={threshold_m:g}" for threshold_m in (0.5, 0.9, 2.0)]


@pytest.mark.parametrize("name", ["missions.csv", "missions.csv.gz"])
def test_a_table_of_missions_reads_back_as_it_was_written(tmp_path: Path, name: str) -> None:
    (rows,) = fly(replace(SMALL, thresholds_m=(0.01, 0.5)), [("greedy", 100, 7)])
    assert rows[0].floor_m is None  # too small a ζ for it
    write_csv(rows, tmp_path / name)
    text = (gzip.decompress if name.endswith("gz") else bytes)((tmp_path / name).read_bytes()).decode()
    assert text.startswith("policy,particles,threshold_m,seed,budget,headings,step_m,measurements,ceased,located,")
    for row, read in zip(rows, read_csv(tmp_path / name), strict=True):
        for wrote, said in zip(msgspec.structs.astuple(row), msgspec.structs.astuple(read), strict=True):
            assert said == (pytest.approx(wrote, rel=1e-5) if isinstance(wrote, float) else wrote)


def test_a_table_of_something_else_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("policy,particles\ngreedy,many\n")
    with pytest.raises(ValueError, match=r"other\.csv: .*particles"):
        read_csv(tmp_path / "other.csv")


def test_rows_carry_the_floor_of_their_scenario_where_it_is_known() -> None:
    flight = ("greedy", 100, 7)
    (rows,) = fly(SMALL, [flight])
    assert {row.threshold_m: row.floor_m for row in rows} == floors_m(draw(7), SMALL.thresholds_m)
    for other in (replace(SMALL, moves={"step": 0.5}), replace(SMALL, knowledge={"sensor": Hits()})):
        assert {row.floor_m for row in fly(other, [flight])[0]} == {None}
