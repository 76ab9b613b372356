"""Whether findings are honest: their 95% regions and intervals over many missions, and what is not seen.

    python -m benchmarks.findings                   # 1,000 missions in each world: hours on two cores
    python -m benchmarks.findings --missions 100 --world wind-30
    python -m benchmarks.findings --missing         # only the smallest rates of flights that found nothing

Missions are flown in-process with `homing`, `field` and at most 600 steps, from the test seeds. At the stop
the region and the interval are those of the findings: ellipse, contour of the particles, and the rate's
quantiles. The rate counts relative to the diffusivity, which is told, and to the sensor's gain, which no
reading tells from it: the true one is q · gain · d as told / d. Rows are in results/findings/, a row a
mission; both tables of docs/findings.md are made from them.

The second table is of flights along which there is no gas. At places of the area a source has the smallest
rate that the findings name there. Its readings along the flown track are drawn by other code than the
findings': physics and sensor of `plume`, gamma-distributed gas as of the worlds, and wind, lifetime, noise
and intermittency drawn from the flight's last belief. It counts how often the likelihood sees it, as the
findings promise, and how often the estimator itself, told that rate, finds that a plume is needed.
"""

import csv
import math
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from agent.planning.moves import Reach
from agent.policies import choose
from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.figures import wilson
from agent.trials.rollout import mission
from benchmarks.pages import placed, table
from benchmarks.trust import WITH
from estimator.belief import CLEAR, belief, evidence
from estimator.filter import Config, assimilate, prior
from ground.findings.assumed import SPIKES
from ground.findings.flight import Flight, FlownReading
from ground.findings.region import CHI2_95, contour_95, places_of, scale_of
from ground.findings.unseen import FLIGHTS, Supposed, smallest_rate
from link import cli
from link.bus.mavlink import Reading
from link.files import whole
from plume.dispersion import concentration
from plume.elementary import Array
from plume.outcome import rate_interval
from plume.problem import ALTITUDE_M
from plume.randomness import derived_seed
from plume.scenario import AREA_M, draw
from plume.sensors.names import GAUSSIAN, parse
from plume.worlds.names import named

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results" / "findings"
PAGE = ROOT / "docs" / "findings.md"
POLICY, PARTICLES, BUDGET, THRESHOLD_M = "homing", 1000, 600, 0.5
WORLDS = (
    *("as-modelled", "wind-30", "rate-doubled", "d-halved", "cv-1", "all-at-once"),
    *("puffs:share=0.2 with 2 s of dwell", "puffs:share=0.2"),
)
NOWHERE_STEPS = 60  # moves of a flight that finds nothing
PLACES, JUDGED = 10, 2  # of sources in each such flight; draws at each that the estimator judges, too
DRAWS = 50  # at each place


class Covered(msgspec.Struct, frozen=True):
    """One mission: whether its findings hold the truth."""

    world: str
    seed: int
    ceased: bool
    ellipse: bool
    contour: bool | None  # None: the belief has none
    rate: bool
    error_m: float
    nees: float
    rate_ratio: float  # mean rate of the belief by the true one


class Unseen(msgspec.Struct, frozen=True):
    """One source of the smallest rate at a place of a flight that found nothing."""

    seed: int
    x: float
    y: float
    rate: float
    draws: int
    seen: int  # by the likelihood
    judged: int
    needed: int  # times that the estimator's own evidence says that a plume is needed


Row = TypeVar("Row", Covered, Unseen)


class Cell(NamedTuple):
    """A mission to fly."""

    world: str
    seed: int


def cover(cell: Cell) -> Covered:
    """Fly a mission and compare its findings with the truth."""
    world, sensor = WITH.get(cell.world, (cell.world, "gaussian"))
    flown = mission(
        *(cell.seed, POLICY, PARTICLES, THRESHOLD_M, BUDGET),
        world=world,
        assume="field",
        sensor=parse(sensor),
    )
    for step in flown.steps:
        said, particles = step.belief, step.particles
    source = flown.scenario.nearest(said.mean)
    (xx, xy, yy), (dx, dy) = said.covariance, (source[0] - said.mean[0], source[1] - said.mean[1])
    nees = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    scale = scale_of(said)
    contour = contour_95(*places_of(particles, said.unknowns, said.mean), scale)
    gain = named(world).errors(cell.seed).gain
    rate = flown.scenario.q * gain * said.diffusivity / flown.scenario.d
    low, high = rate_interval(said.unknowns, particles, said.intermittency) or (said.rate, said.rate)
    return Covered(
        cell.world,
        cell.seed,
        said.ceased,
        nees <= CHI2_95 * scale * scale,
        None if contour is None else contour.contains(source),
        low <= rate <= high,
        math.dist(source, said.mean),
        nees,
        said.rate / rate,
    )


# ---- what is not seen ----


def miss(seed: int) -> list[Unseen]:
    """Fly where there is no gas, and see whether sources of the smallest rates would have been seen."""
    flight = flown_in_clean_air(seed)
    rng = np.random.default_rng([seed, 1])
    supposed = Supposed(flight, GAUSSIAN, SPIKES["field"], FLIGHTS, 1)
    found: list[Unseen] = []
    while len(found) < PLACES:
        x, y = rng.uniform(0.0, AREA_M, 2).tolist()
        place = x, y
        rate = smallest_rate(supposed, place)
        if not math.isfinite(rate):
            continue
        # Other draws than those that gave the rate.
        again = Supposed(flight, GAUSSIAN, SPIKES["field"], DRAWS, 1, seed=seed + 1)
        readings = drawn(again, place, rate, rng)
        seen = int((again.at(place).advantages(readings, rate) >= CLEAR).sum())
        needed = sum(needs_a_plume(flight, readings[:, k], rate, seed) for k in range(JUDGED))
        found.append(Unseen(seed, x, y, rate, DRAWS, seen, JUDGED, needed))
    return found


def flown_in_clean_air(seed: int) -> Flight:
    """Fly a search whose source releases nothing, as its findings see it."""
    told, rng = draw(seed), np.random.default_rng([seed, 0])
    config = Config(
        PARTICLES, THRESHOLD_M, derived_seed(seed, "estimator"), told.q, told.d, told.tau, assume="field"
    )
    posterior, place, samples = prior(config), told.start, []
    for step in range(NOWHERE_STEPS + 1):
        gas = float(np.float32(GAUSSIAN.environment_noise * rng.standard_normal()))
        reading = Reading(step, place, ALTITUDE_M, told.wind, gas)
        posterior = assimilate(posterior, reading, config)
        said, particles = belief(posterior, reading, config)
        samples.append(FlownReading(step, 0, float(step), place, ALTITUDE_M, gas, told.wind, said.spread))
        place = choose(POLICY, said, particles, derived_seed(seed, "agent"), Reach())
    return Flight(
        path=Path("clean air"),
        sha256="",
        about={},
        home=None,
        home_by="nobody",
        samples=samples,
        last=said,
        particles=particles,
        tracks={1: np.empty((0, 2), np.float32)},
        walls=(),
        fence=(),
        warnings=[],
        estimator_warned=[],
        remark="",
        is_damaged=False,
    )


def drawn(supposed: Supposed, place: tuple[float, float], rate: float, rng: np.random.Generator) -> Array:
    """Draw readings (T, K) of a source by the physics of `plume` and gas as of the worlds."""
    of, (count, draws) = supposed.of, supposed.winds.shape[:2]
    result = np.empty((count, draws))
    squares = supposed.at(place).squares
    for k in range(draws):
        mean = concentration(
            supposed.places[:, :2],
            place,
            supposed.winds[:, k],
            rate=rate * of["gain"][k],
            diffusivity=of["d"][k],
            lifetime=of["tau"][k],
        )
        square = np.maximum(squares[:, k], 1e-9)
        gas = mean * rng.gamma(1 / square) * square
        result[:, k] = gas + of["noise"][k] * GAUSSIAN.noise_std(gas) * rng.standard_normal(count)
    return result


def needs_a_plume(flight: Flight, readings: Array, rate: float, seed: int) -> bool:
    """Whether the estimator, told this rate, would have needed a plume to explain readings (T,)."""
    last = flight.last
    config = Config(PARTICLES, THRESHOLD_M, seed, rate, last.diffusivity, draw(seed).tau, assume="field")
    posterior = prior(config)
    for sample, gas in zip(flight.samples, readings.tolist(), strict=True):
        reading = Reading(sample.step, sample.place, ALTITUDE_M, sample.wind, float(np.float32(gas)))
        posterior = assimilate(posterior, reading, config)
    return evidence(posterior, config) >= CLEAR


# ---- tables ----


def coverage(rows: Sequence[Covered]) -> str:
    """Return the table of regions and intervals: a row for each world."""
    lines = []
    for world in dict.fromkeys(row.world for row in rows):
        of = [row for row in rows if row.world == world]
        stops = [row for row in of if row.ceased]
        contours = [row.contour for row in stops if row.contour is not None]
        lines.append(
            [
                world,
                f"{len(of):,}",
                f"{100 * len(stops) / len(of):.1f}",
                wilson(sum(row.ellipse for row in stops), len(stops)).text(100.0, 1),
                wilson(sum(contours), len(contours)).text(100.0, 1),
                wilson(sum(row.rate for row in stops), len(stops)).text(100.0, 1),
                f"{np.mean([row.nees for row in stops]):.2f}" if stops else "–",
                f"{np.median([row.rate_ratio for row in stops]):.2f}" if stops else "–",
            ]
        )
    heads = [
        *("world", "missions", "ceased, %", "ellipse, %", "contour, %"),
        *("rate's interval, %", "NEES", "rate by truth (median)"),
    ]
    return table(heads, lines)


def visibility(rows: Sequence[Unseen]) -> str:
    """Return the table of the smallest rates."""
    lines = []
    for what, seen, of in (
        ("the likelihood, as the findings say", sum(r.seen for r in rows), sum(r.draws for r in rows)),
        ("the estimator, told this rate", sum(r.needed for r in rows), sum(r.judged for r in rows)),
    ):
        lines.append(
            [
                what,
                f"{len({r.seed for r in rows})}",
                f"{len(rows):,}",
                f"{of:,}",
                wilson(seen, of).text(100.0, 1),
            ]
        )
    return table(["seen by", "flights", "places", "sources", "seen, %"], lines)


def read_rows(path: Path, kind: type[Row]) -> list[Row]:
    """Read rows of a kind; none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [msgspec.convert(_typed(row), kind, strict=False) for row in csv.DictReader(file)]


def _typed(row: dict[str, str]) -> dict[str, object]:
    return {name: None if value == "" else value for name, value in row.items()}


def write_rows(path: Path, rows: Sequence[msgspec.Struct]) -> None:
    """Write rows, one a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial_file, partial_file.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].__struct_fields__, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {
                    name: f"{value:.6g}" if isinstance(value, float) else value
                    for name, value in msgspec.structs.asdict(row).items()
                }
            )


def main() -> None:
    """Fly, write the rows and make the tables."""
    parser = cli.Parser(prog="python -m benchmarks.findings", description="The tables of docs/findings.md.")
    parser.add_argument(
        "--missions", type=cli.whole(1, 1_000_000), default=1000, metavar="N", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--world",
        type=cli.listed(cli.checked(lambda text: named(WITH.get(text, (text, ""))[0]))),
        default=list(WORLDS),
        metavar="NAME,NAME",
        help=f"(default: {', '.join(WORLDS)})",
    )
    parser.add_argument("--missing", action="store_true", help="only the flights that find nothing")
    parser.add_argument(
        "--flights",
        type=cli.whole(1, 100_000),
        default=30,
        metavar="N",
        help="that find nothing (default: 30)",
    )
    parser.add_argument("--workers", type=cli.whole(1, 64), default=2, metavar="W", help="(default: 2)")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="(default: %(default)s)")
    parser.add_argument("--page", type=Path, default=PAGE, metavar="FILE.md", help="(default: %(default)s)")
    args = parser.parse_args()
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions)
    covered, unseen = args.results / "missions.csv", args.results / "unseen.csv"
    with get_context("spawn").Pool(args.workers) as pool:
        for world in [] if args.missing else args.world:
            flown = pool.map(cover, [Cell(world, seed) for seed in seeds], chunksize=5)
            old: list[Covered] = read_rows(covered, Covered)
            rows = [row for row in old if row.world != world] + flown
            rows.sort(key=lambda row: _rank(row.world))
            write_rows(covered, rows)
            print(world, flush=True)
        if args.missing or args.world == list(WORLDS):
            missed = pool.map(miss, range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.flights), chunksize=1)
            write_rows(unseen, [row for rows in missed for row in rows])
    text = args.page.read_text()
    if missions := read_rows(covered, Covered):
        text = placed(text, "coverage", coverage(missions))
    if sources := read_rows(unseen, Unseen):
        text = placed(text, "unseen", visibility(sources))
    with whole(args.page) as partial_file:
        partial_file.write_text(text)


def _rank(world: str) -> int:
    return WORLDS.index(world) if world in WORLDS else len(WORLDS)


if __name__ == "__main__":
    main()
