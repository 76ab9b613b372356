"""How far the stop can be believed: thousands of missions, judged by the truth. Writes the tables of docs/calibration.md.

    python benchmarks/calibration.py                      # all sections, about an hour on two cores
    python benchmarks/calibration.py --only sensors       # one of them

Scenarios are the test seeds (1,000,000 and up) and infotaxis flies. A mission is flown on until its spread is below the smallest ζ
asked for; where it first was below each ζ, it would have stopped there: one flight serves all thresholds.
"""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.service import choose
from estimator import kernels, priors
from estimator.belief import INCOMPATIBLE, belief
from estimator.filter import Config, assimilate, prior
from estimator.priors import Gamma, Normal, Prior, Uniform
from link.mavlink import Reading
from plume.randomness import derived_seed, keyed
from plume.scenario import BUDGET_STEPS, Scenario, draw
from plume.sensor import GAUSSIAN, Sensor
from plume.world import World, float32

Array = NDArray[np.float64]

DOCUMENT = Path(__file__).parents[1] / "docs" / "calibration.md"
FIRST_SEED = 1_000_000
ALTITUDE_M = 5.0
THRESHOLDS_M = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
PARTICLES = (100, 500, 1000, 2000, 4000)


@dataclass(frozen=True)
class Case:
    """What is flown and what the estimator knows: a row of a table."""

    name: str
    particles: int = 1000
    thresholds_m: Sequence[float] = THRESHOLDS_M
    sensor: Sensor = GAUSSIAN
    priors: dict[str, Prior] = field(default_factory=dict)
    """As of `Config`."""
    all_eight: bool = False
    """The truth is drawn from AutoSTE's priors, and all of it is unknown."""
    fault: Callable[[int, float, float], float] | None = None
    """What a broken sensor says instead: (step, the true reading, the one it said before) -> reading."""


@dataclass(frozen=True)
class Stop:
    """Where a mission first was below one ζ."""

    threshold_m: float
    steps: int
    error_m: float
    nees: float
    """Of the location; its mean is 2 for an honest posterior."""
    nees_all: float
    """Of all unknowns; its mean is their number."""
    warned: bool
    """The readings were found incompatible with the model, at the stop or before it."""


@dataclass(frozen=True)
class Flight:
    """One mission of a case."""

    stops: dict[float, Stop]
    warned: bool


def eight(seed: int) -> tuple[Scenario, dict[str, Prior]]:
    """AutoSTE's unknowns at the scale of Table 1: a truth drawn from the very priors that the estimator is given.

    Wind speed and direction are known to about 0.5 m/s and 10 degrees, as from an anemometer that is not trusted further.
    """
    rng = keyed(seed, "eight unknowns")
    u, phi = rng.uniform(1.5, 3.5), rng.uniform(0, 2 * math.pi)
    unknown: dict[str, Prior] = {
        "z": Uniform(0.0, 5.0),
        "q": Gamma(2.0, 150.0),
        "u": Normal(u, 0.5),
        "phi": Normal(phi, math.radians(10)),
        "d": Uniform(1.0, 8.0),
        "tau": Uniform(5.0, 20.0),
    }
    rows = Config(priors=unknown).prior_rows
    truth = [float(priors.draw(rows, np.array([index]), 1, rng)[0, 0]) for index in range(8)]
    x, y, z, q, u, phi, d, tau = truth
    start_x, start_y = rng.uniform(0, 5, 2).tolist()
    return Scenario(source=(x, y), q=q, u=u, phi=phi, d=d, tau=tau, start=(start_x, start_y), height=z - ALTITUDE_M), unknown


def fly(case: Case, seed: int) -> Flight:
    """Fly one mission of a case to its smallest ζ."""
    scenario, unknown = eight(seed) if case.all_eight else (draw(seed), case.priors)
    config = Config(
        case.particles, min(case.thresholds_m), derived_seed(seed, "estimator"), scenario.q, scenario.d, scenario.tau,
        priors=unknown, sensor=case.sensor,
    )  # fmt: skip
    truth = dict(
        x=scenario.source[0], y=scenario.source[1], z=ALTITUDE_M + scenario.height, q=scenario.q, u=scenario.u, phi=scenario.phi,
        d=scenario.d, tau=scenario.tau,
    )  # fmt: skip
    wanted = np.array([truth[name] for name in config.unknowns])
    world = World(scenario, seed, case.sensor)
    posterior, position, said = prior(config), world.start, 0.0
    stops: dict[float, Stop] = {}
    warned = False
    for step in range(BUDGET_STEPS + 1):
        gas = world.gas(position, step)
        said = float32(case.fault(step, gas, said)) if case.fault else gas
        reading = Reading(step, position, ALTITUDE_M, world.wind, said)
        posterior = assimilate(posterior, reading, config)
        summary, cloud = belief(posterior, reading, config)
        warned = warned or summary.p_value < INCOMPATIBLE
        for threshold_m in case.thresholds_m:
            if summary.spread < threshold_m and summary.p_value >= INCOMPATIBLE and threshold_m not in stops:
                mean, covariance = kernels.moments(posterior.particles, posterior.weights)
                nees, nees_all = (squared_error((mean - wanted)[:n], covariance[:n, :n]) for n in (2, len(mean)))
                error_m = math.dist(summary.mean, scenario.source)
                stops[threshold_m] = Stop(threshold_m, step, error_m, nees, nees_all, warned)
        if summary.ceased:
            break
        position = choose("infotaxis", summary, cloud, derived_seed(seed, "agent"))
    return Flight(stops, warned)


def squared_error(error: Array, covariance: Array) -> float:
    """NEES: e' C⁻¹ e."""
    return float(error @ np.linalg.solve(covariance, error))


def _fly(job: tuple[Case, int]) -> Flight:
    return fly(*job)


def flights(case: Case, missions: int) -> list[Flight]:
    """Fly all missions of a case on all cores."""
    began = time.monotonic()
    results = []
    with Pool() as pool:
        for flight in pool.imap(_fly, [(case, FIRST_SEED + i) for i in range(missions)], chunksize=5):
            results.append(flight)
            if len(results) % 50 == 0:
                print(f"\r{case.name}, N = {case.particles}: {len(results)}/{missions}", end="", file=sys.stderr, flush=True)
    print(f", {time.monotonic() - began:.0f} s", file=sys.stderr)
    return results
