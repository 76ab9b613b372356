"""Sweeps: missions of policies over seeds, particles and stop criteria, on all cores.

A journal keeps each flight, to resume.
"""

import hashlib
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby, product
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from agent.policies import bundle_path, reach
from agent.trials.figures import MissionRow, nees
from agent.trials.floor import LEAST_THRESHOLD_M, floors_m
from agent.trials.progress import with_bar
from agent.trials.rollout import Mission, mission
from agent.trials.sources import code, of_policy, of_world
from agent.trials.workers import as_flown
from estimator.belief import met, warning
from estimator.criterion import Criterion
from estimator.filter import Config
from estimator.priors import text as prior_text
from link.bus.messages import Belief
from plume import __version__
from plume.outcome import verdict
from plume.problem import AREA, PAPER, Problem
from plume.problems.fleet import ALONE, Fleet
from plume.problems.names import sensor_of
from plume.scenario import AS_MODELLED, STEP_M
from plume.sensors.names import GAUSSIAN, text


@dataclass(frozen=True)
class Sweep:
    """Which missions to fly, and how."""

    policies: Sequence[str]
    seeds: range
    particles: Sequence[int] = (1000,)
    stops: Sequence[Criterion] = (Criterion(),)  # each once. One flight serves all of them.
    budget: int | None = None  # None: the problem's
    moves: dict[str, float] = field(default_factory=dict)  # fields of `Reach` that replace the planner's own
    knowledge: dict[str, Any] = field(default_factory=dict)  # other fields of `Config`
    worlds: Sequence[str] = (AS_MODELLED,)
    problem: Problem = PAPER  # `worlds` and `stops` stand for its world and stop
    fleet: Fleet = ALONE  # the vehicles that fly each mission together

    @property
    def flights(self) -> Iterator["Flight"]:
        """All flights, seed by seed. One flight serves all stop criteria."""
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

    @property
    def files(self) -> dict[tuple[str, str], str | None]:
        """Digests of bundles, plug-ins and files, by policy and world; None where there are none."""
        return {
            (policy, world): of_policy(policy) + of_world(world) or None
            for policy, world in product(self.policies, self.worlds)
        }

    def __contains__(self, flight: "Flight") -> bool:
        policy, particles, seed, world = flight
        return (
            policy in self.policies
            and particles in self.particles
            and seed in self.seeds
            and world in self.worlds
        )


Flight = tuple[str, int, int, str]  # (policy, particles, seed, world)
Rows = Annotated[list[MissionRow], msgspec.Meta(min_length=1)]  # the rows of a flight, one per stop criterion
# (sweep, flights by seed) -> the rows of each flight, in any order.
Flyer = Callable[[Sweep, Iterable[Sequence[Flight]]], Generator[list[MissionRow], None, None]]


def fly(sweep: Sweep, flights: Sequence[Flight]) -> list[list[MissionRow]]:
    """Fly missions of one seed until all stop criteria have been met.

    Returns their rows, one per criterion, each as of its own stop.
    """
    first = sweep.stops[0]
    missions = [
        mission(
            seed,
            policy,
            particles,
            first.threshold_m,
            sweep.budget,
            sweep.moves,
            world,
            ends=False,
            problem=sweep.problem,
            fleet=sweep.fleet,
            within=first.within,
            **sweep.knowledge,
        )
        for policy, particles, seed, world in flights
    ]
    modelled = [ready for flight, ready in zip(flights, missions, strict=True) if flight[3] == AS_MODELLED]
    floors = _floors(sweep, modelled[0]) if modelled else {}
    return [
        _fly(sweep, flight, ready, floors if flight[3] == AS_MODELLED else {})
        for flight, ready in zip(flights, missions, strict=True)
    ]


def _floors(sweep: Sweep, ready: Mission) -> dict[float, float]:
    """The information floor of a mission at each ζ, m, where docs/floor.md defines it."""
    config = ready.config
    as_defined = config.sensor == GAUSSIAN and sweep.moves.get("step", sweep.problem.step_m) == STEP_M
    as_defined &= sweep.problem.ground == AREA and not sweep.problem.prior and sweep.fleet == ALONE
    if not as_defined or config.effective_priors or config.stop_limits:
        return {}
    thresholds_m = [stop.threshold_m for stop in sweep.stops if not stop.within]
    floors = floors_m(ready.scenario, [limit for limit in thresholds_m if limit >= LEAST_THRESHOLD_M])
    return {threshold_m: floor_m for threshold_m, floor_m in floors.items() if math.isfinite(floor_m)}


def _fly(sweep: Sweep, flight: Flight, ready: Mission, floors: dict[float, float]) -> list[MissionRow]:
    scenario, config, steps = ready
    waiting = {
        stop: replace(config, threshold_m=stop.threshold_m, within=stop.within) for stop in sweep.stops
    }
    rows: dict[Criterion, MissionRow] = {}
    warned: set[Criterion] = set()
    updates_s: list[float] = []
    decisions_s: list[float] = []
    distance_m, stalls = 0.0, 0
    positions: dict[int, tuple[float, float]] = {}  # of each vehicle

    def row(stop: Criterion, ceased: bool) -> MissionRow:
        told, floor_m = waiting[stop], None if stop.within else floors.get(stop.threshold_m)
        return row_of(
            sweep,
            flight,
            told,
            ceased,
            stop in warned,
            said,
            scenario.nearest(said.mean),
            distance_m,
            stalls,
            floor_m,
            updates_s,
            decisions_s,
        )

    for step in steps:
        said = step.belief
        updates_s.append(step.update_s)
        stalls += (said.back is not msgspec.UNSET) + len(said.backs or ())
        if said.step:
            decisions_s.append(step.decision_s)
            for reading in step.readings:
                distance_m += math.dist(positions[reading.vehicle], reading.position)
        positions |= {reading.vehicle: reading.position for reading in step.readings}
        warned |= {stop for stop, told in waiting.items() if warning(said, told)}
        for stop in [stop for stop, told in waiting.items() if met(step.posterior, said, told)]:
            rows[stop] = row(stop, True)
            del waiting[stop]
        if not waiting:
            break
    rows |= {stop: row(stop, False) for stop in waiting}
    return [rows[stop] for stop in sweep.stops]


def row_of(
    sweep: Sweep,
    flight: Flight,
    config: Config,
    ceased: bool,
    warned: bool,
    last: Belief,
    source: tuple[float, float],
    distance_m: float,
    stalls: int,
    floor_m: float | None,
    updates_s: Sequence[float],
    decisions_s: Sequence[float],
) -> MissionRow:
    """Return the row of a mission that has been flown."""
    policy, particles, seed, world = flight
    error_m = math.dist(last.mean, source)
    ended = verdict(ceased, last.mean, source, last.outside, config.area)
    return MissionRow(
        policy=policy,
        particles=particles,
        threshold_m=None if config.within else config.threshold_m,
        seed=seed,
        ceased=ceased,
        located=ended == "located",
        estimate_x=last.mean[0],
        estimate_y=last.mean[1],
        source_x=source[0],
        source_y=source[1],
        error_m=error_m,
        spread_m=last.spread,
        nees=nees(last.mean, source, last.covariance),
        steps=last.step,
        distance_m=distance_m,
        stalls=stalls,
        floor_m=floor_m,
        search_time_s=sum(updates_s) + sum(decisions_s),
        decision_ms=1e3 * float(np.mean(decisions_s)) if decisions_s else 0.0,
        update_ms=1e3 * float(np.mean(updates_s)),
        stop=config.criterion.text if config.within else "spread",
        version=__version__,
        world=world,
        warned=warned,
        outside=ended == "outside",
        **settings(sweep, policy, config),
    )


def settings(sweep: Sweep, policy: str, config: Config) -> dict[str, Any]:
    """Return the columns that are equal in all rows of a policy, in the form of the flags."""
    moves, learned = reach(policy, sweep.moves, sweep.problem), bundle_path(policy) is not None
    limits = [f"{name}={limit!r}" for name, limit in config.stop_limits.items()]
    return {
        "budget": sweep.budget or sweep.problem.budget,
        "problem": sweep.problem.site.text,
        "headings": None if learned else moves.headings,
        "step_m": moves.step,
        "measurements": None if learned else moves.measurements,
        "sensor": text(config.sensor),
        "prior": " ".join(prior_text(name, prior) for name, prior in config.priors.items()) or None,
        "stop_on": ",".join(["location"] * config.stop_on_location + limits),
        "assume": config.assume,
        "margin_m": config.margin,
        "vehicles": sweep.fleet.vehicles,
        "start_from": sweep.fleet.formation,
        "separation_m": sweep.fleet.separation_m if sweep.fleet.vehicles > 1 else None,
    }


def flown(
    sweep: Sweep, journal: Path, fly_tasks: Flyer, what: str, starting: str, there: Sequence[MissionRow] = ()
) -> list[MissionRow]:
    """Fly a sweep as `fly_all` does, beside a progress bar; returns its rows, `ordered`."""
    flights = fly_all(sweep, journal, fly_tasks, there)
    with closing(with_bar(flights, sweep.count, what, starting)) as all_rows:
        return ordered((row for rows in all_rows for row in rows), sweep)


def fly_all(
    sweep: Sweep, journal: Path, fly_tasks: Flyer, there: Sequence[MissionRow] = ()
) -> Generator[list[MissionRow], None, None]:
    """Fly the flights that neither the journal nor the rows `there` have; yields the rows of each flight.

    Those that have been flown come first. Each flight is added to the journal as it ends, so an interrupted
    sweep can resume.
    """
    done, files = complete(sweep, there) | kept(sweep, journal), sweep.files
    yield from done.values()
    left = (flight for flight in sweep.flights if flight not in done)
    tasks = (list(flights) for _, flights in groupby(left, key=lambda flight: flight[2]))
    journal.parent.mkdir(parents=True, exist_ok=True)
    with journal.open("ab", buffering=0) as file, closing(fly_tasks(sweep, tasks)) as results:
        file.write(b"\n")  # ends a line that an interrupt left incomplete
        for flown in results:
            rows = [msgspec.structs.replace(row, files=files[row.policy, row.world]) for row in flown]
            file.write(msgspec.json.encode(rows) + b"\n")
            yield rows


def complete(sweep: Sweep, rows: Iterable[MissionRow]) -> dict[Flight, list[MissionRow]]:
    """Return the flights of a sweep that rows tell in full: flown in its way, with all its criteria.

    Rows of another bundle, plug-in or file of a world tell none.
    """
    wanted, said = [stop.text for stop in sweep.stops], dict[Flight, dict[str, MissionRow]]()
    files = sweep.files
    for row in filter(answers(sweep), rows):
        if row.files in (None, files[row.policy, row.world]):
            said.setdefault(row.flight, {})[row.criterion] = row
    return {flight: [of[stop] for stop in wanted] for flight, of in said.items() if of.keys() >= {*wanted}}


def answers(sweep: Sweep) -> Callable[[MissionRow], bool]:
    """Return what tells whether a row is one of a sweep: of its flights, settings and criteria."""
    searched: dict[str, Any] = {"area": sweep.problem.ground, "expected": sweep.problem.support}
    config = Config(**searched, **{"sensor": sensor_of(sweep.problem), **sweep.knowledge})
    ways = {policy: settings(sweep, policy, config).items() for policy in sweep.policies}
    wanted = {stop.text for stop in sweep.stops}

    def answer(row: MissionRow) -> bool:
        return (
            row.flight in sweep
            and row.criterion in wanted
            and all(_says(getattr(row, name), value) for name, value in ways[row.policy])
        )

    return answer


def _says(written: Any, value: Any) -> bool:
    """Whether a setting in a row is this one; older tables have its first six digits."""
    return written == value or (isinstance(value, float) and written == float(f"{value:.6g}"))


def kept(sweep: Sweep, journal: Path) -> dict[Flight, list[MissionRow]]:
    """Return the flights of a sweep in a journal.

    A line that cannot be read was left incomplete by an interrupt.
    """
    done: dict[Flight, list[MissionRow]] = {}
    if journal.exists():
        with journal.open("rb") as file:
            for line in file:
                with suppress(msgspec.DecodeError, UnicodeDecodeError):
                    rows = msgspec.json.decode(line, type=Rows)
                    done[rows[0].flight] = rows
    return {flight: rows for flight, rows in done.items() if flight in sweep}


def on_cores(workers: int) -> Flyer:
    """Return what flies in this number of processes."""
    return partial(_on_cores, workers)


def _on_cores(
    workers: int, sweep: Sweep, tasks: Iterable[Sequence[Flight]]
) -> Generator[list[MissionRow], None, None]:
    with closing(as_flown(partial(fly, sweep), tasks, workers)) as results:
        for _, flown in results:
            yield from flown


def journal_of(sweep: Sweep, folder: Path) -> Path:
    """Return the journal of a sweep. Other settings, code, bundles, plug-ins or files have another one."""
    question = (
        code(),
        [*filter(None, map(of_policy, sweep.policies)), *filter(None, map(of_world, sweep.worlds))],
        sweep.stops,
        sweep.budget,
        sweep.problem,
        sorted(sweep.moves.items()),
        sorted(sweep.knowledge.items()),
        sweep.fleet,
    )
    digest = hashlib.blake2b(repr(question).encode(), digest_size=8)
    return folder / f"evaluate-{digest.hexdigest()}.jsonl"


def ordered(rows: Iterable[MissionRow], sweep: Sweep) -> list[MissionRow]:
    """Return rows by policy and world, as requested, then by particles, stop criterion and seed."""
    rank = {flown: i for i, flown in enumerate(product(sweep.policies, sweep.worlds))}
    stops = sorted(sweep.stops, key=lambda stop: (stop.within or (), stop.threshold_m))
    place = {stop.text: i for i, stop in enumerate(stops)}
    return sorted(
        rows, key=lambda row: (rank[row.policy, row.world], row.particles, place[row.criterion], row.seed)
    )
