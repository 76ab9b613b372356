"""Laws of intermittent gas on exact grids: what each one's stop is worth where all but the place is known.

    python -m benchmarks.laws                                # every world; the table of docs/physics.md
    python -m benchmarks.laws --worlds puffs:share=0.05      # one world again; the others keep their rows

The belief is exact: the density of all readings at each cell of the area. A search moves by Thompson
sampling, so that no planner's own model of the gas matters. results/laws/figures.csv has a row a world and
law.
"""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.figures import nees
from benchmarks.pages import placed, table
from estimator.criterion import USUAL_THRESHOLD_M
from estimator.kernels.densities import gas_densities
from link import cli
from link.files import whole
from plume.compiled import subroutine
from plume.elementary import Array
from plume.intermittency import SMALLEST_CV, SMALLEST_MEAN, density
from plume.kernels import DERIVED, derive, derived_means, squares_of_puffs
from plume.numerics import HALF_LOG_2PI, log_gamma
from plume.parameters import FLOOR, KNOWN, MEASURED, NEUTRAL, PARAMETERS, SLOPE, X, Y
from plume.randomness import keyed
from plume.scenario import AREA_M, STEP_M, SUCCESS_RADIUS_M, Scenario, draw
from plume.sensors.names import GAUSSIAN, sensor_row
from plume.worlds.names import named
from plume.worlds.world import World

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "results" / "laws" / "figures.csv"
PAGE = ROOT / "docs" / "physics.md"
# Kind of a law, and whether its cv is that of the puffs at each place. The estimator has CLIPPED.
GAMMA, INVERSE_GAUSSIAN, CLIPPED = range(3)
LAWS = {
    "gamma, one cv": (GAMMA, False),
    "gamma, puffs": (GAMMA, True),
    "clipped inverse Gaussian, one cv": (CLIPPED, False),
    "inverse Gaussian, puffs": (INVERSE_GAUSSIAN, True),
    "clipped inverse Gaussian, puffs": (CLIPPED, True),
}
WORLDS = ("puffs:share=0.5", "puffs:share=0.2", "puffs:share=0.05", "puffs:share=0.2,rate=3", "cv-1")
PUFFS = {"rate": 10.0, "share": 0.2}  # of a world that does not say
MISSIONS, BUDGET = 60, 600
CELL_M = 0.25
ONE_CV_M = 1.0  # one cv is that of the puffs so far downwind of the source; docs/physics.md says why
HEADINGS = 8
LEAST_READINGS = 3
FORGOTTEN = 60.0  # cells that are e^60 times less likely than the best one are left out
UNKNOWN = np.array([X, Y])
SENSOR = sensor_row(GAUSSIAN)


class Search(NamedTuple):
    """How a search ended."""

    ceased: bool
    error_m: float
    nees: float
    distance_m: float
    scores: tuple[float, ...]  # by law: log-density at the true source, summed over the readings
    readings: int


class Row(NamedTuple):
    """Figures of a law in a world. Shares are from 0 to 1, and means are over the stops."""

    world: str
    law: str
    missions: int
    ceased: float
    false_stop: float
    nees_mean: float
    nees_median: float
    mtd_m: float
    score: float  # mean log-density at the true source, of the readings of all laws' searches in this world


@subroutine
def gamma_density(gas: float, mean: float, variance: float, square: float) -> float:
    """Log-density of a reading: gas of the gamma law, of this mean and squared cv, plus N(0, variance).

    In units of the noise it is ∫ exp(k u − c/θ − (t − c)²/2) du / (Γ(k) θ^k √(2π)) over u = log c, by the
    trapezoid rule. Below some c the exponent is linear in u and c, and the integral has a closed form.
    """
    std = math.sqrt(variance)
    t, mean = gas / std, max(mean / std, SMALLEST_MEAN)
    k = 1 / max(square, SMALLEST_CV * SMALLEST_CV)
    a, constant = k / mean - t, k * math.log(k / mean) - log_gamma(k) - 0.5 * t * t - HALF_LOG_2PI
    mode = 2 * k / (a + math.sqrt(a * a + 4 * k)) if a > 0 else 0.5 * (math.sqrt(a * a + 4 * k) - a)
    top, width = math.log(mode), 1 / math.sqrt(k + mode * mode)
    peak = k * top - a * mode - 0.5 * mode * mode
    high = min(top + 7.5 * width, math.log(mode + 8))
    linear, reach = math.log(min(mode, 0.02 / (abs(a) + 1))), 7.5 * width
    low = top - reach
    while low > linear and k * low - a * math.exp(low) - 0.5 * math.exp(2 * low) > peak - 28:
        reach *= 1.4
        low = top - reach
    low = max(low, linear)
    parts = int((high - low) / min(0.5 * width, 0.3)) + 1
    step, total = (high - low) / parts, 0.0
    for node in range(parts + 1):
        u = low + node * step
        c = math.exp(u)
        here = math.exp(k * u - a * c - 0.5 * c * c - peak)
        total += here * step
        if node == 0:  # half of it, and Euler and Maclaurin's correction at an end
            total += here * step * ((k - a * c - c * c) * step / 12 - 0.5)
            if low == linear:
                total += here * math.exp(a * c + 0.5 * c * c) * (1 / k - a * c / (k + 1))
    return peak + math.log(total) + constant - math.log(std)


@subroutine
def log_densities(law: int, places: Array, reading: Array, priors: Array, sensor: Array) -> Array:
    """Log-density of a reading (6,), as in `plume.kernels`, the gas last, for sources at places (2, n)."""
    count = places.shape[1]
    derived, means, squares = np.empty((DERIVED, count)), np.empty(count), np.empty(count)
    derive(places, count, UNKNOWN, priors, derived)
    derived_means(derived, count, reading, priors, means)
    squares_of_puffs(derived, count, reading, priors, sensor, squares)
    gas, slope, floor, result = reading[5], sensor[SLOPE] ** 2, sensor[FLOOR] ** 2, np.empty(count)
    if law == CLIPPED:
        gas_densities(means, means, np.ones(count), squares, count, gas, slope, floor, result)
    for i in range(count):
        mean, square = means[i], squares[i]
        if law == GAMMA:
            result[i] = gamma_density(gas, mean, slope * mean * mean + floor, square)
            continue
        if law != CLIPPED:
            steady = slope / max(slope + square, 1e-300)
            result[i] = density(
                gas, mean, slope * steady * mean * mean + floor, square * (1 + slope + steady)
            )
        result[i] = math.log(max(result[i], 1e-300))
    return result


def priors_of(scenario: Scenario, **gas: float) -> Array:
    """Return what is known of a mission, (15, 2) as `plume.kernels` takes it; `gas`: of intermittency."""
    gas = {name.replace("_", "-"): value for name, value in gas.items()}
    told = NEUTRAL | {name: getattr(scenario, name) for name in ("q", "d", "tau")} | gas
    return np.array(
        [(MEASURED if name in ("u", "phi") else KNOWN, told.get(name, 0.0)) for name in PARAMETERS]
    )


def known(world: str, scenario: Scenario) -> tuple[Array, Array]:
    """Return what is known of a mission, as of `priors_of`: with one cv, and with puffs."""
    cv = named(world).errors(0).cv
    if cv is None:
        said = PUFFS | dict(named(world).parameters)
        puffs = priors_of(scenario, puff_rate=said["rate"], puff_share=said["share"])
        derived, square, wind = np.empty((DERIVED, 1)), np.empty(1), np.array(scenario.wind)
        source = np.array(scenario.source)
        derive(source[:, None], 1, UNKNOWN, puffs, derived)
        reading = np.array([*(source - ONE_CV_M * wind / scenario.u), 0.0, *wind])
        squares_of_puffs(derived, 1, reading, puffs, SENSOR, square)
        return priors_of(scenario, cv=math.sqrt(square[0])), puffs
    return priors_of(scenario, cv=cv), priors_of(scenario, cv=cv)


def area() -> Array:
    """Return the centres of the cells of the area, (2, n) m."""
    middles = np.arange(0.5 * CELL_M, AREA_M, CELL_M)
    return np.array(np.meshgrid(middles, middles)).reshape(2, -1)


def updated(places: Array, logs: Array, densities: Array) -> tuple[Array, Array]:
    """Bayes' rule: the cells (2, n) that stay, and the logarithms of their probabilities (n,), but for a
    constant.
    """
    logs = logs + densities
    logs -= logs.max()
    stay = logs > -FORGOTTEN
    return np.ascontiguousarray(places[:, stay]), logs[stay]


def moments(places: Array, logs: Array) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Return mean and covariance (xx, xy, yy) of a belief whose probability is even within each cell."""
    weights = np.exp(logs)
    weights /= weights.sum()
    mean = (weights * places).sum(axis=1)
    x, y = places - mean[:, None]
    xx, xy, yy = (float((weights * product).sum()) for product in (x * x, x * y, y * y))
    within = CELL_M * CELL_M / 12
    return (float(mean[0]), float(mean[1])), (xx + within, xy, yy + within)


def moved(position: tuple[float, float], goal: Array) -> tuple[float, float]:
    """Return the place of a step in one of the headings, within the area, that is nearest to a goal (2,)."""
    angles = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    ends = np.array(position) + STEP_M * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends = ends[((ends >= 0) & (ends <= AREA_M)).all(axis=1)]
    x, y = ends[np.square(ends - goal).sum(axis=1).argmin()].tolist()
    return x, y


def search(world: str, law: str, seed: int) -> Search:
    """Fly one mission."""
    there = World(draw(seed), seed, name=world)
    priors = known(world, there.scenario)
    source = np.array(there.truth.source)[:, None]
    places, position, scores = area(), there.start, np.zeros(len(LAWS))
    logs = np.zeros(places.shape[1])
    for step in range(BUDGET + 1):
        gas, wind = there.measure(position, step)
        reading = np.array([*position, 0.0, *wind, gas])
        for number, (kind, of_puffs) in enumerate(LAWS.values()):
            scores[number] += log_densities(kind, source, reading, priors[of_puffs], SENSOR)[0]
        kind, of_puffs = LAWS[law]
        densities = log_densities(kind, places, reading, priors[of_puffs], SENSOR)
        places, logs = updated(places, logs, densities)
        mean, covariance = moments(places, logs)
        ceased = covariance[0] + covariance[2] < USUAL_THRESHOLD_M**2 and step + 1 >= LEAST_READINGS
        if ceased or step == BUDGET:
            break
        below = np.cumsum(np.exp(logs))
        drawn = keyed(seed, "thompson", step).random() * below[-1]
        position = moved(position, places[:, int(np.searchsorted(below, drawn))])
    error_m = math.dist(mean, there.truth.source)
    said = nees(mean, there.truth.source, covariance)
    return Search(ceased, error_m, said, step * STEP_M, tuple(scores.tolist()), step + 1)


def laws(world: str) -> list[str]:
    """The laws that are flown in a world: without puffs, those with one cv."""
    return [law for law, (_, of_puffs) in LAWS.items() if not of_puffs or named(world).errors(0).cv is None]


def rows_of(world: str, searches: Mapping[str, Sequence[Search]]) -> list[Row]:
    """Return the figures of the searches in a world, by law."""
    everyone = [it for of in searches.values() for it in of]
    scores = np.sum([it.scores for it in everyone], axis=0) / sum(it.readings for it in everyone)
    rows = []
    for law, of in searches.items():
        stops = [(float(it.error_m > SUCCESS_RADIUS_M), it.nees, it.distance_m) for it in of if it.ceased]
        false, said, mtd_m = np.array(stops or [(math.nan,) * 3]).T
        figures = [len(stops) / len(of), false.mean(), said.mean(), np.median(said), mtd_m.mean()]
        figures.append(scores[[*LAWS].index(law)])
        rows.append(Row(world, law, len(of), *map(float, figures)))
    return rows


def read(path: Path) -> list[Row]:
    """Read the rows that are there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        _, *lines = csv.reader(file)
    return [Row(world, law, int(missions), *map(float, more)) for world, law, missions, *more in lines]


def keep(rows: Iterable[Row], path: Path) -> None:
    """Write the rows, to six digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial_file, partial_file.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        for world, law, missions, *more in rows:
            writer.writerow([world, law, missions, *(f"{value:.6g}" for value in more)])


def page(text: str, rows: Iterable[Row]) -> str:
    """Return the page with its table made anew. Raises ValueError if it has no place for it."""
    heads = ["world", "law", "false, %", "ceased, %", "NEES: mean (median)", "MTD, m", "log score"]
    lines = [
        [
            f"`{row.world}`",
            row.law,
            f"{100 * row.false_stop:.1f}",
            f"{100 * row.ceased:.1f}",
            f"{row.nees_mean:.1f} ({row.nees_median:.1f})",
            f"{row.mtd_m:.1f}",
            f"{row.score:.3f}",
        ]
        for row in rows
    ]
    return placed(text, "laws", table(heads, lines))


def main() -> None:
    """Fly the searches and write the table."""
    parser = cli.Parser(prog="python -m benchmarks.laws", description="The table of laws of docs/physics.md.")
    parser.add_argument(
        "--worlds", nargs="+", choices=WORLDS, default=WORLDS, metavar="WORLD", help=", ".join(WORLDS)
    )
    parser.add_argument(
        "--missions", type=cli.whole(1, 100_000), default=MISSIONS, metavar="N", help="(default: %(default)s)"
    )
    parser.add_argument("--workers", type=cli.whole(1, 64), default=2, metavar="W", help="(default: 2)")
    args = parser.parse_args()
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions)
    with get_context("spawn").Pool(args.workers) as pool:
        for world in args.worlds:
            searches = {law: pool.map(partial(search, world, law), seeds, 5) for law in laws(world)}
            new = rows_of(world, searches)
            print(*new, sep="\n", flush=True)
            others = [row for row in read(FIGURES) if row.world != world]
            rows = sorted([*others, *new], key=lambda row: WORLDS.index(row.world))
            text = page(PAGE.read_text(), rows)
            keep(rows, FIGURES)
            with whole(PAGE) as partial_file:
                partial_file.write_text(text)
    print(PAGE)


if __name__ == "__main__":
    cli.run(main)
