"""Sweeps: missions of policies over seeds, particles and thresholds, on all cores. A journal keeps each flight, so a sweep can resume."""

import hashlib
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import astuple, dataclass, field
from functools import cache, partial
from itertools import groupby, product
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numba
import numpy as np

from agent.policies import bundle_path, reach
from agent.trials.figures import MissionRow
from agent.trials.floor import LEAST_THRESHOLD_M, floors_m
from agent.trials.rollout import Mission, mission
from agent.trials.workers import as_flown
from estimator.belief import may_claim, sure_enough
from estimator.filter import Config
from estimator.priors import KINDS
from link.bus.messages import Belief
from plume import __version__
from plume.scenario import BUDGET_STEPS, STEP_M, SUCCESS_RADIUS_M
from plume.sensor import GAUSSIAN, text
from plume.worlds import AS_MODELLED

PACKAGES = ("plume", "link", "estimator", "agent")


@dataclass(frozen=True)
class Sweep:
    """Which missions to fly, and how."""

    policies: Sequence[str]
    seeds: range
    particles: Sequence[int] = (1000,)
    thresholds_m: Sequence[float] = (0.5,)
    budget: int = BUDGET_STEPS
    moves: dict[str, float] = field(default_factory=dict)
    """Fields of `Reach` that replace the planner's own."""
    knowledge: dict[str, Any] = field(default_factory=dict)
    """Other fields of `Config`. With `within` there is one stop, whatever the one threshold."""
    worlds: Sequence[str] = (AS_MODELLED,)

    @property
    def flights(self) -> Iterator["Flight"]:
        """All flights, seed by seed. One flight serves all thresholds."""
        return (
            (policy, particles, seed, world)
            for seed in self.seeds
            for policy in self.policies
            for particles in self.particles
            for world in self.worlds
        )

    @property
    def count(self) -> int:
        """Number of flights."""
        return len(self.seeds) * len(self.policies) * len(self.particles) * len(self.worlds)

    def __contains__(self, flight: "Flight") -> bool:
        """Whether the sweep includes a flight."""
        policy, particles, seed, world = flight
        return policy in self.policies and particles in self.particles and seed in self.seeds and world in self.worlds


Flight = tuple[str, int, int, str]
"""(policy, particles, seed, world)."""
Rows = Annotated[list[MissionRow], msgspec.Meta(min_length=1)]
"""The rows of a flight, one per ζ."""
Flyer = Callable[[Sweep, Iterable[Sequence[Flight]]], Generator[list[MissionRow], None, None]]
"""(sweep, flights by seed) -> the rows of each flight, in any order."""


def fly(sweep: Sweep, flights: Sequence[Flight]) -> list[list[MissionRow]]:
    """Fly missions of one seed until their spread is below the smallest ζ; returns their rows, one per ζ, each as of the stop at this ζ."""
    missions = [
        mission(seed, policy, particles, min(sweep.thresholds_m), sweep.budget, sweep.moves, world=world, **sweep.knowledge)
        for policy, particles, seed, world in flights
    ]
    modelled = [ready for flight, ready in zip(flights, missions, strict=True) if flight[3] == AS_MODELLED]
    floors = _floors(sweep, modelled[0]) if modelled else {}
    return [_fly(sweep, flight, ready, floors if flight[3] == AS_MODELLED else {}) for flight, ready in zip(flights, missions, strict=True)]


def _floors(sweep: Sweep, ready: Mission) -> dict[float, float]:
    """The information floor of a mission at each ζ, m, where docs/floor.md defines it."""
    config = ready.config
    if config.sensor != GAUSSIAN or config.effective_priors or config.stop_limits or config.within:
        return {}
    if sweep.moves.get("step", STEP_M) != STEP_M:
        return {}
    floors = floors_m(ready.scenario, [threshold_m for threshold_m in sweep.thresholds_m if threshold_m >= LEAST_THRESHOLD_M])
    return {threshold_m: floor_m for threshold_m, floor_m in floors.items() if math.isfinite(floor_m)}


def _fly(sweep: Sweep, flight: Flight, ready: Mission, floors: dict[float, float]) -> list[MissionRow]:
    scenario, config, steps = ready
    waiting = sorted(sweep.thresholds_m, reverse=True)
    rows: dict[float, MissionRow] = {}
    updates_s: list[float] = []
    decisions_s: list[float] = []
    distance_m = 0.0
    position = scenario.start

    def row(threshold_m: float, ceased: bool) -> MissionRow:
        floor_m = floors.get(threshold_m)
        return _row(sweep, flight, config, threshold_m, ceased, said, scenario.source, distance_m, floor_m, updates_s, decisions_s)

    for said, _, update_s, decision_s in steps:
        updates_s.append(update_s)
        if said.step:
            decisions_s.append(decision_s)
            distance_m += math.dist(position, said.position)
        position = said.position
        while waiting and _ceased(said, config, waiting[0]):
            threshold_m = waiting.pop(0)
            rows[threshold_m] = row(threshold_m, True)
    rows |= {threshold_m: row(threshold_m, False) for threshold_m in waiting}
    return [rows[threshold_m] for threshold_m in sweep.thresholds_m]


def _ceased(said: Belief, config: Config, threshold_m: float) -> bool:
    if config.within:
        return said.ceased
    stds = dict(zip(said.unknowns, said.stds, strict=True))
    return may_claim(said.p_value, said.evidence, said.step + 1) and sure_enough(said.spread, math.nan, stds, config, threshold_m)


def _row(
    sweep: Sweep, flight: Flight, config: Config, threshold_m: float, ceased: bool, last: Belief, source: tuple[float, float],
    distance_m: float, floor_m: float | None, updates_s: Sequence[float], decisions_s: Sequence[float],
) -> MissionRow:  # fmt: skip
    policy, particles, seed, world = flight
    moves, learned = reach(policy, sweep.moves), bundle_path(policy) is not None
    error = np.subtract(last.mean, source)
    error_m = math.dist(last.mean, source)
    xx, xy, yy = last.covariance
    return MissionRow(
        policy=policy,
        particles=particles,
        threshold_m=None if config.within else threshold_m,
        seed=seed,
        budget=sweep.budget,
        headings=None if learned else moves.headings,
        step_m=moves.step,
        measurements=None if learned else moves.measurements,
        ceased=ceased,
        located=ceased and error_m <= SUCCESS_RADIUS_M,
        estimate_x=last.mean[0],
        estimate_y=last.mean[1],
        source_x=source[0],
        source_y=source[1],
        error_m=error_m,
        spread_m=last.spread,
        nees=float(error @ np.linalg.pinv([[xx, xy], [xy, yy]]) @ error),
        steps=last.step,
        distance_m=distance_m,
        floor_m=floor_m,
        search_time_s=sum(updates_s) + sum(decisions_s),
        decision_ms=1e3 * float(np.mean(decisions_s)) if decisions_s else 0.0,
        update_ms=1e3 * float(np.mean(updates_s)),
        **told(config),
        version=__version__,
        world=world,
    )


def told(config: Config) -> dict[str, Any]:
    """Return the columns of a row that say what was told, assumed and waited for, in the form of the flags."""
    names = {kind: name for name, kind in KINDS.items()}
    priors = [f"{name}={names[type(prior)]}:{','.join(map(repr, astuple(prior)))}" for name, prior in config.priors.items()]
    stop_on = ["location"] * config.stop_on_location + [f"{name}={limit!r}" for name, limit in config.stop_limits.items()]
    stop = config.criterion.text if config.within else "spread"
    said = {"sensor": text(config.sensor), "prior": " ".join(priors) or None, "stop_on": ",".join(stop_on)}
    return {**said, "assume": config.assume, "stop": stop}


def fly_all(sweep: Sweep, journal: Path, fly_tasks: Flyer) -> Generator[list[MissionRow], None, None]:
    """Fly the flights that the journal lacks; yields the rows of each flight as it ends, those of the journal first.

    Each flight is added to the journal as it ends, so an interrupted sweep can resume.
    """
    done = _kept(journal)
    yield from (rows for flight, rows in done.items() if flight in sweep)
    left = (flight for flight in sweep.flights if flight not in done)
    tasks = (list(flights) for _, flights in groupby(left, key=lambda flight: flight[2]))
    journal.parent.mkdir(parents=True, exist_ok=True)
    with journal.open("ab", buffering=0) as file, closing(fly_tasks(sweep, tasks)) as flown:
        file.write(b"\n")  # ends a line that an interrupt left incomplete
        for rows in flown:
            file.write(msgspec.json.encode(rows) + b"\n")
            yield rows


def _kept(journal: Path) -> dict[Flight, list[MissionRow]]:
    """Rows by flight of a journal. A line that cannot be read was left incomplete by an interrupt."""
    done: dict[Flight, list[MissionRow]] = {}
    if journal.exists():
        with journal.open("rb") as file:
            for line in file:
                with suppress(msgspec.DecodeError, UnicodeDecodeError):
                    rows = msgspec.json.decode(line, type=Rows)
                    done[rows[0].policy, rows[0].particles, rows[0].seed, rows[0].world] = rows
    return done


def on_cores(workers: int) -> Flyer:
    """Return what flies in this number of processes."""
    return partial(_on_cores, workers)


def _on_cores(workers: int, sweep: Sweep, tasks: Iterable[Sequence[Flight]]) -> Generator[list[MissionRow], None, None]:
    with closing(as_flown(partial(fly, sweep), tasks, workers)) as results:
        for _, flown in results:
            yield from flown


@cache
def code() -> str:
    """Digest of our sources and of the numpy and numba versions."""
    digest = hashlib.blake2b(f"{np.__version__} {numba.__version__}".encode(), digest_size=8)
    root = Path(__file__).parents[2]
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def journal_of(sweep: Sweep, folder: Path) -> Path:
    """Return the journal of a sweep. Other settings or other code have another journal."""
    bundles = [hashlib.blake2b(path.read_bytes(), digest_size=8).hexdigest() for name in sweep.policies if (path := bundle_path(name))]
    question = (code(), bundles, sweep.thresholds_m, sweep.budget, sorted(sweep.moves.items()), sorted(sweep.knowledge.items()))
    digest = hashlib.blake2b(repr(question).encode(), digest_size=8)
    return folder / f"evaluate-{digest.hexdigest()}.jsonl"


def ordered(rows: Iterable[MissionRow], sweep: Sweep) -> list[MissionRow]:
    """Return rows in the order of the request, whichever worker ended first."""
    rank = {flown: i for i, flown in enumerate(product(sweep.policies, sweep.worlds))}
    return sorted(rows, key=lambda row: (rank[row.policy, row.world], row.particles, row.threshold_m, row.seed))
