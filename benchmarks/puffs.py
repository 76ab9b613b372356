"""Gas in puffs: its statistics beside what is measured in the open, and how fast it is.

    python -m benchmarks.puffs               # every world; table and picture of docs/worlds.md
    python -m benchmarks.puffs --resume      # only worlds without rows; if there is none, table and picture
    NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.puffs --speed

The release is the middle of Table 1. The gas is followed at fixed places downwind, on the axis and one width
of the plume beside it, in many missions. results/puffs/figures.csv has a row a world and place. The page
keeps its prose.
"""

import csv
import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from agent.learn.env import SourceSearchVector
from benchmarks.env import USUAL, Flight, side_by_side, speeds
from benchmarks.pages import placed, table
from link import cli
from link.files import whole
from plume.elementary import Array
from plume.flight import usual_s
from plume.scenario import AS_MODELLED, Scenario
from plume.worlds.names import named
from plume.worlds.world import World

if TYPE_CHECKING:  # it takes long to import
    from matplotlib.figure import Figure
ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "results" / "puffs" / "figures.csv"
PAGE = ROOT / "docs" / "worlds.md"
PICTURE = "puffs.png"  # beside the page
WORLDS = (
    "puffs:share=0.05",
    "puffs:share=0.2",
    "puffs:share=0.5",
    "puffs:share=0.05,rate=1",
    "puffs:share=0.2,meander=20",
)
# The gas of the source at the origin goes to +x.
RELEASE = Scenario(source=(0.0, 0.0), q=300.0, u=2.5, phi=math.pi, d=4.5, tau=10.0, start=(0.0, 0.0))
DOWNWIND_M = (3.0, 5.0, 7.0, 10.0, 15.0, 20.0)
SHOWN = ((3.0, False), (10.0, False), (10.0, True))  # places of the table: how far; beside the axis
MISSIONS, LENGTH_S, EVERY_S = 200, 50.0, 0.05
THRESHOLD = 0.1  # gas is present above this share of its mean
STEP_S = usual_s(1)  # from one reading to the next
EXCEEDED = (0.999, 0.99, 0.95, 0.8, 0.5, 0.2, 0.05, 0.01, 0.001)  # probabilities to have more gas
SIZE_IN, DPI = (8.0, 6.0), 100
COLOURS = ("#d55e00", "#0072b2", "#009e73", "#882255", "#e69f00")
LAW_AT_M = 10.0  # the place downwind whose distribution is drawn

CROWD = 400  # puffs in the air
READINGS, BATCH = 2000, 64
LIMIT_MS, LEAST_RATIO = 0.2, 0.5  # wanted of a reading, and of the environment's speed


class Law(NamedTuple):
    """The left-shifted, clipped gamma law of Yee and Chan (1997): max(G − shift, 0), G of the gamma law."""

    shape: float
    scale: float
    shift: float

    def below(self, gas: Array) -> Array:
        """Probability of no more than this gas."""
        from scipy import special  # type: ignore[import-untyped]

        return np.asarray(special.gammainc(self.shape, (gas + self.shift) / self.scale))


class Row(NamedTuple):
    """Statistics of the gas in a world at a place."""

    world: str
    downwind_m: float
    crosswind_m: float
    mean: float  # g/m³
    cv: float  # fluctuation intensity: standard deviation by mean
    present: float  # intermittency factor: share of the time with more than `THRESHOLD` of the mean
    skewness: float
    kurtosis: float  # 3 of a normal law
    gamma: float  # greatest distance from the gamma law above the threshold, of distribution functions
    clipped: float  # and from the clipped one
    correlation_s: float  # time after which the correlation is 1/e
    after_step: float  # correlation over the time from one reading to the next
    exceeded: tuple[float, ...]  # gas by its mean that is exceeded with the probabilities `EXCEEDED`


def law(cv: float, present: float = 1.0) -> Law:
    """Return the clipped gamma law of mean 1 and this cv that is above 0 with the probability `present`.

    Yee and Chan take that from the second moment; here it is what was measured. The plain gamma law is the
    one with `present` 1. Raises ValueError if there is none.
    """
    from scipy import optimize, special

    if present == 1.0:
        return Law(1 / cv**2, cv**2, 0.0)

    def moments(log_shape: float) -> tuple[float, float, float]:
        k = math.exp(log_shape)
        cut = special.gammainccinv(k, present)
        none, one, two = (special.gammaincc(k + more, cut) for more in range(3))
        first = k * one - cut * none
        return first, k * (k + 1) * two - 2 * k * cut * one + cut**2 * none, cut

    def excess(log_shape: float) -> float:
        first, second, _ = moments(log_shape)
        return float(math.log(second / first**2) - math.log(1 + cv**2))

    log_shape = optimize.brentq(excess, math.log(0.005), math.log(5000.0))
    first, _, cut = moments(log_shape)
    return Law(math.exp(log_shape), 1 / first, cut / first)


def places() -> Array:
    """Places (P, 3) of the statistics, m."""
    width_m = [math.sqrt(2 * RELEASE.d * far / RELEASE.u) for far in DOWNWIND_M]
    return np.array(
        [
            (far, beside * wide, 0.0)
            for beside in (0, 1)
            for far, wide in zip(DOWNWIND_M, width_m, strict=True)
        ]
    )


def followed(world: str, missions: int, length_s: float) -> Array:
    """The gas of each mission at the places, every `EVERY_S`: (missions, T, P) g/m³."""
    there, times_s = places(), np.arange(0.0, length_s, EVERY_S)
    gas = np.empty((missions, len(times_s), len(there)))
    for seed in range(missions):
        air = named(world).air(RELEASE, seed)
        for k, time_s in enumerate(times_s.tolist()):
            gas[seed, k], _ = air(there, np.full(len(there), time_s))
    return gas


def statistics(gas: Array) -> dict[str, Any]:
    """Return the figures of a `Row`. gas: (missions, T), every `EVERY_S`."""
    mean, std = float(gas.mean()), float(gas.std())
    apart = (gas - mean) / std
    relative, cv = np.sort(gas, axis=None) / mean, std / mean
    above = relative > THRESHOLD
    present = float(above.mean())
    so_far = (np.arange(len(relative)) + 0.5) / len(relative)
    distances = []
    for each in (1.0, present):
        try:
            distances.append(float(np.abs(law(cv, each).below(relative) - so_far)[above].max()))
        except ValueError:
            distances.append(math.nan)
    return {
        "mean": mean,
        "cv": cv,
        "present": present,
        "skewness": float((apart**3).mean()),
        "kurtosis": float((apart**4).mean()),
        "gamma": distances[0],
        "clipped": distances[1],
        "correlation_s": EVERY_S * crossing(apart),
        "after_step": correlation(apart, round(STEP_S / EVERY_S)),
        "exceeded": tuple(np.quantile(relative, [1 - p for p in EXCEEDED]).tolist()),
    }


def correlation(apart: Array, lag: int) -> float:
    """Correlation over so many times of standardised gas (missions, T)."""
    return float((apart[:, : apart.shape[1] - lag] * apart[:, lag:]).mean())


def crossing(apart: Array) -> float:
    """Number of times after which the correlation of standardised gas (missions, T) falls to 1/e.

    NaN if it has not after half a mission.
    """
    wanted, before = math.exp(-1), 1.0
    for lag in range(1, apart.shape[1] // 2):
        if (now := correlation(apart, lag)) < wanted:
            return lag - (wanted - now) / (before - now)
        before = now
    return math.nan


def rows_of(world: str, missions: int = MISSIONS, length_s: float = LENGTH_S) -> list[Row]:
    """Follow the gas of a world; returns a row a place."""
    gas = followed(world, missions, length_s)
    return [
        Row(world, float(x), float(y), **statistics(gas[:, :, k])) for k, (x, y, _) in enumerate(places())
    ]


def read(path: Path) -> list[Row]:
    """Read the rows that are there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        _, *lines = csv.reader(file)
    few = len(Row._fields) - 2
    numbers = [(name, list(map(float, more))) for name, *more in lines]
    return [Row._make([name, *more[:few], tuple(more[few:])]) for name, more in numbers]


def keep(rows: Sequence[Row], path: Path) -> None:
    """Write the rows, to six digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*Row._fields[:-1], *(f"exceeded_{p:g}" for p in EXCEEDED)])
        for name, *figures, exceeded in rows:
            writer.writerow([name, *(f"{value:.6g}" for value in (*figures, *exceeded))])


def shown(rows: Sequence[Row]) -> str:
    """Return the table of the page."""
    lines = [
        [
            f"`{row.world}`" if (row.downwind_m, row.crosswind_m > 0) == SHOWN[0] else "",
            f"{row.downwind_m:g}" + (f", {row.crosswind_m:.0f} beside" if row.crosswind_m > 0 else ""),
            f"{row.present:.2f}",
            f"{row.cv:.2f}",
            f"{row.skewness:.1f} / {row.kurtosis:.1f} / {1.5 * row.skewness**2 + 3:.1f}",
            f"{row.gamma:.3f} / {row.clipped:.3f}",
            f"{row.correlation_s:.1f}",
            f"{row.after_step:.2f}",
        ]
        for world in WORLDS
        for row in rows
        if row.world == world and (row.downwind_m, row.crosswind_m > 0) in SHOWN
    ]
    heads = [
        "world",
        "downwind, m",
        "γ",
        "cv",
        "S / K / 1.5 S² + 3",
        "from gamma / clipped",
        "1/e after, s",
        f"after {STEP_S:.2f} s",
    ]
    return table(heads, lines)


def page(text: str, rows: Sequence[Row]) -> str:
    """Return the page with its table made anew. Raises ValueError if it has no place for it."""
    return placed(text, "puffs", shown(rows))


def write(rows: Sequence[Row], document: Path) -> None:
    """Write the page's table, and the picture beside it."""
    import matplotlib

    from scene.drawing import STYLE

    text = page(document.read_text(), rows)
    with whole(document) as partial:
        partial.write_text(text)
    with matplotlib.rc_context(STYLE), whole(document.with_name(PICTURE)) as partial:
        picture(rows).savefig(partial, format="png", dpi=DPI)


def picture(rows: Sequence[Row]) -> "Figure":
    """Draw intermittency and fluctuation against distance, the law at one place, and the fourth moment."""
    from matplotlib.figure import Figure

    from scene.drawing import INK, ticks

    figure = Figure(figsize=SIZE_IN, layout="constrained")
    (present, cv), (more, moments) = figure.subplots(2, 2)
    skewness = np.geomspace(0.2, 45.0, 50)
    moments.plot(skewness, 1.5 * skewness**2 + 3, color=INK, linewidth=1.0, label="gamma law")
    for world, colour in zip(WORLDS, COLOURS, strict=True):
        those = [row for row in rows if row.world == world]
        for beside, line in ((False, "o-"), (True, "^:")):
            there = [row for row in those if (row.crosswind_m > 0) == beside]
            style: dict[str, Any] = {"color": colour, "markersize": 3.5, "linewidth": 1.0}
            far = [row.downwind_m for row in there]
            present.plot(far, [row.present for row in there], line, **style)
            cv.plot(far, [row.cv for row in there], line, label="" if beside else world, **style)
        moments.plot(
            [row.skewness for row in those], [row.kurtosis for row in those], "o", color=colour, markersize=3
        )
        for row in those:
            if (row.downwind_m, row.crosswind_m) == (LAW_AT_M, 0.0):
                gas = np.geomspace(0.03, 40.0, 200)
                more.plot(row.exceeded, EXCEEDED, "o", color=colour, markersize=3.5)
                more.plot(gas, 1 - law(row.cv).below(gas), color=colour, linewidth=1.0)
    present.set(xlabel="downwind, m; dotted: beside", ylabel="γ: share of time with gas", ylim=(0, 1.03))
    cv.set(xlabel="downwind, m; dotted: beside", ylabel="cv: standard deviation / mean", yscale="log")
    ticks(cv.yaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10), "{:g}")
    more.set(
        xlabel=f"gas / its mean, {LAW_AT_M:g} m downwind; lines: gamma laws",
        ylabel="probability of more",
        xscale="log",
        yscale="log",
        xlim=(0.03, 40),
        ylim=(7e-4, 1.3),
    )
    ticks(more.xaxis, (0.1, 1, 10), "{:g}")
    moments.set(xlabel="skewness", ylabel="kurtosis", xscale="log", yscale="log", xlim=(0.2, 45))
    ticks(moments.xaxis, (0.5, 1, 2, 5, 10, 20), "{:g}")
    moments.legend(loc="upper left")
    figure.legend(*cv.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def reading_ms() -> tuple[float, float]:
    """Time of a reading, ms, with `CROWD` puffs in the air and as modelled: medians, in one run."""
    rate = CROWD / (5 * RELEASE.tau)
    worlds = [World(RELEASE, 0, name=name) for name in (f"puffs:rate={rate:g}", AS_MODELLED)]
    taken = np.empty((READINGS, 2))
    for step in range(READINGS):
        for k, world in enumerate(worlds):
            began = time.perf_counter()
            world.measure((10.0, 1.0), step)
            taken[step, k] = time.perf_counter() - began
    puffs, modelled = 1e3 * np.median(taken, axis=0)
    return float(puffs), float(modelled)


def speed() -> str:
    """Return a table of what puffs cost, in one run."""
    flights: dict[str, Flight] = {
        name: partial(side_by_side, SourceSearchVector(BATCH, particles=USUAL, world=name), BATCH)
        for name in ("puffs", AS_MODELLED)
    }
    for flight in flights.values():
        flight()
    said, (puffs_ms, modelled_ms) = speeds(flights), reading_ms()
    steps, modelled_steps = said.values()
    lines = (
        (f"a reading, {CROWD} puffs in the air, ms", 3, puffs_ms, modelled_ms, f"{LIMIT_MS:g} ms at most"),
        (f"steps a second, {BATCH} missions", 0, steps, modelled_steps, f"a ratio of {LEAST_RATIO:g}"),
    )
    return table(
        ["", "puffs", AS_MODELLED, "ratio", "wanted"],
        [[it, f"{a:,.{n}f}", f"{b:,.{n}f}", f"{a / b:.2f}", wanted] for it, n, a, b, wanted in lines],
    )


def main() -> None:
    """Follow the gas of all worlds, or measure speeds."""
    parser = cli.Parser(
        prog="python -m benchmarks.puffs",
        description="Statistics of gas in puffs, with table and picture of docs/worlds.md; or its speed.",
    )
    parser.add_argument(
        "--missions",
        type=cli.whole(2, 100_000),
        default=MISSIONS,
        metavar="N",
        help="missions of each world (default: %(default)s)",
    )
    parser.add_argument("--resume", action="store_true", help="follow only worlds that have no rows yet")
    parser.add_argument("--speed", action="store_true", help="instead, print how fast puffs are")
    parser.add_argument(
        "--results",
        type=Path,
        default=FIGURES,
        metavar="FILE.csv",
        help="file of the rows (default: %(default)s)",
    )
    parser.add_argument(
        "--page", type=Path, default=PAGE, metavar="FILE.md", help="page of the table (default: %(default)s)"
    )
    args = parser.parse_args()
    if args.speed:
        print(speed(), end="")
        return
    rows = read(args.results) if args.resume else []
    for world in WORLDS:
        if not any(row.world == world for row in rows):
            rows += rows_of(world, args.missions)
            keep(rows, args.results)
    write(read(args.results), args.page)  # as they are kept, to six digits
    print(args.page)


if __name__ == "__main__":
    cli.run(main)
