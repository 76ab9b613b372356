"""What the stop is worth in recorded plumes: films two, flies in them, and writes the table of docs/trust.md.

    python -m benchmarks.recorded          # half an hour; the films are kept in runs/recorded/

One plume is that of `benchmarks/solver.py`, the other one that of puffs in a wind that wanders. Missions are
flown as `plumeward evaluate` flies them, from the test seeds, in worlds of `recorded`: the seed draws at
which time the film starts, and the film is turned so that its wind comes from where the mission's does. A
film knows one wind and one rate: it is played faster or slower, so that its wind has the mission's speed, and
its gas is multiplied, so that its rate is the mission's. Gas that moves faster by a factor is what diffusion
and wind of that factor make, and a rate of that factor with the lifetime by it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from agent.trials.evaluate import FIRST_TEST_SEED, KEPT_IN, read_csv, write_csv
from agent.trials.figures import UNKNOWN, MissionRow, cell, figures
from agent.trials.sweep import Sweep, fly
from benchmarks import solver
from benchmarks.pages import placed, table
from benchmarks.trust import BUDGET, DEFAULT, PARTICLES, STOPS
from link import cli
from link.files import whole
from plume.elementary import Array
from plume.scenario import Scenario, draw
from plume.worlds.names import named

ROOT = Path(__file__).parents[1]
ROWS = ROOT / "results" / "recorded" / "missions.csv.gz"
PAGE = ROOT / "docs" / "trust.md"
FILMS = KEPT_IN / "recorded"
SEED = 1  # of the films
LENGTH_S, FPS = 600.0, 5
FILLING_S = 60.0  # until gas has been everywhere
GRID = solver.Grid()
PUFFS = "puffs:share=0.1,meander=15,gusts=0.2,wander=10"
# The film's own release; d is of the puffs.
RELEASE = Scenario(
    source=(0.0, 0.0),
    q=solver.RATE,
    u=solver.WIND_MPS,
    phi=math.pi,
    d=4.5,
    tau=solver.LIFETIME_S,
    start=(0.0, 0.0),
)
MISSIONS = 1000


class Plume(NamedTuple):
    """A plume to film."""

    about: str
    frames: Callable[[], Iterator[Array]]  # frames (y, x) of gas, g/m³, FPS a second


def of_solver() -> Iterator[Array]:
    """Yield the frames of the solver's gas."""
    steps = round(1 / (FPS * solver.STEP_S))
    filled = round(FILLING_S / solver.STEP_S)
    for gas, _ in islice(solver.solved(GRID, SEED), filled, None, steps):
        yield gas.T


def of_puffs() -> Iterator[Array]:
    """Yield the frames of gas in puffs."""
    air = named(PUFFS).air(RELEASE, SEED)
    x, y = ((np.arange(count) - at) * GRID.cell_m for count, at in zip(GRID.cells, GRID.source, strict=True))
    places = np.zeros((len(x) * len(y), 3))
    places[:, 0], places[:, 1] = np.tile(x, len(y)), np.repeat(y, len(x))
    frame = 0
    while True:
        yield air(places, np.full(len(places), frame / FPS))[0].reshape(len(y), len(x))
        frame += 1


PLUMES = {
    "solver": Plume("advection and diffusion in turbulent wind, on a grid", of_solver),
    "puffs": Plume(f"`{PUFFS}`", of_puffs),
}


def film(name: str, length_s: float, folder: Path) -> Path:
    """Film a plume; returns the file, float16 frames (t, y, x)."""
    path = folder / f"{name}.npy"
    folder.mkdir(parents=True, exist_ok=True)
    frames = islice(PLUMES[name].frames(), round(length_s * FPS))
    with whole(path) as partial_file, partial_file.open("wb") as file:
        np.save(file, np.stack([frame.astype(np.float16) for frame in frames]))
    return path


def world(path: Path, seed: int) -> str:
    """Return the name of the recorded world of a mission: the film at its pace and of its rate."""
    told = draw(seed)
    pace = told.u / RELEASE.u
    source_x, source_y = GRID.source
    return (
        f"recorded:file={path},fps={FPS * pace:.6g},scale={GRID.cell_m:g},"
        f"gain={told.q / (RELEASE.q * pace):.6g},source_x={source_x},source_y={source_y},wind=180"
    )


def flown(path: Path, seed: int) -> list[MissionRow]:
    """Fly one mission; returns a row for each stop criterion, of a world of the film's name."""
    name = world(path, seed)
    sweep = Sweep(
        (DEFAULT,), range(seed, seed + 1), (PARTICLES,), STOPS, BUDGET, {}, {"assume": "field"}, (name,)
    )
    [rows] = fly(sweep, [(DEFAULT, PARTICLES, seed, name)])
    return [msgspec.structs.replace(row, world=path.stem) for row in rows]


def line(name: str, stop: str, rows: Sequence[MissionRow]) -> list[str]:
    """Return a row of the table."""
    said = figures(rows)
    stops = [row.nees for row in rows if row.ceased]
    warned = said["false_stop_warned"]
    return [
        PLUMES[name].about,
        f"`{stop}`",
        cell(said, "false_stop"),
        UNKNOWN if warned is None else f"{100 * warned:.0f}",
        f"{100 * said['ceased']:.1f} / {100 * said['located']:.1f}",
        UNKNOWN if said["mtd_m"] is None else f"{said['mtd_m']:.1f}",
        f"{np.mean(stops):.2f} ({np.median(stops):.2f})" if stops else UNKNOWN,
    ]


def page(text: str, rows: Sequence[MissionRow]) -> str:
    """Return the page with its table made anew. Raises ValueError if it has no place for it."""
    heads = ["plume", "stop", "false, %", "warned", "ceased / located", "MTD, m", "NEES: mean (median)"]
    lines = [
        line(name, stop.text, of)
        for name in PLUMES
        for stop in STOPS
        if (of := [row for row in rows if (row.world, row.criterion) == (name, stop.text)])
    ]
    missions = max((len({row.seed for row in rows if row.world == name}) for name in PLUMES), default=0)
    made = f"N = {PARTICLES:,}, at most {BUDGET} steps, {missions:,} missions in each plume.\n"
    return placed(text, "recorded", f"{table(heads, lines)}\n{made}")


def main() -> None:
    """Film, fly and write the table."""
    parser = cli.Parser(
        prog="python -m benchmarks.recorded", description="The table of recorded plumes of docs/trust.md."
    )
    parser.add_argument(
        "--missions", type=cli.whole(1, 100_000), default=MISSIONS, metavar="N", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--length",
        type=cli.number(1.0, 3600.0),
        default=LENGTH_S,
        metavar="S",
        help="of the films, s (default: %(default)g)",
    )
    parser.add_argument("--workers", type=cli.whole(1, 64), default=2, metavar="W", help="(default: 2)")
    args = parser.parse_args()
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions)
    rows: list[MissionRow] = []
    with get_context("spawn").Pool(args.workers) as pool:
        for name in PLUMES:
            path = film(name, args.length, FILMS)
            print(path, flush=True)
            rows += [row for of in pool.imap(partial(flown, path), seeds) for row in of]
    text = page(PAGE.read_text(), rows)
    ROWS.parent.mkdir(parents=True, exist_ok=True)
    write_csv(rows, ROWS)
    with whole(PAGE) as partial_file:
        partial_file.write_text(text)
    print(PAGE)


def read() -> list[MissionRow]:
    """Return the rows that are kept."""
    return read_csv(ROWS) if ROWS.exists() else []


if __name__ == "__main__":
    cli.run(main)
