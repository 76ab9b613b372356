"""The time of one decision, compared with two peers on the same beliefs and with the lower limit: the
likelihoods alone.

    NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.planners     # needs
    Stone Soup

A decision starts from the belief and its float32 particles, as received from the bus, and ends with the
waypoint.
"""
# mypy: allow-untyped-decorators

import time
from collections.abc import Callable, Iterator
from functools import partial

import numba
import numpy as np
from numpy.typing import NDArray

from agent.planners.registry import PLANNERS
from agent.planners.registry import reach as own
from agent.planning.moves import Reach
from agent.policies import choose
from agent.trials.rollout import mission
from benchmarks import planner_peers
from benchmarks.planner_peers import StoneSoup
from link.bus.messages import Belief, Particles
from plume.numerics import exp, fma
from plume.scenario import BUDGET_STEPS

Array = NDArray[np.float64]
Case = tuple[Belief, Particles]

SIZES = (1000, 4000, 20_000)
HEADINGS = (4, 8)
MEASUREMENTS = 25
FIRST_SEED = 1_000_000
MISSIONS = 4
KEPT = 4
"""Beliefs per mission, evenly spaced from the first to the last before the stop."""
REPEATS = 5


def flight(seed: int, count: int) -> Iterator[Case]:
    """Fly the mission of a seed with infotaxis; yields each belief from which a decision is made."""
    for said, particles, *_ in mission(seed, "infotaxis", count, 0.5, BUDGET_STEPS).steps:
        if not said.ceased:
            yield said, particles


def beliefs(seed: int, count: int, kept: int = KEPT) -> list[Case]:
    """Evenly spaced beliefs of a mission, from its first to its last."""
    cases = list(flight(seed, count))
    return [cases[i] for i in np.linspace(0, len(cases) - 1, kept).astype(int)]


@numba.njit(error_model="numpy")
def likelihoods(coefficients: Array, readings: Array, result: Array) -> None:
    """Likelihoods (N,), one reading after the other: exp of a quadratic in the reading with coefficients
    (A, 3, N).
    """
    for a in range(len(coefficients)):
        for z in readings:
            for i in range(len(result)):
                result[i] = exp(
                    fma(fma(coefficients[a, 0, i], z, coefficients[a, 1, i]), z, coefficients[a, 2, i])
                )


def decisions(case: Case, reach: Reach) -> dict[str, Callable[[], object]]:
    """The decision functions to time, by their row in the table."""
    said, particles = case
    noise = np.random.default_rng(0)
    coefficients, readings = (
        noise.uniform(-1, 0, (len(reach.moves(said.position)), 3, len(particles))),
        noise.uniform(0, 5, MEASUREMENTS),
    )
    result = np.empty(len(particles))
    one, many = StoneSoup(said, particles, reach), StoneSoup(said, particles, reach, reach.measurements)
    return {
        **{
            name: partial(choose, name, said, particles, 0, own(name, {"headings": reach.headings}))
            for name in PLANNERS
        },
        **{
            f"{name}, plain NumPy": partial(planner_peers.choose, name, said, particles, 0, reach)
            for name in planner_peers.NUMPY
        },
        "infotaxis, Stone Soup, 1 measurement": one.choose,
        f"infotaxis, Stone Soup, {MEASUREMENTS} measurements": many.choose,
        "infotaxis, likelihoods alone, the limit": partial(likelihoods, coefficients, readings, result),
    }


def medians(cases: list[Case], reach: Reach) -> dict[str, float]:
    """Median time of a decision over the beliefs, s. All planners decide from a belief before the next, so
    that load slows them alike.
    """
    times: dict[str, list[float]] = {}
    for case in cases:
        for name, decide in decisions(case, reach).items():
            decide()  # compiles the kernels
            for _ in range(REPEATS):
                began = time.perf_counter()
                decide()
                times.setdefault(name, []).append(time.perf_counter() - began)
    return {name: float(np.median(taken)) for name, taken in times.items()}


def main() -> None:
    """Print the table."""
    columns = {}
    for count in SIZES:
        cases = [case for i in range(MISSIONS) for case in beliefs(FIRST_SEED + i, count)]
        for headings in HEADINGS:
            columns[f"N {count:,}, {headings} headings"] = medians(
                cases, Reach(headings=headings, measurements=MEASUREMENTS)
            )
    others = ", ".join(
        f"{own(name).measurements} of {name}" for name in PLANNERS if own(name).measurements != MEASUREMENTS
    )
    print(
        f"ms per decision, {MEASUREMENTS} hypothetical readings per move ({others}): "
        f"median over {MISSIONS * KEPT} beliefs of {MISSIONS} missions."
    )
    print("In brackets: the time as a multiple of our planner of the same name.\n")
    print(f"| planner | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for name in next(iter(columns.values())):
        ours = name.split(",")[0]
        cells = [f"{1e3 * taken[name]:.3g}" for taken in columns.values()]
        if name != ours:
            cells = [
                f"{cell} ({taken[name] / taken[ours]:.3g}x)"
                for cell, taken in zip(cells, columns.values(), strict=True)
            ]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
