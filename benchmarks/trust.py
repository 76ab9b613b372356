"""What the stop is worth: missions in all worlds under both assumptions, and the tables of docs/trust.md.

    python -m benchmarks.trust           # every world, assumption and policy, on all cores
    python -m benchmarks.trust --resume  # the missing missions only; if none is missing, only the tables
    python -m benchmarks.trust --world wind-30 --policy homing  # these again; all other results stay

Missions are flown as `plumeward evaluate` flies them, from the test seeds (1,000,000 and up); one flight
serves all stop criteria. results/trust/ASSUME-POLICY.csv.gz holds one row per mission, stop criterion and
world, results/trust/figures.csv the figures of each assumption, policy, world and stop criterion. The rows
of a world are written when all its missions are complete. They have a folder of their own, because
`plumeward report` takes all rows of its folder to be of one kind. docs/trust.md keeps its prose.
"""

import csv
import os
import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from agent.policies import policy
from agent.trials.evaluate import FIRST_TEST_SEED, KEPT_IN, read_csv, write_csv
from agent.trials.figures import COLUMNS, UNKNOWN, MissionRow, cell, figures, wilson
from agent.trials.sweep import Sweep, flown, journal_of, on_cores
from agent.trials.workers import WorkerLost
from benchmarks.pages import placed, table
from estimator.criterion import Criterion
from link import cli
from link.files import whole
from plume.scenario import AS_MODELLED
from plume.sensors.names import GAUSSIAN, parse
from plume.sensors.names import text as sensor_text
from plume.worlds.errors import WRONG
from plume.worlds.names import check, separate

ROOT = Path(__file__).parents[1]
MOVING = (
    *(f"puffs:share={share:g}" for share in (0.5, 0.2, 0.1, 0.05)),
    *(f"puffs:share=0.2,meander={degrees}" for degrees in (10, 20)),
    "walls:file=courtyard",
)
"""Worlds whose gas moves: the truth is near to what `field` assumes, but lies not in it."""
HOVERING = "gaussian:dwell=2"
INSTRUMENTS = ("pid", "tdlas", "tgs2600")
"""They hover as long as docs/sensors.md recommends, which is their usual dwell."""
WITH = {f"{world} with 2 s of dwell": (world, sensor_text(parse(HOVERING))) for world in MOVING} | {
    f"{world} with {name}": (world, name)
    for world, name in product((AS_MODELLED, "puffs:share=0.2"), INSTRUMENTS)
}
"""Worlds that are flown with another sensor, too, by what the tables call that: world and sensor."""
WORLDS = (AS_MODELLED, *WRONG, *MOVING, *WITH)
RESULTS = ROOT / "results" / "trust"
PAGE = ROOT / "docs" / "trust.md"
FIGURES = "figures.csv"
PARTICLES = 1000
BUDGET = 600
"""Twice the usual: under `field` a search takes longer."""
STOPS = (Criterion(0.5), Criterion(within=(1.0, 0.95)), Criterion(within=(1.0, 0.99)))
PROMISED = {"spread:0.5": "about 98", "within:1,0.95": "94.5", "within:1,0.99": "98.5"}
"""Least share of stops within 1 m, %, by criterion: for `within:1,P` half a point below P, as a belief has
finitely many particles.
"""
SHOWN = "spread:0.5"
"""The stop of the table of worlds: the default one."""
DEFAULT, OTHERS = "homing", ("infotaxis", "ppo")
"""The policies of the tables."""
BEYOND_THE_MODEL = ("cv-1-correlated", "source-beyond", "two-sources", "stuck", "stuck-noisy")
"""Worlds that `field` does not model, or in which no source can be found."""
HOLDS = {
    "paper": (AS_MODELLED, "readings-lost", "source-outside"),
    "field": (
        AS_MODELLED,
        *(name for name in WRONG if name not in BEYOND_THE_MODEL),
    ),
}
"""The worlds whose truth lies in an assumption, by its name."""
LONG = (
    "ceased",
    "located",
    "outside",
    "false_stop",
    "false_stop_warned",
    "mtd_m",
    "nees_mean",
    "update_ms",
    "decision_ms",
)
"""Figures of figures.csv, each with its interval."""

Cell = tuple[str, str, str]
"""(assumption, policy, world)."""
Rows = dict[Cell, dict[str, list[MissionRow]]]
"""Rows by cell and stop criterion."""
Said = Mapping[tuple[str, str, str, str], dict[str, Any]]
"""`figures` by (assumption, policy, world, stop criterion)."""


def fly(cell: Cell, seeds: range, workers: int, there: Sequence[MissionRow]) -> tuple[list[MissionRow], Path]:
    """Fly the missions of a cell that are not `there` as `evaluate` does.

    Returns all their rows, and the journal that an interrupted call leaves.
    """
    assume, name, label = cell
    world, sensor = WITH.get(label, (label, sensor_text(GAUSSIAN)))
    known = {"assume": assume, "sensor": parse(sensor)}
    sweep = Sweep((name,), seeds, (PARTICLES,), STOPS, BUDGET, knowledge=known, worlds=(world,))
    journal = journal_of(sweep, KEPT_IN)
    what = f"missions of {', '.join(cell)}"
    return flown(sweep, journal, on_cores(workers), what, "starting", there), journal


def read(results: Path) -> Rows:
    """Read all rows that were written."""
    rows: Rows = {}
    for path in sorted(results.glob("*.csv.gz")):
        for row in read_csv(path):
            flown = row.assume, row.policy, label_of(row)
            rows.setdefault(flown, {}).setdefault(row.criterion, []).append(row)
    return rows


def label_of(row: MissionRow) -> str:
    """Return the name of a row's world in the tables, which says its sensor if it has another one."""
    labels = {flown: label for label, flown in WITH.items()}
    return labels.get((row.world, row.sensor), row.world)


def keep(results: Path, flown: Cell, rows: Sequence[MissionRow]) -> None:
    """Write the rows of a cell. They replace its earlier rows; those of other worlds in the file stay."""
    assume, name, label = flown
    path = results / f"{assume}-{Path(name).name}.csv.gz"
    results.mkdir(parents=True, exist_ok=True)
    there = [row for row in read_csv(path) if label_of(row) != label] if path.exists() else []
    rank = {name: i for i, name in enumerate(WORLDS)}
    write_csv(sorted([*there, *rows], key=lambda row: rank[label_of(row)]), path)


def is_there(rows: Rows, flown: Cell, seeds: range) -> bool:
    """Whether all missions of a cell have been flown, with all stop criteria."""
    there = rows.get(flown, {})
    return all({row.seed for row in there.get(stop.text, [])}.issuperset(seeds) for stop in STOPS)


def write_figures(said: Said, path: Path) -> None:
    """Write the long table: a line for each assumption, policy, world and stop criterion, shares from 0 to
    1.
    """
    heads = [head for key in LONG for head in (key, f"{key}_low", f"{key}_high")]
    with whole(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["assume", "policy", "world", "stop", "missions", *heads])
        for key, row in said.items():
            values = [
                value for name in LONG for value in (row[name], *(row[f"{name}_interval"] or (None, None)))
            ]
            writer.writerow(
                [*key, row["missions"], *("" if value is None else f"{value:.6g}" for value in values)]
            )


def promise(rows: Rows) -> str:
    """Return the first table: each criterion under each assumption, over the worlds whose truth lies in
    the assumption.
    """
    lines = []
    for assume, stop in product(HOLDS, STOPS):
        flown = {
            world: rows[assume, DEFAULT, world][stop.text]
            for world in HOLDS[assume]
            if (assume, DEFAULT, world) in rows
        }
        ceased = {world: [row for row in of if row.ceased] for world, of in flown.items()}
        stops = [row for of in ceased.values() for row in of]
        if not stops:
            continue
        held = {
            world: wilson(sum(not row.false_stop for row in of), len(of))
            for world, of in ceased.items()
            if of
        }
        worst = min(held, key=lambda world: held[world].value)
        p50, p95 = np.quantile([row.error_m for row in stops], [0.5, 0.95])
        lines.append(
            [
                assume,
                f"`{stop.text}`",
                f"{len(flown)} of {len(HOLDS[assume])}",
                f"{100 * len(stops) / sum(map(len, flown.values())):.1f}",
                PROMISED[stop.text],
                wilson(sum(not row.false_stop for row in stops), len(stops)).text(100.0, 1),
                f"{100 * held[worst].value:.1f}, {worst}",
                f"{p50:.2f} / {p95:.2f}",
                f"{np.mean([row.nees for row in stops]):.2f}",
            ]
        )
    heads = [
        "assume",
        "stop",
        "worlds",
        "ceased, %",
        "promised, %",
        "kept, %",
        "worst world",
        "error p50 / p95, m",
        "NEES",
    ]
    return table(heads, lines)


def worlds(said: Said, rows: Rows) -> str:
    """Return the second table: a row for each world that has been flown, with the default stop."""
    names, distances = compared(rows)

    def figure(world: str, assume: str, name: str, *keys: str) -> str:
        row = said.get((assume, name, world, SHOWN))
        values = [None if row is None else row[key] for key in keys]
        return " / ".join(
            UNKNOWN if value is None else form(key, value) for key, value in zip(keys, values, strict=True)
        )

    def form(key: str, value: float) -> str:
        _, scale, digits = COLUMNS.get(key, ("", 100.0, 0))
        return f"{scale * value:.{digits}f}"

    def false_stop(world: str, assume: str, name: str) -> str:
        row = said.get((assume, name, world, SHOWN))
        return UNKNOWN if row is None else cell(row, "false_stop")

    def median(world: str) -> str:
        of = rows.get(("field", DEFAULT, world), {}).get(SHOWN, [])
        ceased = [row.nees for row in of if row.ceased and not row.outside]
        return f" ({np.median(ceased):.1f})" if ceased else ""

    flown = {world for _, _, world, _ in said}
    lines = [
        [
            world,
            false_stop(world, "paper", DEFAULT),
            false_stop(world, "field", DEFAULT),
            figure(world, "field", DEFAULT, "false_stop_warned"),
            figure(world, "field", DEFAULT, "ceased", "located", "outside"),
            " / ".join(figure(world, assume, DEFAULT, "mtd_m") for assume in ("paper", "field")),
            figure(world, "field", DEFAULT, "nees_mean") + median(world),
            *(false_stop(world, "field", name) for name in names if name != DEFAULT),
            distances.get(world, UNKNOWN),
        ]
        for world in WORLDS
        if world in flown
    ]
    heads = [
        "world",
        "paper: false, %",
        "field: false, %",
        "warned",
        "ceased / located / outside",
        "MTD p / f, m",
        "NEES (median)",
        *(f"{name}: false, %" for name in names if name != DEFAULT),
        f"{' / '.join(names)}, m",
    ]
    return table(heads, lines)


def compared(rows: Rows) -> tuple[list[str], dict[str, str]]:
    """Return the policies that flew under `field`, and by world the mean distance to a stop of each, over
    the missions that all who flew there have flown.
    """
    flew = {name for assume, name, _ in rows if assume == "field"}
    names = sorted(flew, key=lambda name: (name != DEFAULT, name))
    distances = {}
    for world in WORLDS:
        flown = {name: rows[cell][SHOWN] for name in names if (cell := ("field", name, world)) in rows}
        if len(flown) > 1:
            seeds = set.intersection(*({row.seed for row in of} for of in flown.values()))
            common = {
                name: _travelled([row for row in of if row.seed in seeds]) for name, of in flown.items()
            }
            distances[world] = " / ".join(common.get(name, UNKNOWN) for name in names)
    return names, distances


def _travelled(rows: Sequence[MissionRow]) -> str:
    """Return the mean distance to a stop, and the share of missions located, %, where it is below 99."""
    stops_m = [row.distance_m for row in rows if row.ceased]
    located = 100 * float(np.mean([row.located for row in rows]))
    return (f"{np.mean(stops_m):.1f}" if stops_m else UNKNOWN) + (
        f" ({located:.0f}%)" if located < 99 else ""
    )


def page(text: str, rows: Rows, said: Said) -> str:
    """Return the page with its tables made anew from all rows; its prose stays. Raises ValueError if it
    has no place for a table.
    """
    counts = sorted({len(of) for stops in rows.values() for of in stops.values()}) or [0]
    many = " to ".join(f"{count:,}" for count in dict.fromkeys((counts[0], counts[-1])))
    made = (
        f"\nN = {PARTICLES:,}, at most {BUDGET} steps, {many} missions for each assumption, policy and "
        "world.\n"
    )
    return placed(placed(text, "promise", promise(rows) + made), "worlds", worlds(said, rows))


def main() -> int:
    """Fly the chosen missions, write their rows, and write figures and tables from all rows."""
    parser = cli.Parser(
        prog="python -m benchmarks.trust",
        description="Fly policies in all worlds and write the tables of docs/trust.md.",
    )
    parser.add_argument(
        "--missions",
        type=cli.whole(1, 1_000_000),
        default=1000,
        metavar="N",
        help="missions in each world (default: %(default)s)",
    )
    several = (
        ("--assume", cli.listed(cli.checked(_is_assumption)), HOLDS),
        ("--world", cli.listed(cli.checked(_is_world), separate), WORLDS),
        ("--policy", cli.listed(cli.checked(policy)), (DEFAULT, *OTHERS)),
    )
    for flag, kind, usual in several:
        parser.add_argument(
            flag,
            type=kind,
            default=list(usual),
            metavar="NAME,NAME",
            help=f"(default: {', '.join(usual)})",
        )
    parser.add_argument("--resume", action="store_true", help="fly only what is missing")
    cores = os.cpu_count() or 1
    parser.add_argument(
        "--workers",
        type=cli.whole(1, 4096),
        default=cores,
        metavar="W",
        help="worker processes (default: all cores)",
    )
    parser.add_argument(
        "--results",
        type=Path,
        default=RESULTS,
        metavar="DIR",
        help="folder of the rows (default: %(default)s)",
    )
    parser.add_argument(
        "--page", type=Path, default=PAGE, metavar="FILE.md", help="page of the tables (default: %(default)s)"
    )
    args = parser.parse_args()
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions)
    there = read(args.results) if args.resume else {}
    cells = [it for it in product(args.assume, args.policy, args.world) if not is_there(there, it, seeds)]
    done = 0
    try:
        for flown in cells:
            known = [row for of in there.get(flown, {}).values() for row in of]
            rows, journal = fly(flown, seeds, args.workers, known)
            keep(args.results, flown, rows)
            journal.unlink(missing_ok=True)
            done += 1
    except WorkerLost as error:
        print(f"error: {error}", file=sys.stderr)
        return cli.FAILED
    finally:
        if done < len(cells):
            print(
                f"{done} of {len(cells)} worlds were flown; run the command again with --resume to fly the "
                "others",
                file=sys.stderr,
            )
        write(read(args.results) if cells else there, args.results, args.page)
    print(args.page)
    return 0


def write(rows: Rows, results: Path, document: Path) -> None:
    """Write the long table to a folder, and the page."""
    said = {(*flown, stop): figures(of) for flown, stops in rows.items() for stop, of in stops.items()}
    results.mkdir(parents=True, exist_ok=True)
    write_figures(said, results / FIGURES)
    text = page(document.read_text(), rows, said)
    with whole(document) as partial:
        partial.write_text(text)


def _is_world(name: str) -> None:
    if name not in WITH:
        check(name)


def _is_assumption(text: str) -> None:
    if text not in HOLDS:
        raise ValueError(f"{text!r} is not allowed; wanted {' or '.join(HOLDS)}")


if __name__ == "__main__":
    cli.run(main)
