"""Env steps per second of single and batched missions, compared with gymnasium's vector environments; the
time of each part of a step.

    NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.env

Each flight makes 40 moves towards the estimate. A mission that stops earlier is followed by another one,
as in training. The reset before a flight is not timed; resets during a flight are.
"""

import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import agent.learn.missions
from agent.learn.env import SourceSearch, SourceSearchVector
from agent.learn.missions import Missions
from agent.observation import SCHEMAS
from estimator.assumptions import ASSUMPTIONS
from estimator.batch import Batch

PARTICLES = (100, 500, 1000, 4000)
BATCHES = (1, 4, 16, 64, 256, 1024)
STEPS = 40
MISSIONS = 32
"""Smaller batches fly one after the other until this many missions have flown, with the same seeds."""
REPEATS = 3
ENOUGH_S = 5.0
"""No further repeat once the flights have taken more than this on average."""
USUAL = 500
"""Particles in the tables that have one number of particles."""
FLOWN = 1000
"""Particles of a usual mission."""
PEERS_BATCH, THREADS_BATCH = 64, 256
WANTED = 10_000
"""Target: steps per second per core at N = 500."""

Flight = Callable[[], tuple[float, int]]
"""Flies missions; returns the seconds taken and the env steps made."""


def alone(particles: int) -> tuple[float, int]:
    """Fly the missions one after the other in the single env."""
    env, seconds = SourceSearch(particles=particles), 0.0
    for seed in range(MISSIONS):
        env.reset(seed=seed)
        began = time.perf_counter()
        for _ in range(STEPS):
            _, _, terminated, truncated, _ = env.step(0)
            if terminated or truncated:
                env.reset()
        seconds += time.perf_counter() - began
    return seconds, MISSIONS * STEPS


def side_by_side(env: Any, missions: int = MISSIONS) -> tuple[float, int]:
    """Fly at least this many missions in a vector env."""
    actions, seconds, steps = np.zeros(env.num_envs, np.int64), 0.0, 0
    for seed in range(0, missions, env.num_envs):
        env.reset(seed=seed)
        began = time.perf_counter()
        for _ in range(STEPS):
            env.step(actions)
        seconds += time.perf_counter() - began
        steps += STEPS * env.num_envs
    return seconds, steps


def speeds(flights: dict[str, Flight]) -> dict[str, float]:
    """Steps per second, median over the repeats. Each repeat runs all flights in turn, so that other load
    slows them alike.
    """
    said: dict[str, list[float]] = {}
    began = time.perf_counter()
    for _ in range(REPEATS):
        for name, flight in flights.items():
            seconds, steps = flight()
            said.setdefault(name, []).append(steps / seconds)
        if time.perf_counter() - began > ENOUGH_S * len(flights):
            break
    return {name: statistics.median(values) for name, values in said.items()}


def by_size(particles: int) -> dict[str, float]:
    """Steps per second on one thread, by the number of missions in a batch."""
    flights: dict[str, Flight] = {"single env": partial(alone, particles)}
    result = speeds(flights)
    for count in BATCHES:
        result |= speeds(
            {f"{count:,} side by side": partial(side_by_side, SourceSearchVector(count, particles=particles))}
        )
    return result


def beside_peers() -> dict[str, tuple[int, float]]:
    """(Cores used, steps per second) of each vector env."""
    single = partial(SourceSearch, particles=USUAL)
    native = partial(SourceSearchVector, particles=USUAL)
    in_turn = SyncVectorEnv([single] * PEERS_BATCH, autoreset_mode=AutoresetMode.SAME_STEP)
    processes = AsyncVectorEnv([single] * 2, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)
    ways: dict[str, tuple[int, Flight]] = {
        f"ours, {PEERS_BATCH} missions": (1, partial(side_by_side, native(PEERS_BATCH), PEERS_BATCH)),
        f"ours, {THREADS_BATCH} missions": (1, partial(side_by_side, native(THREADS_BATCH), THREADS_BATCH)),
        f"ours, {THREADS_BATCH} missions, 2 threads": (
            2,
            partial(side_by_side, native(THREADS_BATCH, threads=2), THREADS_BATCH),
        ),
        f"gymnasium's SyncVectorEnv, {PEERS_BATCH} missions": (
            1,
            partial(side_by_side, in_turn, PEERS_BATCH),
        ),
        "gymnasium's AsyncVectorEnv, 2 processes of a mission each": (2, partial(side_by_side, processes)),
    }
    said = speeds({name: flight for name, (_, flight) in ways.items()})
    processes.close()
    return {name: (cores, said[name]) for name, (cores, _) in ways.items()}


class Stopwatch:
    """Seconds spent in each part of the work, without the parts that it calls."""

    def __init__(self) -> None:
        """Start empty."""
        self.seconds: dict[str, float] = {}
        self._parts: list[str] = []
        self._since = 0.0

    def timed(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """Return the same function, timed as this part."""

        def watched(*arguments: Any, **named: Any) -> Any:
            self._count()
            self._parts.append(part)
            try:
                return work(*arguments, **named)
            finally:
                self._count()
                self._parts.pop()

        return watched

    def _count(self) -> None:
        now = time.perf_counter()
        if self._parts:
            self.seconds[self._parts[-1]] = self.seconds.get(self._parts[-1], 0.0) + now - self._since
        self._since = now


def by_assumption() -> dict[str, float]:
    """Steps per second on two threads, by what the estimator takes to be known."""
    envs = {
        assume: SourceSearchVector(PEERS_BATCH, particles=FLOWN, threads=2, assume=assume)
        for assume in ASSUMPTIONS
    }
    return speeds({assume: partial(side_by_side, env, PEERS_BATCH) for assume, env in envs.items()})


def parts(count: int, assume: str) -> dict[str, float]:
    """Seconds per env step and mission, by part: whole flights of `count` missions on one thread."""
    env, watch = SourceSearchVector(count, particles=USUAL, assume=assume), Stopwatch()
    polar = SCHEMAS["polar"]
    seen = replace(polar, see_missions=watch.timed("observation", polar.see_missions))
    said = []
    with ExitStack() as patches:
        patches.enter_context(patch.dict(SCHEMAS, polar=seen))
        for owner, name, part in (
            (env, "step", "the rest: moves, infos, copies"),
            (Missions, "begin", "missions that follow: scenario and prior"),
            (agent.learn.missions, "readings_of", "readings"),
            (Batch, "assimilate", "filter"),
            (Batch, "may_claim", "whether a stop may be claimed"),
        ):
            patches.enter_context(patch.object(owner, name, watch.timed(part, getattr(owner, name))))
        for _ in range(REPEATS):
            env.reset(seed=0)
            watch.seconds.clear()
            for _ in range(STEPS):
                env.step(np.zeros(count, np.int64))
            said.append({part: seconds / (STEPS * count) for part, seconds in watch.seconds.items()})
    return {part: statistics.median(each[part] for each in said) for part in said[0]}


def main() -> None:
    """Print the tables."""
    side_by_side(SourceSearchVector(4, particles=100, threads=2))  # compiles the kernels
    console = Console(width=120)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("flying", total=len(PARTICLES) + 3)
        columns = {}
        for particles in PARTICLES:
            columns[particles] = by_size(particles)
            progress.advance(task)
        peers = beside_peers()
        progress.advance(task)
        known = by_assumption()
        progress.advance(task)
        split = {assume: parts(PEERS_BATCH, assume) for assume in ASSUMPTIONS}
        progress.advance(task)

    table = Table(
        "missions",
        *(f"N = {particles:,}" for particles in PARTICLES),
        title="env steps a second, polar observation, one thread",
    )
    for row in columns[USUAL]:
        table.add_row(row, *(f"{said[row]:,.0f}" for said in columns.values()))
    console.print(table)

    ours = next(iter(peers.values()))[1]
    table = Table(
        "", "cores", "steps/s", "per core", "ours is faster per core", title=f"beside others, N = {USUAL}"
    )
    for name, (cores, speed) in peers.items():
        table.add_row(
            name, str(cores), f"{speed:,.0f}", f"{speed / cores:,.0f}", f"{ours * cores / speed:.2f}x"
        )
    console.print(table)

    table = Table(
        "--assume", "steps/s", "of paper's", title=f"{PEERS_BATCH} missions, N = {FLOWN:,}, two threads"
    )
    for assume, speed in known.items():
        table.add_row(assume, f"{speed:,.0f}", f"{speed / known['paper']:.2f}")
    console.print(table)

    for assume, seconds_of in split.items():
        title = f"one step of a mission under {assume}, {PEERS_BATCH} side by side, N = {USUAL}"
        table = Table("part", "µs", "share", title=title)
        whole = sum(seconds_of.values())
        for part, seconds in sorted(seconds_of.items(), key=lambda item: -item[1]):
            table.add_row(part, f"{1e6 * seconds:.1f}", f"{seconds / whole:.0%}")
        console.print(table)

    row, best = max(columns[USUAL].items(), key=lambda item: item[1])
    console.print(
        f"wanted {WANTED:,} steps/s per core at N = {USUAL}: measured {best:,.0f} ({row}), {ours:,.0f} at "
        f"{PEERS_BATCH} side by side"
    )


if __name__ == "__main__":
    main()
