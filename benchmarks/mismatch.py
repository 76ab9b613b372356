"""Robustness to model mismatch: every policy in worlds that differ from the estimator's model. Writes docs/mismatch.md.

    python -m benchmarks.mismatch                                       # every world and policy, on all cores
    python -m benchmarks.mismatch --only wind-30 --policy homing,ppo    # these cells again; all other results stay
    python -m benchmarks.mismatch --resume                              # the missing cells only; if none is missing, only the page

Scenarios are the test seeds (1,000,000 and up). results/mismatch/WORLD.csv.gz holds one row per mission. Each world has its own file,
because rows do not name their world, and the files have their own folder, because `plumeward report` takes all rows of a folder to be
from one world. The rows of a policy are written when all its missions in that world are complete.
"""

import math
import os
import sys
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from agent.policies import bundle_path, choose, policy, reach
from agent.trials.evaluate import FIRST_TEST_SEED, read_csv, write_csv
from agent.trials.figures import COLUMNS, UNKNOWN, MissionRow, cell, figures
from agent.trials.files import whole
from agent.trials.rollout import ALTITUDE_M, Step
from agent.trials.workers import WorkerLost, as_flown
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link import cli
from link.bus.mavlink import Reading
from plume import __version__
from plume.outcome import TracePoint, outcome
from plume.randomness import derived_seed, keyed
from plume.scenario import AREA_M, BUDGET_STEPS, SOURCE_HIGH_M, SOURCE_LOW_M, SUCCESS_RADIUS_M, Scenario, draw
from plume.sensor import GAUSSIAN, Gaussian
from plume.world import World, float32

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results" / "mismatch"
PAGE = ROOT / "docs" / "mismatch.md"
PARTICLES = 1000
THRESHOLD_M = 0.5
POLICIES = (
    "infotaxis", "entrotaxis", "dcee", "space-aware-infotaxis", "homing", "greedy", "thompson", "random", "ppo", "dqn", "ddpg",
)  # fmt: skip


@dataclass(frozen=True)
class Mismatch:
    """A world, described by how it differs from the estimator's model: a row of each table."""

    words: str
    lifetime_factor: float = 1.0
    """Factor on τ; the estimator assumes Table 1's τ."""
    wind_error_deg: float = 0.0
    """Constant error of the measured wind direction, to the left or to the right with equal probability; the speed is right."""
    noise_factor: float = 1.0
    """Factor on α and β; the estimator assumes the paper's values."""
    lost_share: float = 0.0
    """Share of readings, never the first, that do not reach the estimator."""
    source_outside: bool = False
    """The source lies outside Table 1's square. The estimator's prior covers the whole area, so this tests the policies only."""

    @property
    def sensor(self) -> Gaussian:
        """The sensor model that readings are drawn from."""
        return Gaussian(self.noise_factor * GAUSSIAN.sensor_noise, self.noise_factor * GAUSSIAN.environment_noise)

    def scenario(self, seed: int) -> Scenario:
        """Return the true scenario of a mission: the seed's, with this world's changes."""
        usual = draw(seed)
        source = outside(seed) if self.source_outside else usual.source
        return replace(usual, source=source, tau=self.lifetime_factor * usual.tau)

    def measured_wind(self, seed: int) -> tuple[float, float]:
        """Return the measured wind of a mission, a float32 pair (x east, y north), m/s, pointing to where it comes from."""
        true = self.scenario(seed)
        side = 1.0 if keyed(seed, "wind error").random() < 0.5 else -1.0
        x, y = replace(true, phi=true.phi + side * math.radians(self.wind_error_deg)).wind
        return float32(x), float32(y)

    def loses(self, seed: int, step: int) -> bool:
        """True if reading number `step` of a mission is lost."""
        return step > 0 and bool(keyed(seed, "lost reading", step).random() < self.lost_share)


WORLDS = {
    "as-modelled": Mismatch("as modelled"),
    "tau-halved": Mismatch("τ halved, 5 s", lifetime_factor=0.5),
    "tau-doubled": Mismatch("τ doubled, 20 s", lifetime_factor=2.0),
    "wind-10": Mismatch("wind direction 10° wrong", wind_error_deg=10.0),
    "wind-30": Mismatch("wind direction 30° wrong", wind_error_deg=30.0),
    "noise-doubled": Mismatch("noise doubled", noise_factor=2.0),
    "readings-lost": Mismatch("20% of readings lost", lost_share=0.2),
    "source-outside": Mismatch("source outside U(10, 25)²", source_outside=True),
}
"""The worlds, by their names in --only."""


def outside(seed: int) -> tuple[float, float]:
    """Draw a source uniformly from the area outside Table 1's square, (x, y) m."""
    rng = keyed(seed, "source outside")
    while True:
        x, y = rng.uniform(0.0, AREA_M, 2).tolist()
        if not (SOURCE_LOW_M <= x <= SOURCE_HIGH_M and SOURCE_LOW_M <= y <= SOURCE_HIGH_M):
            return x, y


def steps(mismatch: Mismatch, name: str, seed: int, particles: int = PARTICLES, budget: int = BUDGET_STEPS) -> Iterator[Step]:
    """Fly a mission of a policy as `agent.trials.rollout` does, in a world that may differ from the estimator's model.

    After a lost reading the policy gets the previous belief with the current position and step: the vehicle knows both without the
    estimator, and the step keys the randomness of the decision.
    """
    known = draw(seed)
    config = Config(particles, THRESHOLD_M, derived_seed(seed, "estimator"), known.q, known.d, known.tau)
    world, wind = World(mismatch.scenario(seed), seed, mismatch.sensor), mismatch.measured_wind(seed)
    agent_seed, within = derived_seed(seed, "agent"), reach(name)
    posterior, position, decision_s = prior(config), world.start, 0.0
    for step in range(budget + 1):
        update_s = 0.0
        if not mismatch.loses(seed, step):
            reading = Reading(step, position, ALTITUDE_M, wind, world.gas(position, step))
            began = time.perf_counter()
            posterior = assimilate(posterior, reading, config)
            said, cloud = belief(posterior, reading, config)
            update_s = time.perf_counter() - began
        said = replace(said, position=position, step=step)
        yield Step(said, cloud, update_s, decision_s)
        if said.ceased or step == budget:
            return
        began = time.perf_counter()
        position = choose(name, said, cloud, agent_seed, within)
        decision_s = time.perf_counter() - began


def fly(world: str, name: str, seed: int, particles: int = PARTICLES, budget: int = BUDGET_STEPS) -> MissionRow:
    """Fly a mission of a policy in a world; returns its row."""
    mismatch, within, learned = WORLDS[world], reach(name), bundle_path(name) is not None
    flown = list(steps(mismatch, name, seed, particles, budget))
    last = flown[-1].belief
    trace = [TracePoint(step.belief.position, step.belief.gas, step.belief.mean, step.belief.spread) for step in flown]
    updates_s, decisions_s = [step.update_s for step in flown if step.update_s], [step.decision_s for step in flown[1:]]
    search_time_s = sum(updates_s) + sum(decisions_s)
    result = outcome(seed, name, mismatch.scenario(seed), trace, last.ceased, search_time_s, last.assume, last.stop)
    error = np.subtract(result.estimate, result.source)
    xx, xy, yy = last.covariance
    return MissionRow(
        policy=name,
        particles=particles,
        threshold_m=THRESHOLD_M,
        seed=seed,
        budget=budget,
        headings=None if learned else within.headings,
        step_m=within.step,
        measurements=None if learned else within.measurements,
        ceased=result.ceased,
        located=result.located,
        estimate_x=result.estimate[0],
        estimate_y=result.estimate[1],
        source_x=result.source[0],
        source_y=result.source[1],
        error_m=result.error_m,
        spread_m=result.spread_m,
        nees=float(error @ np.linalg.pinv([[xx, xy], [xy, yy]]) @ error),
        steps=result.steps,
        distance_m=result.distance_m,
        floor_m=None,
        search_time_s=result.search_time_s,
        decision_ms=1e3 * float(np.mean(decisions_s)) if decisions_s else 0.0,
        update_ms=1e3 * float(np.mean(updates_s)),
        version=__version__,
    )


Cell = tuple[str, str]
"""(world, policy)."""


def fly_all(cells: Sequence[Cell], seeds: Sequence[int], progress: Progress) -> Generator[tuple[Cell, list[MissionRow]], None, None]:
    """Fly the missions of all seeds in each cell, on all cores; yields the rows of each cell when it is complete."""
    bar = progress.add_task("missions", total=len(cells) * len(seeds))
    tasks = ((cell, seed) for cell in cells for seed in seeds)
    rows: dict[Cell, list[MissionRow]] = {}
    with closing(as_flown(_fly, tasks, os.cpu_count() or 1)) as results:
        for (cell, _), row in results:
            rows.setdefault(cell, []).append(row)
            progress.update(bar, advance=1, description=", ".join(cell))
            if len(rows[cell]) == len(seeds):
                yield cell, sorted(rows.pop(cell), key=lambda it: it.seed)


def _fly(task: tuple[Cell, int]) -> MissionRow:
    return fly(*task[0], task[1])


def read(results: Path) -> dict[Cell, list[MissionRow]]:
    """Read all rows that were written, by (world, policy)."""
    rows: dict[Cell, list[MissionRow]] = {}
    for world in WORLDS:
        for row in _read(results, world):
            rows.setdefault((world, row.policy), []).append(row)
    return rows


def keep(results: Path, world: str, name: str, rows: Sequence[MissionRow]) -> None:
    """Write the rows of a policy in a world; they replace its earlier rows, and those of other policies stay."""
    results.mkdir(parents=True, exist_ok=True)
    write_csv([*(row for row in _read(results, world) if row.policy != name), *rows], _path(results, world))


def _read(results: Path, world: str) -> list[MissionRow]:
    path = _path(results, world)
    return read_csv(path) if path.exists() else []


def _path(results: Path, world: str) -> Path:
    return results / f"{world}.csv.gz"


SHOWN = ("ceased", "located", "false_stop", "mtd_m")
"""Figures in the tables of the policies."""

HEAD = f"""# Robustness to model mismatch

Made by `python -m benchmarks.mismatch`. Each policy flies in worlds that differ from the estimator's model. The estimator does not know
of the difference.

- *as modelled*: the world equals the estimator's model. A mission is identical to that of `plumeward rollout`, bit for bit.
- *τ halved*, *τ doubled*: the lifetime of the gas is 5 s or 20 s; the estimator assumes 10 s.
- *wind direction 10° wrong*, *30° wrong*: the measured wind direction differs by this angle from the wind that carries the gas. The seed
  chooses left or right. The measured speed is right.
- *noise doubled*: readings are drawn with α = 0.6 and β = 0.4 g/m³; the estimator assumes 0.3 and 0.2 g/m³.
- *20% of readings lost*: every reading but the first is lost with this probability, drawn by (seed, step). The filter never receives it.
  The vehicle flies on, and the policy decides from the previous belief and the current position.
- *source outside U(10, 25)²*: the source is drawn uniformly from the rest of the area. The estimator's model still holds, because its
  prior is uniform over the whole area. Policies trained or tuned on Table 1 have never met such sources. Their distances from the start
  differ from those of the other rows: compare MTD within this row only.

The scenarios are the test seeds from {FIRST_TEST_SEED:,} on, the same in all worlds. N = {PARTICLES:,}, ζ = {THRESHOLD_M} m, at most
{BUDGET_STEPS} steps. *ceased*: AGDC declared a stop within the step budget. *located*: ceased, and the estimate is within
{SUCCESS_RADIUS_M:g} m of the source. *false stop*: ceased but not located, as a share of ceased. *MTD*: mean distance travelled over
ceased missions. Brackets hold 95% intervals: Wilson for shares, bootstrap for MTD. A dash (–) means not flown, or no mission ceased. The
first table covers the same missions as the tables of the policies. `results/mismatch/` holds one row per mission.
"""

CONCLUSIONS = """\
- A wrong gas lifetime (half or double), a wind direction 10° wrong, or 20% of the readings lost: each costs a policy up to about six
  percentage points of located. Learned policies lose no more than planners and remain the fastest.
- A wind direction 30° wrong or doubled noise causes false stops under every policy. For `infotaxis`, `homing`, `greedy` and the learned
  policies, 15 to 33% of stops are false with the wrong wind and 14 to 22% with doubled noise. The estimator trusts the wrong model, and
  the misfit of the readings shows too late or not at all. No policy can correct this. It takes an estimator with a prior over the wind
  error or the noise.
- The learned policies were not trained on sources outside Table 1's square: `ppo` locates 90% of them, `ddpg` 89% and `dqn` 81%;
  `infotaxis`, `homing` and `space-aware-infotaxis` locate at least 97%. Their false stops remain rare, but they do not reach the source
  within the budget. To search outside the middle of the area, use `homing` or train a new policy."""
"""Conclusions from the tables, written by hand; kept here so that making the page again does not lose them."""


def page(rows: dict[Cell, list[MissionRow]]) -> str:
    """Return the page made from all rows."""
    said = {flown: figures(of) for flown, of in rows.items()}
    flown = {name for _, name in said}
    names = [name for name in POLICIES if name in flown] + sorted(flown.difference(POLICIES))

    def figure(world: str, name: str, key: str) -> str:
        return cell(said[world, name], key) if (world, name) in said else UNKNOWN

    parts = [HEAD, f"## Results\n\n{CONCLUSIONS}\n", "## Sources located (%) in each world\n"]
    located = ([it.words, *(figure(world, name, "located") for name in names)] for world, it in WORLDS.items())
    parts.append(_table(["world", *names], located))
    for name in names:
        lines = (
            [it.words, f"{len(rows.get((world, name), [])):,}", *(figure(world, name, key) for key in SHOWN)]
            for world, it in WORLDS.items()
        )
        parts += [f"## {name}\n", _table(["world", "missions", *(COLUMNS[key][0] for key in SHOWN)], lines)]
    return "\n".join(parts)


def _table(heads: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    return "".join(f"| {' | '.join(line)} |\n" for line in (heads, ["---"] * len(heads), *lines))


def _is_world(text: str) -> None:
    if text not in WORLDS:
        raise ValueError(f"{text!r} is not allowed; wanted one or several of {', '.join(WORLDS)}, separated by commas")


def main() -> int:
    """Fly the chosen cells, write their rows, and write the page from all rows."""
    parser = cli.Parser(prog="python -m benchmarks.mismatch", description="Fly policies in worlds that differ from the estimator's model.")
    parser.add_argument(
        "--only", type=cli.listed(cli.checked(_is_world)), default=list(WORLDS), metavar="WORLD,WORLD",
        help=f"worlds: {', '.join(WORLDS)} (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--policy",
        type=cli.listed(cli.checked(policy)),
        default=",".join(POLICIES),
        metavar="NAME,NAME",
        help="policies (default: %(default)s)",
    )
    parser.add_argument(
        "--missions", type=cli.whole(1, 1_000_000), default=1000, metavar="N", help="missions in each cell (default: %(default)s)"
    )
    parser.add_argument("--resume", action="store_true", help="fly only the cells that do not have all missions yet")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="folder of the rows (default: %(default)s)")
    parser.add_argument("--page", type=Path, default=PAGE, metavar="FILE.md", help="page to write (default: %(default)s)")
    args = parser.parse_args()
    seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions)
    there = read(args.results) if args.resume else {}
    cells = [it for it in product(args.only, args.policy) if not {row.seed for row in there.get(it, [])}.issuperset(seeds)]
    kept = 0
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"))
    try:
        with (
            Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress,
            closing(fly_all(cells, seeds, progress)) as flown,
        ):
            for (world, name), rows in flown:
                keep(args.results, world, name, rows)
                kept += 1
                said = figures(rows)
                line = f"{world}, {name}: " + "; ".join(f"{COLUMNS[key][0]} {cell(said, key)}" for key in SHOWN)
                progress.console.print(line, markup=False, soft_wrap=True)
    except WorkerLost as error:
        print(f"error: {error}", file=sys.stderr)
        return cli.FAILED
    finally:
        if kept < len(cells):
            print(f"{kept} of {len(cells)} cells were flown; run the command again with --resume to fly the others", file=sys.stderr)
        with whole(args.page) as partial:
            partial.write_text(page(read(args.results)))
    print(args.page)
    return 0


if __name__ == "__main__":
    cli.run(main)
