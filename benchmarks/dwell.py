"""How long to hover in puffs: searches by the time that the vehicle hovers for a reading, and what the
estimator advises after them.

    python -m benchmarks.dwell                          # the tables of docs/trust.md
    python -m benchmarks.dwell --world puffs:share=0.1  # this world again; the rows of the others stay

Missions are flown in-process as `plumeward rollout` flies them, under `field`, with the paper's sensor. The
first table is what the advice was chosen by, from the test seeds; the second one tests it on other seeds and
worlds. results/dwell/missions.csv has a row a mission.
"""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from multiprocessing import Pool
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.figures import UNKNOWN, bootstrap, wilson
from agent.trials.rollout import mission
from benchmarks.pages import placed, table
from benchmarks.trust import BUDGET, DEFAULT, PARTICLES
from estimator.criterion import USUAL_THRESHOLD_M
from estimator.dwell import DOWNWIND
from link import cli
from link.files import whole
from plume.flight import leg_s
from plume.scenario import AS_MODELLED, SUCCESS_RADIUS_M
from plume.sensors.names import GAUSSIAN
from plume.worlds.names import check, separate

ROOT = Path(__file__).parents[1]
ROWS = ROOT / "results" / "dwell" / "missions.csv"
PAGE = ROOT / "docs" / "trust.md"
MISSIONS = 60
DWELLS_S = (0.0, 1.0, 2.0, 5.0)
CHOSEN_BY = (
    AS_MODELLED,
    *(f"puffs:share={share:g}" for share in (0.5, 0.2, 0.1, 0.05)),
    "puffs:share=0.05,rate=5",
    "puffs:share=0.05,rate=2",
)
HELD_OUT = (
    AS_MODELLED,
    "wind-30",
    "noise-doubled",
    "cv-1",
    "puffs:share=0.3",
    "puffs:share=0.2,meander=10",
    "puffs:share=0.05",
    "puffs:share=0.1,rate=3",
)
HELD_OUT_SEED = FIRST_TEST_SEED + 10_000


class Search(msgspec.Struct, frozen=True):
    """How a search ended, and what its last belief said of the gas."""

    world: str
    dwell_s: float
    seed: int
    ceased: bool
    located: bool
    readings: int
    distance_m: float
    time_s: float  # legs and hovers, by the vehicle's own motion
    # Quantiles of the gas's coefficient of variation downwind of the source.
    cv_low: float
    cv: float
    cv_high: float
    advised_s: float  # 0 if as long as it hovered
    advised_at: int | None  # number of the first reading after which another dwell was advised


class Cell(NamedTuple):
    """Searches that differ by their seeds alone."""

    world: str
    dwell_s: float
    first_seed: int


def search(world: str, dwell_s: float, seed: int) -> Search:
    """Fly one mission."""
    known: dict[str, Any] = {"sensor": replace(GAUSSIAN, dwell=dwell_s), "assume": "field"}
    flown = mission(seed, DEFAULT, PARTICLES, USUAL_THRESHOLD_M, BUDGET, world=world, **known)
    said = [step.belief for step in flown.steps]
    places = np.array([it.position for it in said])
    last = said[-1]
    is_near = math.dist(last.mean, flown.scenario.source) <= SUCCESS_RADIUS_M
    return Search(
        world,
        dwell_s,
        seed,
        last.ceased,
        last.ceased and is_near,
        len(said),
        float(np.sqrt(np.square(np.diff(places, axis=0)).sum(axis=1)).sum()),
        float(leg_s(places[:-1], places[1:]).sum()) + len(said) * dwell_s,
        *last.intermittency[DOWNWIND],
        last.advised_dwell,
        next((number for number, it in enumerate(said) if it.advised_dwell), None),
    )


def cells() -> list[Cell]:
    """Return what is flown."""
    chosen = [Cell(world, dwell_s, FIRST_TEST_SEED) for world in CHOSEN_BY for dwell_s in DWELLS_S]
    return [*chosen, *(Cell(world, 0.0, HELD_OUT_SEED) for world in HELD_OUT)]


def of_cell(rows: Iterable[Search], cell: Cell) -> list[Search]:
    """Return the rows of a cell."""
    low, high = cell.first_seed, cell.first_seed + (HELD_OUT_SEED - FIRST_TEST_SEED)
    return [it for it in rows if (it.world, it.dwell_s) == cell[:2] and low <= it.seed < high]


def line(searches: Sequence[Search]) -> list[str]:
    """Return a row of the first table: what became of searches in a world with a dwell."""
    count, ceased = len(searches), [it for it in searches if it.ceased]
    located = sum(it.located for it in ceased)
    times = np.array([(it.time_s, it.located) for it in searches])
    find_s = bootstrap(
        times, lambda draws: draws[..., 0].sum(axis=1) / np.maximum(draws[..., 1].sum(axis=1), 1)
    )
    return [
        searches[0].world,
        f"{searches[0].dwell_s:g}",
        f"{count}",
        wilson(located, count).text(100.0, 0),
        wilson(len(ceased) - located, len(ceased)).text(100.0, 1) if ceased else UNKNOWN,
        f"{np.mean([it.distance_m for it in ceased]):.0f}" if ceased else UNKNOWN,
        f"{np.mean([it.time_s for it in ceased]):.0f}" if ceased else UNKNOWN,
        find_s.text(1.0, 0) if located else UNKNOWN,
        *of_gas(searches),
    ]


def of_gas(searches: Sequence[Search]) -> list[str]:
    """Return the cells of both tables that say what the beliefs said of the gas, and what was advised."""
    count = len(searches)
    low, cv = (np.median([getattr(it, name) for it in searches]) for name in ("cv_low", "cv"))
    advised = sorted({it.advised_s for it in searches} - {0.0})
    shares = [f"{100 * sum(it.advised_s == each for it in searches) / count:.0f}" for each in advised]
    said = [f"{share}: {each:g} s" for share, each in zip(shares, advised, strict=True)]
    return [f"{cv:.2f} / {low:.2f}", ", ".join(said) or "0"]


def held_out_line(searches: Sequence[Search]) -> list[str]:
    """Return a row of the second table."""
    count, longer = len(searches), [it for it in searches if it.advised_s]
    at = [it.advised_at for it in longer if it.advised_at is not None]
    ever = sum(it.advised_at is not None for it in searches)
    return [
        searches[0].world,
        *of_gas(searches),
        wilson(len(longer), count).text(100.0, 0),
        wilson(ever, count).text(100.0, 0),
        f"{np.median(at):.0f} of {np.median([it.readings for it in longer]):.0f}" if at else UNKNOWN,
    ]


def read(path: Path) -> list[Search]:
    """Read the rows; none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        said = [{name: value or None for name, value in row.items()} for row in csv.DictReader(file)]
    return msgspec.convert(said, list[Search], strict=False)


def write(rows: Iterable[Search], path: Path) -> None:
    """Write the rows in the order of the cells."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rank = {world: number for number, world in enumerate((*HELD_OUT, *CHOSEN_BY))}
    with whole(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Search.__struct_fields__)
        for row in sorted(
            rows, key=lambda it: (it.seed >= HELD_OUT_SEED, rank[it.world], it.dwell_s, it.seed)
        ):
            values = msgspec.structs.astuple(row)
            writer.writerow(f"{value:.6g}" if isinstance(value, float) else value for value in values)


def page(text: str, rows: Sequence[Search]) -> str:
    """Return the page with its tables made anew. Raises ValueError if it has no place for a table."""
    flown = [(cell, found) for cell in cells() if (found := of_cell(rows, cell))]
    heads = [
        "world",
        "dwell, s",
        "missions",
        "located, %",
        "false, %",
        "MTD, m",
        "to the stop, s",
        "a find, s",
    ]
    gas = ["cv: median / 5%", "advised, %"]
    chosen = table([*heads, *gas], [line(found) for cell, found in flown if cell.first_seed < HELD_OUT_SEED])
    tested = table(
        ["world", *gas, "longer, %", "ever in flight, %", "first at reading"],
        [held_out_line(found) for cell, found in flown if cell.first_seed >= HELD_OUT_SEED],
    )
    return placed(placed(text, "dwell", chosen), "advice", tested)


def main() -> None:
    """Fly the searches, and write rows and tables."""
    parser = cli.Parser(
        prog="python -m benchmarks.dwell", description="The tables of docs/trust.md on dwells."
    )
    parser.add_argument(
        "--missions", type=cli.whole(1, 10_000), default=MISSIONS, metavar="N", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--world",
        type=cli.listed(cli.checked(check), separate),
        default=[*CHOSEN_BY, *HELD_OUT],
        metavar="NAME,NAME",
        help="fly these only (default: all)",
    )
    parser.add_argument("--resume", action="store_true", help="fly only what is missing")
    parser.add_argument("--workers", type=cli.whole(1, 64), default=2, metavar="W", help="(default: 2)")
    args = parser.parse_args()
    rows = read(ROWS)
    with Pool(args.workers) as pool:
        for cell in cells():
            old = of_cell(rows, cell)
            kept = old if args.resume else []
            seeds = range(cell.first_seed, cell.first_seed + args.missions)
            missing = sorted({*seeds} - {it.seed for it in kept})
            if cell.world not in args.world or not missing:
                continue
            new = pool.starmap(search, [(cell.world, cell.dwell_s, seed) for seed in missing], chunksize=1)
            rows = [*(it for it in rows if it not in old), *kept, *new]
            write(rows, ROWS)
            print(" ".join(line([*kept, *new])), flush=True)
    with whole(PAGE) as partial:
        partial.write_text(page(PAGE.read_text(), rows))
    print(PAGE)


if __name__ == "__main__":
    cli.run(main)
