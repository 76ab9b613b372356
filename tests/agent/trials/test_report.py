"""Protects the report: its tables against shares and means by hand, its pictures and page as files that
need nothing else.
"""

import argparse
import base64
import subprocess
import sys
import xml.etree.ElementTree as ET
from contextlib import ExitStack
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.policies import OURS
from agent.trials import rollout
from agent.trials.evaluate import write_csv
from agent.trials.figures import MissionRow
from agent.trials.report.command import FILES, run, save, write
from agent.trials.report.leaderboard import Leaderboard
from agent.trials.report.published import PUBLISHED
from agent.trials.report.results import Results, Setting, read
from agent.trials.report.tables import against_paper, tables
from link.cli import BadInput
from plume.outcome import Outcome, TracePoint
from plume.scenario import Scenario

pytestmark = pytest.mark.slow

PICTURES = ("particles", "thresholds", "trajectories", "hundred", "distances")


def flown(
    seed: int,
    ceased: bool = True,
    error_m: float = 0.5,
    distance_m: float = 40.0,
    *,
    policy: str = "greedy",
    particles: int = 100,
    threshold_m: float = 0.5,
    floor_m: float | None = 20.0,
) -> MissionRow:
    return MissionRow(
        policy=policy,
        particles=particles,
        threshold_m=threshold_m,
        seed=seed,
        budget=300,
        headings=4,
        step_m=1.0,
        measurements=25,
        ceased=ceased,
        located=ceased and error_m <= 1,
        estimate_x=error_m,
        estimate_y=0.0,
        source_x=0.0,
        source_y=0.0,
        error_m=error_m,
        spread_m=0.4,
        nees=2.0,
        steps=int(distance_m),
        distance_m=distance_m,
        floor_m=floor_m,
        search_time_s=0.5,
        decision_ms=2.0,
        update_ms=1.0,
    )


FOUR = [
    flown(1_000_000, True, 0.5, 30.0, floor_m=20.0),
    flown(1_000_001, True, 1.5, 50.0, floor_m=25.0),
    flown(1_000_002, True, 0.2, 40.0, floor_m=15.0),
    flown(1_000_003, False, 9.0, 300.0, floor_m=99.0),
]
"""Of four, three ceased and two are located."""


@pytest.fixture
def drawing() -> Any:
    """The module that draws the pictures; it loads matplotlib."""
    from agent.trials.report import drawing

    return drawing


def test_missions_flown_in_two_ways_are_not_joined(tmp_path: Path) -> None:
    write_csv(FOUR, tmp_path / "four.csv")
    for other in (
        {"headings": 8},
        {"sensor": "hits:3.0,0.1"},
        {"prior": "q=gamma:2,150"},
        {"stop_on": "location,q=50"},
    ):
        write_csv([msgspec.structs.replace(flown(1_000_004), **other)], tmp_path / "one.csv")
        with pytest.raises(
            ValueError, match=r"one\.csv: greedy was flown with other settings there \(budget, headings, step"
        ):
            read(tmp_path)


def test_missions_of_another_world_are_refused(tmp_path: Path) -> None:
    write_csv(FOUR, tmp_path / "four.csv")
    write_csv(
        [msgspec.structs.replace(flown(1_000_004), policy="homing", world="wind-30")], tmp_path / "one.csv"
    )
    with pytest.raises(
        ValueError,
        match=r"one\.csv: missions in the world 'wind-30'; a report takes those of 'as-modelled' alone$",
    ):
        read(tmp_path)


def test_missions_of_several_vehicles_are_refused(tmp_path: Path) -> None:
    write_csv([msgspec.structs.replace(flown(1_000_004), vehicles=2)], tmp_path / "two.csv")
    wanted = r"two\.csv: missions of 2 vehicles; a report takes those of one alone$"
    with pytest.raises(ValueError, match=wanted):
        read(tmp_path)


def test_new_missions_of_a_learned_policy_are_joined_to_those_of_an_older_version(tmp_path: Path) -> None:
    """Which gave it a planner's headings, and did not say which version it was."""
    write_csv([flown(1_000_000, policy="ppo")], tmp_path / "old.csv")
    new = msgspec.structs.replace(
        flown(1_000_001, policy="ppo"), headings=None, measurements=None, version="9"
    )
    write_csv([new], tmp_path / "new.csv")
    assert [row.seed for row in read(tmp_path).rows["ppo", Setting(100, 0.5)]] == [1_000_000, 1_000_001]


def results_of(folder: Path, rows: list[MissionRow]) -> Results:
    write_csv(rows, folder / "rows.csv")
    return read(folder)


def test_a_row_says_what_is_counted_by_hand(tmp_path: Path) -> None:
    _, by_particles, by_threshold = tables(results_of(tmp_path, FOUR))
    said = dict(zip(by_particles.heads, by_particles.rows[0], strict=True))
    assert (said["policy"], said["N"], said["ζ, m"], said["missions"]) == ("greedy", "100", "0.5", "4")
    # Wilson: (p + z²/2n ± z sqrt(p(1−p)/n + z²/4n²)) / (1 + z²/n) with z = 1.96.
    assert said["ceased, %"] == "75.0 [30.1, 95.4]"
    assert said["located, %"] == "50.0 [15.0, 85.0]"
    assert said["false stop, %"] == "33.3 [6.1, 79.2]"  # of those that ceased
    assert said["MTD, m"] == "40.0 [30.0, 50.0]"  # the one that never ceased does not count
    assert said["MTD, floors"].startswith("2.00 [")  # 40 / mean of 20, 25 and 15
    assert said["ST, s"] == "0.500 [0.500, 0.500]"
    assert by_threshold.heads == ["policy", "0.5 m"]
    assert by_threshold.rows == [["greedy", "50.0 [15.0, 85.0] / 40.0 [30.0, 50.0]"]]


def test_a_table_says_the_assumption_and_compares_one_assumption_and_one_kind_of_stop(tmp_path: Path) -> None:
    field = [msgspec.structs.replace(row, assume="field") for row in FOUR]
    results = results_of(tmp_path, field)
    assert results.assume == "field"
    assert [it.title for it in tables(results)[1:]] == [
        "Our figures at ζ = 0.5 m, assume field",
        "Located, % / MTD, m, at N = 100, by ζ, assume field",
    ]
    write_csv(FOUR, tmp_path / "paper.csv")
    with pytest.raises(
        ValueError, match=r"both assumptions, paper in paper\.csv and field in rows\.csv; wanted a folder"
    ):
        read(tmp_path)
    (tmp_path / "paper.csv").unlink()
    write_csv(
        [msgspec.structs.replace(FOUR[0], threshold_m=None, stop="within:1,0.99")], tmp_path / "within.csv"
    )
    with pytest.raises(
        ValueError, match=r"within\.csv: greedy was flown with --stop within:1,0\.99; a report compares"
    ):
        read(tmp_path)


def test_a_mission_in_two_files_counts_once(tmp_path: Path) -> None:
    write_csv(FOUR[:3], tmp_path / "a.csv")
    write_csv(FOUR[2:], tmp_path / "b.csv.gz")
    results = read(tmp_path)
    assert results.rows == {("greedy", Setting(100, 0.5)): FOUR}
    assert results.figures["greedy", Setting(100, 0.5)]["missions"] == 4


def test_the_papers_figures_stand_beside_ours_of_the_same_method_and_setting(tmp_path: Path) -> None:
    rows = [flown(seed, distance_m=60.0, policy="infotaxis", particles=4000) for seed in range(10)]
    rows += [
        flown(seed, seed > 0, distance_m=30.0, policy="dcee", particles=4000) for seed in range(10)
    ]  # one of ten never ceased
    rows += [flown(seed, distance_m=45.0, policy="thompson", particles=4000) for seed in range(10)]
    table = against_paper(results_of(tmp_path, rows))
    assert len(table.rows) == len(PUBLISHED)
    said = {(row[0], row[1], row[2]): row for row in table.rows}
    ceased = said["ceased, %", "N = 4000", "Infotaxis"]
    assert ceased[3:5] == ["88.39", "4000, 0.5"]
    assert ceased[5] == "infotaxis: 100.0 [72.2, 100.0], located 100.0 [72.2, 100.0] (10)"
    learned = said["MTD, m", "N = 4000", "AGDC-DDPG"]
    assert learned[5] == "–"
    assert (
        learned[6] == "thompson: 45.0 [45.0, 45.0], 2.25 [2.25, 2.25] floors (10)"
    )  # dcee flew less, but ceased less often
    assert said["MTD, m", "N = 100", "AGDC-DDPG"][5:7] == ["–", "–"]  # not flown with 100


@pytest.mark.parametrize(
    ("floor_m", "comparable"),
    [(20.0, "no: below the floor (4)"), (16.0, "in part (1, 3)"), (None, "in part (1, 3)")],
)
def test_what_lies_below_the_floor_is_not_compared(
    tmp_path: Path, floor_m: float | None, comparable: str
) -> None:
    table = against_paper(results_of(tmp_path, [flown(1_000_000, particles=4000, floor_m=floor_m)]))
    (row,) = (row for row in table.rows if row[3] == "16.83")
    assert row[-1] == comparable
    assert any(note.startswith("(4) 16.83 m") for note in table.notes) == (floor_m == 20.0)


def test_a_picture_compares_all_of_five_policies_or_the_five_that_matter_and_ones_own(drawing: Any) -> None:
    assert drawing.compared(["random", "greedy", "mine"]) == ["random", "greedy", "mine"]
    assert drawing.compared([*OURS, "mine"]) == [
        "infotaxis",
        "dcee",
        "space-aware-infotaxis",
        "homing",
        "ppo",
        "mine",
    ]
    others = [policy for policy in OURS if policy not in drawing.FIVE]
    assert drawing.compared(others) == others[:5]


def test_curves_are_of_the_policies_compared_and_the_papers_points_of_theirs(
    tmp_path: Path, drawing: Any
) -> None:
    rows = [
        flown(seed, policy=policy, particles=particles)
        for policy in OURS
        for particles in (100, 4000)
        for seed in range(3)
    ]
    figure = drawing.against(results_of(tmp_path, rows), "particles")
    shown = {text.get_text() for text in figure.legends[0].get_texts()}
    assert shown == {*drawing.FIVE, "paper: AGDC-PPO", "paper: Infotaxis", "information floor"}


def test_of_one_setting_each_policy_has_a_bar_as_long_as_its_figure(tmp_path: Path, drawing: Any) -> None:
    rows = FOUR + [flown(1_000_000 + i, policy="homing", distance_m=25.0 + i) for i in range(3)]
    results = results_of(tmp_path, rows)
    ceased, mtd, st = drawing.against(results, "particles").axes
    assert [text.get_text() for text in ceased.get_yticklabels()] == ["greedy", "homing"]
    for panel, lengths in ((ceased, [75, 100]), (mtd, [40, 26]), (st, [0.5, 0.5])):
        assert [bar.get_width() for bar in panel.patches] == pytest.approx(lengths)
        assert panel.get_xlim()[0] == 0
    assert ceased.get_xlim()[1] == 100
    several = [*rows, *(msgspec.structs.replace(row, particles=200) for row in rows)]
    assert not drawing.against(results_of(tmp_path, several), "particles").axes[0].patches


def test_each_panel_has_the_path_of_its_mission_and_the_last_one_the_legend(drawing: Any) -> None:
    scenario = Scenario(source=(10.0, 12.0), q=100.0, u=1.0, phi=0.0, d=1.0, tau=1.0, start=(0.0, 10.0))

    def flight(policy: str, *places: float) -> Any:
        trace = [TracePoint((x, 10.0), 0.0, (9.0, 11.0), 1.0) for x in places]
        return Outcome(
            0,
            policy,
            True,
            False,
            (9.0, 11.0),
            (10.0, 12.0),
            scenario,
            1.4,
            0.1,
            len(trace) - 1,
            1.0,
            1.0,
            "paper",
            "spread:0.5",
        ), trace

    *panels, last = drawing.trajectories([flight(f"p{i}", 0.0, 1.0 + i, 2.0 + i) for i in range(5)]).axes[:6]
    for i, panel in enumerate(panels):
        assert [line.get_xydata().tolist() for line in panel.lines] == [
            [[0.0, 10.0], [1.0 + i, 10.0], [2.0 + i, 10.0]],
            [[0.0, 10.0]],
            [[10.0, 12.0]],
            [[9.0, 11.0]],
        ]
        assert panel.get_title().startswith(f"p{i}\nceased, FALSE STOP")
    assert last.get_legend() is not None


def test_a_mission_that_has_ended_stays_in_the_median_with_its_last_distance(drawing: Any) -> None:
    scenario = Scenario(source=(10.0, 10.0), q=1.0, u=1.0, phi=0.0, d=1.0, tau=1.0, start=(0.0, 10.0))

    def flight(*places: float) -> Any:
        trace = [TracePoint((x, 10.0), 0.0, (10.0, 10.0), 1.0) for x in places]
        return Outcome(
            0,
            "greedy",
            True,
            True,
            (10.0, 10.0),
            (10.0, 10.0),
            scenario,
            0.0,
            0.1,
            len(trace) - 1,
            1.0,
            1.0,
            "paper",
            "spread:0.5",
        ), trace

    panel, *_, flying = drawing.distances(
        [flight(0.0, 8.0), flight(4.0, 5.0, 6.0, 7.0), flight(4.0, 6.0, 9.0)]
    ).axes
    (median,) = (line for line in panel.lines if line.get_label() == "median")
    np.testing.assert_allclose(median.get_ydata(), [6.0, 4.0, 2.0, 2.0])  # of 10 6 6, 2 5 4, 2 4 1, 2 3 1
    np.testing.assert_array_equal(flying.lines[0].get_ydata(), [3, 3, 2, 1])


class Links(HTMLParser):
    """What a page refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.to: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.to += [
            value or "" for name, value in attrs if name in ("src", "href", "data", "srcset", "action")
        ]


SEVERAL = [
    flown(
        seed, policy=policy, particles=particles, threshold_m=threshold_m, distance_m=30.0 + seed - 1_000_000
    )
    for policy in ("greedy", "thompson", "one that is not known")
    for particles, threshold_m in ((10, 0.5), (20, 0.5), (10, 0.9))
    for seed in range(1_000_000, 1_000_003)
] + [flown(1_000_000, False, policy="random", particles=20)]


def test_the_same_picture_is_the_same_file(tmp_path: Path, drawing: Any) -> None:
    import matplotlib

    from scene.drawing import STYLE

    results = results_of(tmp_path, SEVERAL)
    with matplotlib.rc_context(STYLE), ExitStack() as files:
        one, two = (
            save(drawing.against(results, "particles"), tmp_path / name, files) for name in ("one", "two")
        )
    assert one == two
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


@pytest.mark.full
def test_a_report_is_files_that_need_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "report"
    out.mkdir()
    write(results_of(tmp_path, SEVERAL), Leaderboard({}), out, flights=3)
    files = {path.name: path.read_bytes() for path in out.iterdir()}
    assert (
        set(files)
        == {
            "index.html",
            "results.md",
            *(f"{name}.{ending}" for name in PICTURES for ending in ("png", "svg")),
        }
        == set(FILES)
    )
    page = files["index.html"].decode()
    for name in PICTURES:
        assert ET.fromstring(files[f"{name}.svg"]).tag == "{http://www.w3.org/2000/svg}svg"
        assert base64.b64encode(files[f"{name}.svg"]).decode() in page
    links = Links(page).to
    assert len(links) == 2 * len(PICTURES) + 3  # contents and pictures; three tables
    assert all(link.startswith(("#", "data:image/svg+xml;base64,")) for link in links)
    assert "url(" not in page
    assert "3 missions of thompson, seeds 1000000 to 1000002, N = 20, ζ = 0.5 m" in page


@pytest.mark.parametrize("there", [(), ("particles.png",)], ids=["new", "forced"])
def test_a_report_that_is_interrupted_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: tuple[str, ...]
) -> None:
    """By its last missions most of its pictures are drawn."""
    results_of(tmp_path, SEVERAL)
    out, fly = tmp_path / "report", rollout.rollout
    out.mkdir()
    for name in there:
        (out / name).write_text("an older one")

    def interrupted(seed: int, *words: Any, **more: Any) -> Any:
        if seed == 1_000_002:
            raise KeyboardInterrupt
        return fly(seed, *words, **more)

    monkeypatch.setattr(rollout, "rollout", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(argparse.Namespace(results=tmp_path, out=out, force=True))
    assert {path.name: path.read_text() for path in out.glob("*")} == dict.fromkeys(there, "an older one")
    assert out.exists() == bool(there)


def test_without_matplotlib_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run(argparse.Namespace(results=tmp_path, out=tmp_path, force=False)) == 1
    assert capsys.readouterr().err == "error: report needs matplotlib: pip install 'plumeward[view]'\n"


@pytest.mark.parametrize("name", FILES)
def test_no_file_of_a_folder_is_written_over_unasked(tmp_path: Path, name: str) -> None:
    results_of(tmp_path, FOUR)
    (tmp_path / name).write_text("a page of mine")
    with pytest.raises(BadInput) as refused:
        run(argparse.Namespace(results=tmp_path, out=tmp_path, force=False))
    assert str(refused.value) == f"--out: '{tmp_path / name}' exists; wanted another name, or --force"
    assert {path.name for path in tmp_path.iterdir()} == {"rows.csv", name}
    assert (tmp_path / name).read_text() == "a page of mine"


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_drawn(capsys, tmp_path: Path) -> None:
    results_of(tmp_path, FOUR)
    with pytest.raises(BadInput) as refused:
        run(argparse.Namespace(results=tmp_path, out=Path("/proc"), force=False))
    said = "--out: '/proc/particles.png' cannot be written: No such file or directory"
    assert (str(refused.value), capsys.readouterr().out) == (said, "")


def test_the_service_does_not_pay_for_it() -> None:
    loaded = "import sys, agent.__main__; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", loaded], check=False).returncode == 0
