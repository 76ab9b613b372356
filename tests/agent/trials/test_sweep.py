"""Protects sweeps: a row is what a rollout says, whoever flies it and however often the sweep was cut off."""

import csv
import gzip
import itertools
import math
import os
import re
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import msgspec
import numpy as np
import pytest

from agent.__main__ import main
from agent.trials import sweep
from agent.trials.evaluate import named, read_csv, write_csv
from agent.trials.figures import MissionRow
from agent.trials.floor import floors_m
from agent.trials.rollout import mission, rollout
from agent.trials.sweep import Flight, Sweep, answers, complete, fly, fly_all, journal_of, on_cores, ordered
from estimator.criterion import Criterion
from estimator.priors import Gamma, Uniform
from plume import __version__
from plume.problem import Area, Problem
from plume.problems.fleet import Fleet
from plume.problems.names import named as named_problem
from plume.scenario import draw
from plume.sensors.sensor import Hits
from plume.worlds.world import World
from tests.agent.test_bundle import a_bundle
from tests.plume.recorded import writers

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.slow

SMALL = Sweep(
    ("greedy", "thompson"),
    range(7, 10),
    particles=(100, 200),
    stops=(Criterion(0.9), Criterion(2.0), Criterion(0.5)),
    budget=80,
)


ROW = MissionRow(
    policy="greedy",
    particles=100,
    threshold_m=0.5,
    seed=7,
    budget=300,
    headings=4,
    step_m=1.0,
    measurements=25,
    ceased=True,
    located=True,
    estimate_x=1.0,
    estimate_y=2.0,
    source_x=1.0,
    source_y=2.5,
    error_m=0.5,
    spread_m=0.4,
    nees=2.0,
    steps=30,
    distance_m=30.0,
    floor_m=None,
    search_time_s=0.5,
    decision_ms=2.0,
    update_ms=1.0,
)


def untimed(rows: list[MissionRow]) -> list[MissionRow]:
    """Rows without what is measured and not computed."""
    return [msgspec.structs.replace(row, search_time_s=0.0, decision_ms=0.0, update_ms=0.0) for row in rows]


@pytest.mark.parametrize("seed", [7, 8, 9])
def test_one_flight_gives_what_a_rollout_at_each_threshold_gives(seed: int) -> None:
    (rows,) = fly(SMALL, [("thompson", 200, seed, "as-modelled")])
    for row, (threshold_m, _) in zip(rows, SMALL.stops, strict=True):
        alone, _ = rollout(seed, "thompson", 200, threshold_m, 80, assume="paper")
        assert (row.threshold_m, row.seed, row.particles) == (threshold_m, seed, 200)
        assert (row.ceased, row.located, row.steps, row.distance_m) == (
            alone.ceased,
            alone.located,
            alone.steps,
            alone.distance_m,
        )
        assert (row.error_m, row.spread_m) == (alone.error_m, alone.spread_m)
        assert (row.estimate_x, row.estimate_y, row.source_x, row.source_y) == (
            *alone.estimate,
            *alone.source,
        )


@pytest.mark.full
def test_the_number_of_workers_does_not_show(tmp_path: Path) -> None:
    one, two = (
        ordered(
            [
                row
                for rows in fly_all(SMALL, tmp_path / f"{workers}.jsonl", on_cores(workers))
                for row in rows
            ],
            SMALL,
        )
        for workers in (1, 2)
    )
    assert len(one) == 2 * 2 * 3 * 3
    assert untimed(one) == untimed(two)
    assert [(row.policy, row.particles, row.threshold_m, row.seed) for row in one[:4]] == [
        ("greedy", 100, 0.5, 7),
        ("greedy", 100, 0.5, 8),
        ("greedy", 100, 0.5, 9),
        ("greedy", 100, 0.9, 7),
    ]


def test_a_sweep_that_was_cut_off_goes_on_where_it_was(tmp_path: Path) -> None:
    whole = Sweep(
        ("greedy",), range(7, 11), particles=(100,), stops=(Criterion(0.9), Criterion(2.0)), budget=40
    )
    journal = tmp_path / "deep" / "journal.jsonl"
    sweep = fly_all(whole, journal, on_cores(1))
    first = [next(sweep), next(sweep)]
    sweep.close()
    marked = [[msgspec.structs.replace(row, search_time_s=-1.0) for row in rows] for rows in first]
    journal.write_bytes(
        b"".join(msgspec.json.encode(rows) + b"\n" for rows in marked) + b'[{"policy":"gree'
    )  # cut off while it wrote
    rows = ordered([row for rows in fly_all(whole, journal, on_cores(1)) for row in rows], whole)
    assert sum(row.search_time_s < 0 for row in rows) == 4  # kept, not flown again
    assert untimed(rows) == untimed(
        ordered([row for flight in whole.flights for rows in fly(whole, [flight]) for row in rows], whole)
    )
    # And once more: all is in the journal now.
    again = ordered([row for rows in fly_all(whole, journal, on_cores(1)) for row in rows], whole)
    assert again == rows


def test_ten_million_missions_are_flown_as_they_come(tmp_path: Path) -> None:
    large = Sweep(("greedy", "thompson"), range(10**15))  # a list of so many would not fit into any memory
    assert large.count == 2 * 10**15

    def first_two(sweep: Sweep, tasks: Iterable[Sequence[Flight]]) -> Iterator[list[MissionRow]]:
        for flights in itertools.islice(tasks, 2):
            assert [flight[0] for flight in flights] == ["greedy", "thompson"]
            yield [msgspec.structs.replace(ROW, seed=flights[0][2])]

    assert [rows[0].seed for rows in fly_all(large, tmp_path / "journal.jsonl", first_two)] == [0, 1]


def test_a_journal_that_something_else_wrote_is_flown_anew(tmp_path: Path) -> None:
    small = Sweep(("greedy",), [7], particles=(100,), budget=3)
    journal = tmp_path / "journal.jsonl"
    journal.write_bytes(b'[]\n{}\n[{"policy":"greedy"}]\n\xff\xfe\n\0\0\n[[[[\n')
    (rows,) = fly_all(small, journal, on_cores(1))
    assert untimed(rows) == untimed(fly(small, [("greedy", 100, 7, "as-modelled")])[0])


def test_a_row_that_an_older_version_kept_is_read(tmp_path: Path) -> None:
    """A journal is only used by the code that wrote it: this is for the one who changes that."""
    young = ("sensor", "prior", "stop_on", "assume", "stop", "version", "world", "warned")
    old = {name: value for name, value in msgspec.structs.asdict(ROW).items() if name not in young}
    journal = tmp_path / "journal.jsonl"
    journal.write_bytes(msgspec.json.encode([old]) + b"\n")
    (rows,) = fly_all(Sweep(("greedy",), [7], particles=(100,)), journal, on_cores(1))
    assert rows == [ROW]


def test_missions_that_a_table_tells_in_full_are_not_flown_again(tmp_path: Path) -> None:
    few, table = replace(SMALL, particles=(100,), stops=SMALL.stops[:2]), tmp_path / "missions.csv.gz"
    rows = ordered((row for seed in (7, 8) for row in chain(*fly(few, flights_of(few, seed)))), few)
    other_way = msgspec.structs.replace(rows[0], seed=9, budget=81)
    half_told = [row for row in rows if (row.policy, row.seed, row.threshold_m) != ("greedy", 8, 0.9)]
    write_csv([*half_told, other_way], table)
    asked: list[Flight] = []

    def noted(_: Sweep, tasks: Iterable[Sequence[Flight]]) -> Iterator[list[MissionRow]]:
        asked.extend(chain(*tasks))
        yield from ()

    kept = list(fly_all(few, tmp_path / "journal.jsonl", noted, read_csv(table)))
    assert sorted((of[0].policy, of[0].seed) for of in kept) == [
        ("greedy", 7),
        ("thompson", 7),
        ("thompson", 8),
    ]
    assert {len(of) for of in kept} == {2}
    assert sorted((policy, seed) for policy, _, seed, _ in asked) == [
        ("greedy", 8),
        ("greedy", 9),
        ("thompson", 9),
    ]


LONG = replace(  # settings of more than six digits; so is the margin, √(100 · 50) / 3 m
    SMALL,
    policies=("greedy",),
    particles=(50,),
    stops=(Criterion(0.1234567), Criterion(0.1234568)),
    budget=1,
    moves={"step": 1.2345678},
    knowledge={"assume": "field"},
    problem=Problem(area=Area((-20.0, 0.0), (80.0, 50.0))),
    fleet=Fleet(2, separation_m=3.4567891),
)


def test_settings_of_many_digits_are_recognised_in_a_table(tmp_path: Path) -> None:
    rows = fly(LONG, flights_of(LONG, 7))[0]
    write_csv(rows, tmp_path / "missions.csv")
    read = read_csv(tmp_path / "missions.csv")
    assert [row.threshold_m for row in read] == [0.1234567, 0.1234568]
    assert read[0].margin_m == pytest.approx(math.sqrt(100 * 50) / 3, rel=1e-12)
    assert list(complete(LONG, read)) == flights_of(LONG, 7)


def test_settings_are_recognised_in_a_table_of_six_digits() -> None:
    few = replace(LONG, stops=(Criterion(0.5),))
    ((row,),) = fly(few, flights_of(few, 7))
    older = msgspec.structs.replace(row, step_m=1.23457, margin_m=23.5702, separation_m=3.45679)
    assert complete(few, [older]) == {row.flight: [older]}
    assert not complete(few, [msgspec.structs.replace(older, margin_m=23.5703)])


def test_the_rows_of_the_leaderboard_are_recognised() -> None:
    field = named_problem(str(ROOT / "missions" / "wide-field.yaml"))
    seeds = range(1_000_000, 1_000_100)
    sweep = Sweep(("homing", "lookahead"), seeds, knowledge={"assume": "field"}, problem=field)
    assert len(complete(sweep, read_csv(ROOT / "results/leaderboard/wide-field.csv.gz"))) == sweep.count


def flights_of(sweep: Sweep, seed: int) -> list[Flight]:
    return [flight for flight in sweep.flights if flight[2] == seed]


@pytest.mark.full
def test_a_table_is_filled_up_and_left_alone_once_it_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    table = tmp_path / "missions.csv"
    flags = (
        "--policy",
        "greedy",
        "--particles",
        "100",
        "--budget",
        "10",
        "--workers",
        "1",
        "--missions",
        "missions.csv",
    )

    def evaluate(count: str) -> int | None:
        return main(arguments=["evaluate", *flags, "--resume", "--scenarios", count])

    assert evaluate("1") == 0
    (first,) = read_csv(table)
    assert evaluate("2") == 0
    assert read_csv(table)[0] == first  # its times, too
    assert [row.seed for row in read_csv(table)] == [1_000_000, 1_000_001]
    written = table.stat().st_mtime_ns
    assert evaluate("2") == evaluate("1") == 0
    assert table.stat().st_mtime_ns == written
    table.write_text("nonsense")
    assert evaluate("1") == 2


def test_rows_of_another_problem_stay_in_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wide.yaml").write_text("area: {low: [-20, 0], high: [80, 50]}")
    flags = "--policy greedy --scenarios 1 --particles 50 --budget 2 --workers 1 --missions missions.csv"
    for problem in ("wide.yaml", "paper"):
        assert main(arguments=["evaluate", *flags.split(), "--problem", problem, "--resume"]) == 0
    wide, paper = read_csv(tmp_path / "missions.csv")
    assert wide.flight == paper.flight
    assert (wide.problem, paper.problem) == ('{"area":{"low":[-20.0,0.0],"high":[80.0,50.0]}}', "paper")


@pytest.mark.parametrize("keeping", [("--resume",), ()], ids=["resumed", "new"])
def test_rows_that_another_command_adds_to_the_table_meanwhile_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keeping: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = "--policy greedy --scenarios 1 --particles 50 --budget 2 --workers 1 --missions missions.csv"
    on_cores = sweep.on_cores

    def beside_another(workers: int) -> sweep.Flyer:
        monkeypatch.setattr(sweep, "on_cores", on_cores)
        assert main(arguments=["evaluate", *flags.split(), "--first-seed", "5", *keeping]) == 0
        return on_cores(workers)

    monkeypatch.setattr(sweep, "on_cores", beside_another)
    assert main(arguments=["evaluate", *flags.split(), "--first-seed", "3", *keeping]) == 0
    assert [row.seed for row in read_csv(tmp_path / "missions.csv")] == [5, 3]
    assert main(arguments=["evaluate", *flags.split(), "--first-seed", "4", "--force"]) == 0
    assert [row.seed for row in read_csv(tmp_path / "missions.csv")] == [4]


@pytest.mark.parametrize(
    ("in_the_way", "line"),
    [
        (Path.touch, "error: no folder 'runs' to keep missions in: File exists\n"),
        (
            lambda runs: runs.symlink_to("/proc/self"),
            "error: 'runs/kept.jsonl', which keeps missions, cannot be written: No such file or directory\n",
        ),
    ],
    ids=["file", "folder"],
)
def test_where_missions_cannot_be_kept_none_is_flown(
    in_the_way: Callable[[Path], None],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep, "journal_of", lambda _, folder: folder / "kept.jsonl")
    in_the_way(tmp_path / "runs")
    assert main(arguments=["evaluate", "--policy", "greedy", "--scenarios", "1", "--budget", "2"]) == 2
    assert capsys.readouterr() == ("", line)


@pytest.mark.timeout(400)
def test_a_pipe_is_not_read_for_rows_to_keep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    reader = os.open("pipe", os.O_RDWR)
    flags = "--policy greedy --scenarios 1 --particles 50 --budget 2 --workers 1 --missions pipe --resume"
    assert main(arguments=["evaluate", *flags.split()]) == 0
    said = os.read(reader, 100_000).decode().splitlines()
    os.close(reader)
    assert [line.partition(",")[0] for line in said] == ["policy", "greedy"]


ROLLED_OUT, EVALUATED = "rollout", "evaluate --scenarios 2 --workers 1"


@pytest.mark.parametrize("command", [ROLLED_OUT, EVALUATED])
def test_a_source_inside_a_building_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "inside.yaml").write_text("source: [7.5, 10]")
    flags = "--problem inside.yaml --world walls:file=courtyard"
    assert main(arguments=[*command.split(), *flags.split()]) == 2
    said = capsys.readouterr().err
    assert said.endswith("error: the source (7.5, 10) is inside a building; wanted one in the open\n")
    assert "Traceback" not in said


@pytest.mark.parametrize("command", [ROLLED_OUT, EVALUATED])
def test_a_recorded_plume_that_is_cut_off_within_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    movie = writers.zarr(Path("m.zarr"), np.ones((6, 30, 30)), chunks=(1, 30, 30))
    for frame in range(1, 6):
        (movie / "concentration" / f"{frame}.0.0").write_bytes(bytes(100))
    world = "recorded:file=m.zarr,fps=2,source_x=2,source_y=40,wind=180"
    assert main(arguments=[*command.split(), "--world", world]) == 2
    said = capsys.readouterr().err
    assert re.search(r"error: m\.zarr/concentration/\d\.0\.0: 100 bytes; wanted 7,200 of a chunk\n$", said)
    assert "Traceback" not in said


@pytest.mark.parametrize("edited", ["bundle", "world"])
def test_a_row_of_a_bundle_or_a_worlds_file_that_was_edited_since_is_flown_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edited: str
) -> None:
    monkeypatch.chdir(tmp_path)
    corners = "buildings: [{{footprint: [[{}, 26], [29, 26], [29, 29]], height: 5}}]"
    a_bundle(Path("a.zip"), seed=0)
    Path("yard.yaml").write_text(corners.format(26))
    few = Sweep(("a.zip",), range(7, 8), particles=(50,), budget=1, worlds=("walls:file=yard.yaml",))

    def in_process(sweep: Sweep, tasks: Iterable[Sequence[Flight]]) -> Iterator[list[MissionRow]]:
        yield from chain(*(fly(sweep, flights) for flights in tasks))

    write_csv(chain(*fly_all(few, tmp_path / "journal.jsonl", in_process)), tmp_path / "missions.csv")
    rows = read_csv(tmp_path / "missions.csv")
    assert len(complete(few, rows)) == 1
    if edited == "bundle":
        a_bundle(Path("a.zip"), seed=1)
    else:
        Path("yard.yaml").write_text(corners.format(26.5))
    assert not complete(few, rows)
    assert list(map(answers(few), rows)) == [True]  # so it stays in no table beside the new one
    older = [msgspec.structs.replace(row, files=None) for row in rows]
    assert len(complete(few, older)) == 1


def test_a_row_answers_a_sweep_of_its_own_settings_alone() -> None:
    few = replace(SMALL, particles=(50,), seeds=range(7, 8), stops=SMALL.stops[:1], budget=1)
    sweeps = [
        few,
        replace(few, budget=2),
        replace(few, moves={"step": 0.5}),
        replace(few, moves={"headings": 8}),
        replace(few, stops=(Criterion(within=(1.0, 0.9)),)),
        replace(few, problem=Problem(area=Area((-20.0, 0.0), (80.0, 50.0)))),
        replace(few, fleet=Fleet(2)),
        replace(few, fleet=Fleet(2, separation_m=4.0)),
        replace(few, knowledge={"assume": "field"}),
        replace(few, knowledge={"margin_m": 4.0}),
        replace(few, knowledge={"sensor": Hits()}),
        replace(few, knowledge={"priors": {"q": Uniform(100.0, 500.0)}}),
        replace(few, knowledge={"stop_limits": {"x": 2.0}}),
    ]
    flown = [fly(each, [("greedy", 50, 7, "as-modelled")])[0][0] for each in sweeps]
    for each, own in zip(sweeps, flown, strict=True):
        assert list(filter(answers(each), flown)) == [own]


def test_another_question_has_another_journal(tmp_path: Path) -> None:
    others = [
        replace(SMALL, budget=81),
        replace(SMALL, stops=(Criterion(0.9),)),
        replace(SMALL, knowledge={"stop_on_location": False}),
    ]
    assert len({journal_of(sweep, tmp_path) for sweep in [SMALL, *others]}) == 4
    assert journal_of(replace(SMALL, seeds=range(7, 100)), tmp_path) == journal_of(
        SMALL, tmp_path
    )  # more of the same goes on


def test_figures_are_named_by_policy_and_by_what_else_differs() -> None:
    two = [("greedy", 100, 7, "as-modelled"), ("greedy", 100, 8, "as-modelled")]
    rows = ordered([row for flight in two for rows in fly(SMALL, [flight]) for row in rows], SMALL)
    assert list(named([row for row in rows if row.threshold_m == 0.9])) == ["greedy"]
    assert list(named(rows)) == [
        f"greedy particles=100 threshold={threshold_m:g}" for threshold_m in (0.5, 0.9, 2.0)
    ]


def test_several_worlds_are_flown_each_as_alone_and_named_in_the_key(tmp_path: Path) -> None:
    few = replace(
        SMALL, stops=(Criterion(0.9),), particles=(100,), seeds=range(7, 9), worlds=("wind-30", "as-modelled")
    )
    rows = ordered(
        [row for each in fly_all(few, tmp_path / "journal.jsonl", on_cores(1)) for row in each], few
    )
    assert [(row.policy, row.world, row.seed) for row in rows] == list(
        itertools.product(few.policies, few.worlds, few.seeds)
    )
    assert few.count == 8
    for row in rows:
        alone, _ = rollout(row.seed, row.policy, 100, 0.9, 80, world=row.world, assume="paper")
        assert (row.error_m, row.distance_m, row.source_x) == (
            alone.error_m,
            alone.distance_m,
            alone.source[0],
        )
        assert (row.floor_m is None) == (row.world != "as-modelled")  # the floor is that of a right model
    assert {row.floor_m for row in rows if row.world == "as-modelled"} == {
        floors_m(draw(seed), [0.9])[0.9] for seed in few.seeds
    }
    keys = [f"{policy} world={world}" for policy in few.policies for world in few.worlds]
    assert list(named(rows)) == keys
    assert [said["world"] for said in named(rows).values()] == [*few.worlds] * 2
    assert list(named([row for row in rows if row.world == "wind-30"])) == ["greedy", "thompson"]
    both = [*rows, *(msgspec.structs.replace(row, particles=200) for row in rows)]
    assert next(iter(named(both))) == "greedy world=wind-30 particles=100 threshold=0.9"
    # The journal knows one world from another, too.
    again = fly_all(replace(few, worlds=("wind-30",)), tmp_path / "journal.jsonl", on_cores(1))
    assert {(row.policy, row.world, row.seed) for each in again for row in each} == set(
        itertools.product(few.policies, ["wind-30"], few.seeds)
    )


def test_a_mission_is_judged_by_where_the_source_truly_is() -> None:
    (rows,) = fly(replace(SMALL, worlds=("source-outside",)), [("greedy", 100, 7, "source-outside")])
    assert {(row.source_x, row.source_y) for row in rows} == {
        World(draw(7), 7, name="source-outside").truth.source
    }
    for row in rows:
        assert row.error_m == pytest.approx(
            np.hypot(row.estimate_x - row.source_x, row.estimate_y - row.source_y)
        )


@pytest.mark.parametrize("name", ["missions.csv", "missions.csv.gz"])
def test_a_table_of_missions_reads_back_as_it_was_written(tmp_path: Path, name: str) -> None:
    (rows,) = fly(
        replace(SMALL, stops=(Criterion(0.01), Criterion(0.5))), [("greedy", 100, 7, "as-modelled")]
    )
    assert rows[0].floor_m is None  # too small a ζ for it
    rows = [*rows, msgspec.structs.replace(rows[0], world="cv-1")]
    write_csv(rows, tmp_path / name)
    text = (gzip.decompress if name.endswith("gz") else bytes)((tmp_path / name).read_bytes()).decode()
    assert text.startswith(
        "policy,particles,threshold_m,seed,budget,headings,step_m,measurements,ceased,located,"
    )
    for row, read in zip(rows, read_csv(tmp_path / name), strict=True):
        for wrote, said in zip(msgspec.structs.astuple(row), msgspec.structs.astuple(read), strict=True):
            assert said == (pytest.approx(wrote, rel=1e-5) if isinstance(wrote, float) else wrote)


def test_a_table_of_something_else_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("policy,particles\ngreedy,many\n")
    with pytest.raises(ValueError, match=r"other\.csv: .*particles"):
        read_csv(tmp_path / "other.csv")


@pytest.mark.parametrize("begin", [b"", b"\xff\xfe", b"seed;policy\n"])
def test_what_does_not_begin_as_a_table_is_refused_in_its_first_line(tmp_path: Path, begin: bytes) -> None:
    (tmp_path / "other.csv").write_bytes(begin)
    with pytest.raises(ValueError, match=r"other\.csv: line 1: "):
        read_csv(tmp_path / "other.csv")


def test_a_table_that_a_spreadsheet_has_saved_is_read(tmp_path: Path) -> None:
    """Which begins with a byte order mark."""
    path = tmp_path / "rows.csv"
    write_csv([ROW], path)
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert read_csv(path) == [ROW]


def test_resuming_without_a_table_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments=["evaluate", "--resume", "--scenarios", "1"]) == 2
    said = "error: --resume: needs --missions FILE.csv, the table whose rows it keeps\n"
    assert capsys.readouterr().err == said


def test_a_small_table_that_unpacks_without_end_is_refused(tmp_path: Path) -> None:
    packed = gzip.compress(b"policy\n" + bytes(200_000_000))
    assert len(packed) < 200_000
    (tmp_path / "bomb.csv.gz").write_bytes(packed)
    tracemalloc.start()
    try:
        with pytest.raises(
            ValueError, match=r"bomb\.csv\.gz: line 1: wanted lines of less than 10,000 characters"
        ):
            read_csv(tmp_path / "bomb.csv.gz")
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_rows_carry_the_floor_of_their_scenario_where_it_is_known() -> None:
    flight = ("greedy", 100, 7, "as-modelled")
    (rows,) = fly(SMALL, [flight])
    assert {row.threshold_m: row.floor_m for row in rows} == floors_m(draw(7), [0.9, 2.0, 0.5])
    for other in (replace(SMALL, moves={"step": 0.5}), replace(SMALL, knowledge={"sensor": Hits()})):
        assert {row.floor_m for row in fly(other, [flight])[0]} == {None}


def test_rows_say_what_the_estimator_was_told_and_who_flew_them() -> None:
    flight = ("greedy", 100, 7, "as-modelled")
    (usual,) = fly(SMALL, [flight])[0][:1]
    assert (usual.sensor, usual.prior, usual.stop_on, usual.version) == (
        "gaussian:0.3,0.2",
        None,
        "location",
        __version__,
    )
    told = {
        "priors": {"q": Gamma(2, 150), "u": Uniform(1, 4)},
        "stop_limits": {"q": 50.0},
        "stop_on_location": False,
        "sensor": Hits(),
    }
    (other,) = fly(replace(SMALL, knowledge=told), [flight])[0][:1]
    assert (other.prior, other.stop_on) == ("q=gamma:2,150 u=uniform:1,4", "q=50.0")
    assert other.sensor == "hits:3.0,0.1"


def test_rows_say_the_assumption_and_the_stop(tmp_path: Path) -> None:
    flight = ("greedy", 100, 7, "as-modelled")
    usual = fly(SMALL, [flight])[0][0]
    assert (usual.assume, usual.stop, usual.threshold_m) == ("paper", "spread", 0.9)
    within = replace(SMALL, stops=(Criterion(within=(2.0, 0.9)),), knowledge={"assume": "field"}, budget=3)
    ((row,),) = fly(within, [flight])
    assert (row.assume, row.stop, row.threshold_m, row.floor_m) == ("field", "within:2,0.9", None, None)
    write_csv([row, usual], tmp_path / "rows.csv")
    assert [(read.assume, read.stop, read.threshold_m) for read in read_csv(tmp_path / "rows.csv")] == [
        ("field", "within:2,0.9", None),
        ("paper", "spread", 0.9),
    ]
    (figures,) = named([row]).values()
    assert (figures["assume"], figures["stop"], figures["threshold_m"]) == ("field", "within:2,0.9", None)
    (figures,) = named([usual]).values()
    assert (figures["assume"], figures["stop"], figures["threshold_m"]) == ("paper", "spread:0.9", 0.9)
    assert list(named([row, msgspec.structs.replace(row, particles=50)])) == [
        "greedy particles=100",
        "greedy particles=50",
    ]


def test_a_sweep_stops_within_a_radius_where_a_rollout_does() -> None:
    within = replace(SMALL, stops=(Criterion(within=(2.0, 0.9)),))
    ((row,),) = fly(within, [("greedy", 100, 8, "as-modelled")])
    alone, _ = rollout(8, "greedy", 100, budget=80, assume="paper", stop="within:2,0.9")
    assert (row.ceased, row.located, row.steps, row.distance_m) == (
        alone.ceased,
        alone.located,
        alone.steps,
        alone.distance_m,
    )
    assert row.ceased
    assert row.steps < 80


SEVERAL = (
    Criterion(within=(1.0, 0.99)),
    Criterion(0.5),
    Criterion(within=(1.0, 0.95)),
    Criterion(2.0),
    Criterion(within=(4.0, 0.5)),
)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "knowledge", [{}, {"assume": "field", "stop_limits": {"q": 400.0}}], ids=["paper", "field"]
)
@pytest.mark.parametrize(
    ("policy", "seed", "world"),
    [("homing", 8, "as-modelled"), ("ppo", 9, "noise-doubled"), ("greedy", 7, "stuck")],
)
def test_one_flight_serves_several_criteria_each_as_if_it_was_alone(
    policy: str, seed: int, world: str, knowledge: dict
) -> None:
    flight = (policy, 150, seed, world)
    (rows,) = fly(
        Sweep((policy,), range(seed, seed + 1), (150,), SEVERAL, 70, knowledge=knowledge, worlds=(world,)),
        [flight],
    )
    assert [Criterion(row.threshold_m).text if row.threshold_m else row.stop for row in rows] == [
        stop.text for stop in SEVERAL
    ]
    for row, stop in zip(rows, SEVERAL, strict=True):
        ready = mission(seed, policy, 150, stop.threshold_m, 70, world=world, within=stop.within, **knowledge)
        beliefs = [step.belief for step in ready.steps]  # of a mission that its own criterion ends
        last = beliefs[-1]
        assert (row.ceased, row.steps, row.spread_m) == (last.ceased, last.step, last.spread)
        assert (row.estimate_x, row.estimate_y) == last.mean
        assert row.distance_m == sum(
            math.dist(*pair) for pair in itertools.pairwise(it.position for it in beliefs)
        )
        near_m = stop.within[0] if stop.within else stop.threshold_m
        assert row.warned == any(
            min(it.p_value, it.wind_p_value) < 1e-4 or (it.spread < near_m and it.evidence < 5)
            for it in beliefs
        )
    if world == "stuck":
        assert {(row.ceased, row.warned) for row in rows} == {(False, True)}


def test_a_flight_ends_when_all_criteria_have_been_met(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    told = sweep.warning
    monkeypatch.setattr(sweep, "warning", lambda said, config: seen.append(said.step) or told(said, config))
    (rows,) = fly(replace(SMALL, stops=SEVERAL, budget=300), [("homing", 200, 8, "as-modelled")])
    assert all(row.ceased for row in rows)
    assert max(seen) == max(row.steps for row in rows) < 300


def test_figures_are_named_by_the_stop_where_stops_differ() -> None:
    small = replace(SMALL, stops=SEVERAL, budget=3)
    rows = ordered(
        [row for seed in (8, 7) for row in fly(small, [("greedy", 100, seed, "as-modelled")])[0]], small
    )
    assert [row.seed for row in rows] == [7, 8] * 5
    stops = ("spread:0.5", "spread:2", "within:1,0.95", "within:1,0.99", "within:4,0.5")
    assert list(named(rows)) == [f"greedy stop={stop}" for stop in stops]
    assert [said["stop"] for said in named(rows).values()] == list(stops)
    assert list(named([row for row in rows if row.threshold_m is None and row.stop == "within:1,0.95"])) == [
        "greedy"
    ]
    both = [
        msgspec.structs.replace(row, particles=count)
        for count in (50, 100)
        for row in rows
        if row.stop == "within:4,0.5"
    ]
    assert list(named(both)) == ["greedy particles=50", "greedy particles=100"]


def test_a_learned_policy_has_neither_headings_nor_measurements_of_a_planner(tmp_path: Path) -> None:
    few = replace(SMALL, policies=("ppo", "greedy"), budget=3)
    learned, planned = (fly(few, [(policy, 100, 7, "as-modelled")])[0][0] for policy in few.policies)
    assert (learned.headings, learned.measurements) == (None, None)
    assert (planned.headings, planned.measurements) == (4, 25)
    write_csv([learned, planned], tmp_path / "rows.csv")
    lines = [line.split(",")[5:8] for line in (tmp_path / "rows.csv").read_text().splitlines()]
    assert lines == [["headings", "step_m", "measurements"], ["", "1", ""], ["4", "1", "25"]]
    assert msgspec.json.decode(msgspec.json.encode(learned))["headings"] is None


def test_the_tables_of_older_versions_are_read() -> None:
    """Those have no columns of the sensor, the priors, the stop and the version; learned policies have
    headings there.
    """
    path = Path(__file__).with_name("older.csv")
    lines = path.read_text().splitlines()
    assert lines[0].endswith(",update_ms")
    rows = read_csv(path)
    assert len(rows) == len(lines) - 1
    planned, learned = (
        [row for row in rows if (row.policy == "infotaxis") == planner] for planner in (True, False)
    )
    assert {(row.headings, row.measurements) for row in planned} == {(4, 25)}
    assert {(row.headings, row.measurements) for row in learned} == {(None, None)}
    assert {(row.assume, row.stop) for row in rows} == {("paper", "spread")}
    assert {(row.sensor, row.prior, row.stop_on, row.version, row.world) for row in rows} == {
        ("gaussian:0.3,0.2", None, "location", None, "as-modelled")
    }
    first = dict(zip(lines[0].split(","), lines[1].split(","), strict=True))
    assert (rows[0].seed, rows[0].steps, rows[0].nees) == (
        int(first["seed"]),
        int(first["steps"]),
        float(first["nees"]),
    )


def test_a_table_that_was_cut_off_is_refused_by_name(tmp_path: Path) -> None:
    whole = tmp_path / "whole.csv.gz"
    write_csv([ROW] * 200, whole)
    (tmp_path / "half.csv.gz").write_bytes(whole.read_bytes()[:-20])
    text = gzip.decompress(whole.read_bytes()).decode()
    (tmp_path / "half.csv").write_text(text[: text.rindex(",")])
    (tmp_path / "more.csv").write_text(text.rstrip() + ",7\r\n")
    for name in ("half.csv.gz", "half.csv", "more.csv"):
        with pytest.raises(ValueError, match=rf"{name}: line \d+: "):
            read_csv(tmp_path / name)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"distance_m": "-3"}, "distance_m -3.0 is not allowed; wanted a number from 0"),
        ({"search_time_s": "nan"}, "search_time_s nan is not allowed; wanted a number from 0"),
        ({"estimate_x": "inf"}, "estimate_x inf is not allowed; wanted a finite number"),
        ({"vehicles": "0"}, "vehicles 0 is not allowed; wanted a number from 1"),
        ({"steps": "301"}, "steps 301 is not allowed; wanted 300 at most, the budget"),
        ({"ceased": "False"}, "it has not ceased, and yet is located or outside"),
        ({"outside": "True"}, "located and outside are both True; wanted one of them at most"),
        ({"error_m": "1.5"}, "located, with error_m 1.5; wanted 1 at most"),
    ],
)
def test_a_row_that_no_mission_can_have_had_is_refused_with_its_line(
    tmp_path: Path, changes: dict[str, str], said: str
) -> None:
    path = tmp_path / "rows.csv"
    write_csv([ROW, ROW], path)
    with path.open(newline="") as file:
        first, second = csv.DictReader(file)
    assert first.keys() > changes.keys()
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*first])
        writer.writeheader()
        writer.writerows([first, second | changes])
    with pytest.raises(ValueError, match=rf"rows\.csv: line 3: {said}$"):
        read_csv(path)


def test_a_table_that_cannot_be_finished_leaves_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    write_csv([ROW, ROW], path)
    with pytest.raises(TypeError):
        write_csv([ROW, "no row"], path)  # type: ignore[list-item]
    assert read_csv(path) == [ROW, ROW]
    assert list(tmp_path.iterdir()) == [path]
