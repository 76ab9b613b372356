"""Protects the page on trust: tables say what is counted by hand, prose stays, a resumed run flies only
what is missing.
"""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from agent.trials.evaluate import read_csv
from agent.trials.figures import MissionRow, figures
from agent.trials.rollout import rollout
from benchmarks.trust import (
    HOLDS,
    STOPS,
    WITH,
    WORLDS,
    compared,
    is_there,
    keep,
    label_of,
    page,
    promise,
    read,
    worlds,
    write_figures,
)
from plume.sensors.names import parse, text
from plume.worlds.errors import WRONG

ROOT = Path(__file__).parents[2]
CRITERIA = ("spread:0.5", "within:1,0.95", "within:1,0.99")


def row(
    seed: int, ceased: bool = True, error_m: float = 0.5, distance_m: float = 40.0, warned: bool = False
) -> MissionRow:
    return MissionRow(
        policy="homing",
        particles=1000,
        threshold_m=0.5,
        seed=seed,
        budget=600,
        headings=8,
        step_m=1.0,
        measurements=100,
        ceased=ceased,
        located=ceased and error_m <= 1,
        estimate_x=error_m,
        estimate_y=0.0,
        source_x=0.0,
        source_y=0.0,
        error_m=error_m,
        spread_m=0.4,
        nees=2.0 * error_m,
        steps=int(distance_m),
        distance_m=distance_m,
        floor_m=None,
        search_time_s=0.5,
        decision_ms=2.0,
        update_ms=1.0,
        assume="field",
        warned=warned,
    )


FOUR = [
    row(1, True, 0.5, 30.0),
    row(2, True, 1.5, 50.0, True),
    row(3, True, 0.1, 40.0),
    row(4, False, 9.0, 600.0),
]
"""Four missions: three ceased, two of them within 1 m; a warning preceded the false stop."""


def rows_of(*worlds: str, assume: str = "field", policy: str = "homing") -> dict:
    told = {
        world: [replace(it, world=world, assume=assume, policy=policy) for it in FOUR] for world in worlds
    }
    return {
        (assume, policy, world): {"spread:0.5": of, "within:1,0.95": of, "within:1,0.99": of}
        for world, of in told.items()
    }


def said(rows: dict) -> dict:
    return {(*cell, stop): figures(of) for cell, stops in rows.items() for stop, of in stops.items()}


def test_the_worlds_of_a_promise_are_those_whose_truth_lies_in_the_assumption() -> None:
    assert set(HOLDS["paper"]) == {"as-modelled", "readings-lost", "source-outside"}
    assert set(WRONG) - set(HOLDS["field"]) == {
        "cv-1-correlated",
        "source-beyond",
        "two-sources",
        "stuck",
        "stuck-noisy",
    }
    assert tuple(stop.text for stop in STOPS) == CRITERIA


def test_the_promise_is_judged_over_all_worlds_of_the_assumption_and_no_others() -> None:
    rows = rows_of("wind-10", "cv-1", "stuck")
    better = [
        replace(it, error_m=0.5, located=it.ceased) for it in rows["field", "homing", "cv-1"]["within:1,0.99"]
    ]
    rows["field", "homing", "cv-1"]["within:1,0.99"] = better
    rows |= rows_of("wind-10", assume="paper") | rows_of("wind-10", policy="ppo")
    head, _, *lines = promise(rows).splitlines()
    assert head.count("|") == lines[0].count("|")
    # Wilson of 4 in 6 and 5 in 6, with z = 1.96. Errors of the stops: 0.1, 0.1, 0.5, 0.5, 1.5, 1.5; then 0.1,
    # three or four of 0.5, 1.5.
    assert lines == [
        "| field | `spread:0.5` | 2 of 24 | 75.0 | about 98 | 66.7 [30.0, 90.3] | 66.7, wind-10 | 0.50 / "
        "1.50 | 1.40 |",
        "| field | `within:1,0.95` | 2 of 24 | 75.0 | 94.5 | 66.7 [30.0, 90.3] | 66.7, wind-10 | 0.50 / 1.50 "
        "| 1.40 |",
        "| field | `within:1,0.99` | 2 of 24 | 75.0 | 98.5 | 83.3 [43.6, 97.0] | 66.7, wind-10 | 0.50 / 1.25 "
        "| 1.40 |",
    ]


def test_the_table_of_worlds_says_what_is_counted_by_hand() -> None:
    rows = (
        rows_of("wind-10", "as-modelled")
        | rows_of("wind-10", assume="paper")
        | rows_of("wind-10", policy="ppo")
    )
    none = [
        replace(it, ceased=False, located=False)
        for it in rows["field", "homing", "as-modelled"]["spread:0.5"]
    ]
    rows["field", "homing", "as-modelled"]["spread:0.5"] = none
    head, _, *lines = worlds(said(rows), rows).splitlines()
    assert head.count("|") == lines[0].count("|")
    third = "33.3 [6.1, 79.2]"  # Wilson of 1 in 3
    assert lines == [
        "| as-modelled | – | – | – | 0.0 / 0.0 / 0.0 | – / – | – | – | – |",
        f"| wind-10 | {third} | {third} | 100 | 75.0 / 50.0 / 0.0 | 40.0 / 40.0 | 1.40 (1.0) | {third} | "
        "40.0 (50%) / 40.0 (50%) |",
    ]


def test_policies_are_compared_over_the_missions_that_all_have_flown() -> None:
    rows = (
        rows_of("wind-10", "cv-1")
        | rows_of("cv-1", policy="ppo")
        | rows_of("cv-1", policy="dcee")
        | rows_of("cv-1", assume="paper")
    )
    rows["field", "dcee", "cv-1"] = {"spread:0.5": FOUR[:3]}  # without the fourth, which never ceased
    rows["field", "ppo", "cv-1"] = {
        "spread:0.5": [row(seed, distance_m=20.0 * seed) for seed in (1, 2, 3, 5)]
    }
    rows |= rows_of("cv-2") | rows_of("cv-2", policy="ppo")
    assert compared(rows) == (
        ["homing", "dcee", "ppo"],
        {"cv-1": "40.0 (67%) / 40.0 (67%) / 40.0", "cv-2": "40.0 (50%) / – / 40.0 (50%)"},
    )


def test_the_page_keeps_its_prose_and_gets_its_tables_anew() -> None:
    places = [f"<!-- {name} -->\n{old}<!-- end -->" for name, old in (("promise", "old\n"), ("worlds", ""))]
    before = "\n\n".join(["# Trust", "Words.", places[0], "More words.", places[1], "Last words.\n"])
    rows = rows_of("wind-10")
    once = page(before, rows, said(rows))
    prose = ("# Trust\n\nWords.\n\n", "\n\nMore words.\n\n", "\n\nLast words.\n")
    for part in (*prose, promise(rows), worlds(said(rows), rows), " 4 missions "):
        assert part in once
    assert "old" not in once
    assert page(once, rows, said(rows)) == once
    with pytest.raises(ValueError, match="no lines <!-- promise -->"):
        page("# Trust\n", rows, said(rows))


def test_what_is_flown_again_takes_its_old_place_and_leaves_the_rest(tmp_path: Path) -> None:
    rows = {
        cell: stops["spread:0.5"]
        for cell, stops in (rows_of("wind-10", "stuck") | rows_of("wind-10", policy="ppo")).items()
    }
    for cell, of in rows.items():
        keep(tmp_path, cell, of)
    keep(tmp_path, ("field", "homing", "wind-10"), rows["field", "homing", "wind-10"][:2])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["field-homing.csv.gz", "field-ppo.csv.gz"]
    again = read(tmp_path)
    assert {cell: len(stops["spread:0.5"]) for cell, stops in again.items()} == {
        ("field", "homing", "wind-10"): 2,
        ("field", "homing", "stuck"): 4,
        ("field", "ppo", "wind-10"): 4,
    }
    assert not is_there(again, ("field", "homing", "stuck"), range(1, 5))  # the other criteria are missing
    assert is_there(rows_of("stuck"), ("field", "homing", "stuck"), range(1, 5))
    assert not is_there(rows_of("stuck"), ("field", "homing", "stuck"), range(1, 6))


def test_a_world_with_another_sensor_has_rows_of_its_own(tmp_path: Path) -> None:
    """They differ from the world's other rows by the sensor, not by the world."""
    with_pid = [replace(it, world="as-modelled", sensor="pid") for it in FOUR]
    hovering = [
        replace(it, world="puffs:share=0.2,meander=10", sensor="gaussian:0.3,0.2,dwell=2.0") for it in FOUR
    ]
    usual = [replace(it, world="as-modelled") for it in FOUR[:1]]
    label = "puffs:share=0.2,meander=10 with 2 s of dwell"
    assert label_of(with_pid[0]) == "as-modelled with pid"
    assert label_of(hovering[0]) == label
    assert label_of(usual[0]) == "as-modelled"
    keep(tmp_path, ("field", "homing", "as-modelled with pid"), with_pid)
    keep(tmp_path, ("field", "homing", label), hovering)
    keep(tmp_path, ("field", "homing", "as-modelled"), usual)
    keep(tmp_path, ("field", "homing", "as-modelled with pid"), with_pid[:3])
    again = {cell[2]: sum(map(len, stops.values())) for cell, stops in read(tmp_path).items()}
    assert again == {"as-modelled": 1, label: 4, "as-modelled with pid": 3}
    assert [*again] == [world for world in WORLDS if world in again]
    lines = worlds(said(read(tmp_path)), read(tmp_path)).splitlines()[2:]
    assert [line.split(" | ")[0] for line in lines] == [f"| {world}" for world in again]


def test_a_row_with_another_sensor_says_a_sensor_that_can_be_flown() -> None:
    """As the rows say it, so that they are found again."""
    for world, sensor in WITH.values():
        assert text(parse(sensor)) == sensor
        assert world in WORLDS
    assert {parse(sensor).dwell for _, sensor in WITH.values()} == {2.0, 5.0}


def test_the_long_table_has_a_line_for_each_assumption_policy_world_and_stop(tmp_path: Path) -> None:
    write_figures(said(rows_of("wind-10")), tmp_path / "figures.csv")
    lines = list(csv.DictReader((tmp_path / "figures.csv").read_text().splitlines()))
    keys = [tuple(line[name] for name in ("assume", "policy", "world", "stop")) for line in lines]
    assert keys == [("field", "homing", "wind-10", stop) for stop in CRITERIA]
    assert (lines[0]["missions"], lines[0]["ceased"], lines[0]["mtd_m"]) == ("4", "0.75", "40")
    assert (lines[0]["false_stop"], lines[0]["false_stop_warned"]) == ("0.333333", "1")


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    flags = ("--results", str(folder / "rows"), "--page", str(folder / "page.md"), "--workers", "1")
    python = (sys.executable, "-m", "benchmarks.trust")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [*python, *flags, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.mark.full
def test_the_command_flies_what_is_asked_for_and_then_only_what_is_missing(tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("<!-- promise -->\n<!-- end -->\n<!-- worlds -->\n<!-- end -->\n")
    asked = ("--assume", "paper", "--world", "as-modelled,gain-halved", "--policy", "ppo", "--missions", "1")
    first = command(tmp_path, *asked)
    assert (first.returncode, first.stdout) == (0, f"{document}\n"), first.stderr
    rows = read_csv(tmp_path / "rows" / "paper-ppo.csv.gz")
    assert [(it.world, it.criterion, it.seed) for it in rows] == [
        (world, stop, 1_000_000) for world in ("as-modelled", "gain-halved") for stop in CRITERIA
    ]
    for it in rows:
        alone, _ = rollout(1_000_000, "ppo", budget=600, world=it.world, assume="paper", stop=it.criterion)
        assert (it.ceased, it.steps, it.budget) == (alone.ceased, alone.steps, 600)
        assert it.error_m == pytest.approx(alone.error_m, rel=1e-5)
    assert not list((tmp_path / "runs").iterdir())  # a world that is complete leaves no journal
    keep(tmp_path / "rows", ("paper", "ppo", "gain-halved"), [])
    again = command(tmp_path, *asked, "--resume")
    assert again.returncode == 0
    assert "gain-halved" in again.stderr
    assert "as-modelled" not in again.stderr
    assert "| gain-halved |" in document.read_text()


@pytest.mark.parametrize(
    "flag", ["--world", *(pytest.param(flag, marks=pytest.mark.full) for flag in ("--assume", "--policy"))]
)
def test_what_it_does_not_know_it_says_in_one_line(flag: str, tmp_path: Path) -> None:
    refused = command(tmp_path, flag, "nonsense")
    assert refused.returncode == 2
    [line] = refused.stderr.splitlines()
    assert flag in line
    assert "'nonsense'" in line
    assert "wanted " in line.lower()
    assert not list(tmp_path.iterdir())
