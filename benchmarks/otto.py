"""Our planners on the OTTO benchmark's own problem, beside what OTTO's planners need there.

    python -m benchmarks.otto                           # all cases; the table of docs/planners.md
    python -m benchmarks.otto --cases windy-low         # one case again; the others keep their rows

`benchmarks/otto_grid.py` is the problem, `benchmarks/otto_rules.py` the planners on its grid, and
`benchmarks/otto_value.py` the trained value policy. results/otto/figures.csv has a row a case and planner.
"""

import csv
import math
from collections.abc import Iterable, Sequence
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agent.trials.evaluate import FIRST_TEST_SEED
from benchmarks.otto_grid import CASES, Search, search
from benchmarks.otto_rules import RULES
from benchmarks.otto_value import CASE, value
from benchmarks.pages import placed, table
from link import cli
from link.files import whole

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "results" / "otto" / "figures.csv"
PAGE = ROOT / "docs" / "planners.md"
VALUE = "value policy"
RUNS = {"isotropic-19x19": 6000, "isotropic-53x53": 1000, "windy-medium": 800, "windy-low": 200}


class Row(NamedTuple):
    """What a planner needs in a case."""

    case: str
    planner: str
    runs: int
    steps: float  # mean expected steps to the source
    error: float  # standard error of the mean
    stalled: float  # share of runs


class Reference(NamedTuple):
    """What was measured with OTTO's planners: mean steps, standard error."""

    steps: float
    error: float


# isotropic-19x19 and windy-low: OTTO's own classes and loop, 5,000 and 200 runs. The others: an evaluator
# that was checked against OTTO's classes action by action.
REFERENCES = {
    ("isotropic-19x19", "infotaxis"): Reference(14.06, 0.15),
    ("isotropic-19x19", "space-aware-infotaxis"): Reference(13.54, 0.15),
    ("isotropic-53x53", "infotaxis"): Reference(36.7, 0.5),
    ("isotropic-53x53", "space-aware-infotaxis"): Reference(34.0, 1.0),
    ("windy-medium", "infotaxis"): Reference(71.2, 1.3),
    ("windy-medium", "space-aware-infotaxis"): Reference(70.5, 2.0),
    ("windy-low", "infotaxis"): Reference(227.7, 14.3),
}


def planners(case: str) -> list[str]:
    """The planners that are run in a case."""
    return [*RULES, *([VALUE] if case == CASE.name else [])]


def searched(case: str, planner: str, seed: int) -> Search:
    """Run one search."""
    return search(CASES[case], value if planner == VALUE else RULES[planner], seed)


def row(case: str, planner: str, searches: Sequence[Search]) -> Row:
    """Return the figures of searches."""
    steps = np.array([it.expected for it in searches])
    error = float(np.std(steps, ddof=1)) / math.sqrt(len(steps)) if len(steps) > 1 else math.nan
    stalled = sum(it.stalled for it in searches) / len(searches)
    return Row(case, planner, len(steps), float(np.mean(steps)), error, stalled)


def read(path: Path) -> list[Row]:
    """Read the rows that are there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        _, *lines = csv.reader(file)
    return [Row(case, planner, int(runs), *map(float, figures)) for case, planner, runs, *figures in lines]


def keep(rows: Iterable[Row], path: Path) -> None:
    """Write the rows, to six digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial_file, partial_file.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        for case, planner, runs, *figures in rows:
            writer.writerow([case, planner, runs, *(f"{figure:.6g}" for figure in figures)])


def shown(rows: Iterable[Row]) -> str:
    """Return the table of the page."""
    there = {(row.case, row.planner): row for row in rows}
    lines = []
    for planner in (*RULES, VALUE):
        of = [there.get((case, planner)) for case in CASES]
        lines.append([f"`{planner}`" if planner in RULES else planner, *map(cell, of)])
        ours = [REFERENCES.get((case, planner)) for case in CASES]
        if any(ours):
            lines.append([f"{planner} of OTTO", *(number(*it) if it else "–" for it in ours)])
    runs = [max((row.runs for row in there.values() if row.case == case), default=0) for case in CASES]
    lines.append(["runs", *(f"{count:,}" for count in runs)])
    return table(["steps; stalls", *CASES], lines)


def number(steps: float, error: float) -> str:
    """A mean and its standard error."""
    return f"{steps:.{1 if error >= 0.3 else 2}f} ± {error:.{1 if error >= 0.3 else 2}f}"


def cell(row: Row | None) -> str:
    """A cell of the table."""
    return f"{number(row.steps, row.error)}; {100 * row.stalled:.1f}%" if row else "–"


def page(text: str, rows: Iterable[Row]) -> str:
    """Return the page with its table made anew. Raises ValueError if it has no place for it."""
    return placed(text, "otto", shown(rows))


def write(new: Row) -> None:
    """Keep a row in place of the old one, and write the page's table."""
    rows = {(row.case, row.planner): row for row in (*read(FIGURES), new)}
    ordered = [rows[key] for case in CASES for planner in planners(case) if (key := (case, planner)) in rows]
    text = page(PAGE.read_text(), ordered)
    keep(ordered, FIGURES)
    with whole(PAGE) as partial_file:
        partial_file.write_text(text)


def main() -> None:
    """Run the searches and write the table."""
    parser = cli.Parser(
        prog="python -m benchmarks.otto",
        description="Planners on the OTTO benchmark's problem: the table of docs/planners.md.",
    )
    parser.add_argument(
        "--cases", nargs="+", choices=list(CASES), default=list(CASES), metavar="CASE", help=", ".join(CASES)
    )
    parser.add_argument(
        "--runs",
        type=cli.whole(2, 1_000_000),
        metavar="N",
        help=f"of each planner and case (default: {', '.join(f'{n:,}' for n in RUNS.values())})",
    )
    parser.add_argument("--workers", type=cli.whole(1, 64), default=2, metavar="W", help="(default: 2)")
    args = parser.parse_args()
    with get_context("spawn").Pool(args.workers) as pool:
        for case in args.cases:
            seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + (args.runs or RUNS[case]))
            for planner in planners(case):
                searches = pool.map(partial(searched, case, planner), seeds, chunksize=10)
                write(row(case, planner, searches))
                print(case, planner, cell(row(case, planner, searches)), flush=True)
    print(PAGE)


if __name__ == "__main__":
    cli.run(main)
