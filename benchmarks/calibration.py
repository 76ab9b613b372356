"""Reliability of the stop: compares thousands of stops with the true source. Writes the tables of docs/calibration.md.

    python benchmarks/calibration.py                      # all sections, about an hour on two cores
    python benchmarks/calibration.py --only sensors       # one section

Scenarios are the test seeds (1,000,000 and up); the policy is infotaxis. A mission flies until its spread is below the smallest ζ. It
would have stopped at each larger ζ when its spread first was below that one: one flight serves all thresholds.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.planning.moves import Reach
from agent.policies import choose
from agent.trials.figures import bootstrap, mean, wilson
from agent.trials.files import whole
from agent.trials.workers import WorkerLost, as_flown
from estimator import priors
from estimator.belief import INCOMPATIBLE, belief, may_claim
from estimator.filter import Config, assimilate, prior
from estimator.kernels.weights import moments
from estimator.priors import Gamma, Normal, Prior, Uniform
from link import cli
from link.bus.mavlink import Reading
from plume.randomness import derived_seed, keyed
from plume.scenario import AREA_M, BUDGET_STEPS, SUCCESS_RADIUS_M, Scenario, draw
from plume.sensor import GAUSSIAN, Hits, Sensor, Threshold
from plume.world import World, float32

Array = NDArray[np.float64]

DOCUMENT = Path(__file__).parents[1] / "docs" / "calibration.md"
FIRST_SEED = 1_000_000
ALTITUDE_M = 5.0
THRESHOLDS_M = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
PARTICLES = (100, 500, 1000, 2000, 4000)


@dataclass(frozen=True)
class Case:
    """What is flown and what the estimator knows: one case of a table."""

    name: str
    particles: int = 1000
    thresholds_m: Sequence[float] = THRESHOLDS_M
    sensor: Sensor = GAUSSIAN
    priors: dict[str, Prior] = field(default_factory=dict)
    """`Config.priors`."""
    all_eight: bool = False
    """All eight parameters are unknown; the truth is drawn from AutoSTE's priors."""
    fault: Callable[[int, float, float], float] | None = None
    """A broken sensor: (step, true reading, previous faulty reading) -> faulty reading, g/m³."""


@dataclass(frozen=True)
class Stop:
    """The step at which a mission's spread first was below one ζ."""

    threshold_m: float
    steps: int
    error_m: float
    nees: float
    """NEES of the location; its mean is 2 for an honest posterior."""
    nees_all: float
    """NEES of all unknowns; its mean is their number."""
    warned: bool
    """True if the readings were found incompatible with the model by then."""


@dataclass(frozen=True)
class Flight:
    """One mission of a case."""

    stops: dict[float, Stop]
    warned: bool


def eight(seed: int) -> tuple[Scenario, dict[str, Prior]]:
    """AutoSTE's eight unknowns at the scale of Table 1: (scenario, priors), the scenario drawn from the estimator's own priors.

    Wind speed and direction are known to about 0.5 m/s and 10 degrees, as from an inaccurate anemometer.
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
    """Fly one mission of a case until its smallest ζ."""
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
            if summary.spread < threshold_m and may_claim(summary.p_value, step + 1) and threshold_m not in stops:
                mean, covariance = moments(posterior.particles, posterior.weights)
                nees, nees_all = (squared_error((mean - wanted)[:n], covariance[:n, :n]) for n in (2, len(mean)))
                error_m = math.dist(summary.mean, scenario.source)
                stops[threshold_m] = Stop(threshold_m, step, error_m, nees, nees_all, warned)
        if summary.ceased:
            break
        position = choose("infotaxis", summary, cloud, derived_seed(seed, "agent"), Reach())
    return Flight(stops, warned)


def squared_error(error: Array, covariance: Array) -> float:
    """NEES: e' C⁻¹ e."""
    return float(error @ np.linalg.solve(covariance, error))


WORKERS = os.cpu_count() or 1


def flights(case: Case, missions: int) -> list[Flight]:
    """Fly all missions of a case on all cores."""
    began = time.monotonic()
    results: dict[int, Flight] = {}
    with closing(as_flown(partial(fly, case), range(FIRST_SEED, FIRST_SEED + missions), WORKERS)) as flown:
        for seed, flight in flown:
            results[seed] = flight
            if len(results) % 50 == 0:
                print(f"\r{case.name}, N = {case.particles}: {len(results)}/{missions}", end="", file=sys.stderr, flush=True)
    print(f", {time.monotonic() - began:.0f} s", file=sys.stderr)
    return [results[seed] for seed in sorted(results)]  # intervals are resampled in this order


def share(hits: int, of: int) -> str:
    """Write a share in percent with its interval."""
    return "–" if of == 0 else wilson(hits, of).text(100.0, 1)


def statistic(values: Array, of_samples: Callable[[Array], Array] = mean) -> str:
    """Write a statistic with its interval."""
    return "–" if len(values) == 0 else bootstrap(values, of_samples).text(1.0, 2)


def quantile(level: float, samples: Array) -> Array:
    """Return the quantile of each sample (R, n): (R,)."""
    return np.asarray(np.quantile(samples, level, axis=1))


COLUMNS = "ζ, m | missions | ceased, % | located, % | false stop, % | error ≤ 2ζ, % | error p50, m | p95, m | p99, m | mean NEES"


def row(results: Sequence[Flight], threshold_m: float) -> str:
    """One row of a table: the results of the missions at one ζ."""
    stops = [flight.stops[threshold_m] for flight in results if threshold_m in flight.stops]
    errors, nees = np.array([stop.error_m for stop in stops]), np.array([stop.nees for stop in stops])
    located = int((errors <= SUCCESS_RADIUS_M).sum())
    cells = [
        f"{threshold_m:g}",
        str(len(results)),
        share(len(stops), len(results)),
        share(located, len(stops)),
        share(len(stops) - located, len(stops)),
        share(int((errors <= 2 * threshold_m).sum()), len(stops)),
        *(statistic(errors, partial(quantile, q)) for q in (0.5, 0.95, 0.99)),
        statistic(nees),
    ]
    return " | ".join(cells)


def table(heading: str, rows: Sequence[tuple[str, str]]) -> str:
    """A Markdown table whose first column is `heading`."""
    width = 1 + len(COLUMNS.split("|"))
    return "\n".join([f"| {heading} | {COLUMNS} |", "|" + "---|" * width, *(f"| {name} | {cells} |" for name, cells in rows)])


def section_stop(missions: int) -> str:
    """The stop over particle numbers and thresholds."""
    rows = []
    for count in PARTICLES:
        results = flights(Case("stop", count), missions)
        rows += [(str(count), row(results, threshold_m)) for threshold_m in THRESHOLDS_M]
    return "The paper's case: x and y are unknown, the sensor is Gaussian.\n\n" + table("N", rows)


LATER_THRESHOLDS_M = (0.3, 0.5, 0.9)
"""ζ of the other tables."""


def section_sensors(missions: int) -> str:
    """The stop with each sensor model."""
    rows = []
    for name, sensor in (("threshold", Threshold()), ("hits", Hits())):
        results = flights(Case(name, thresholds_m=LATER_THRESHOLDS_M, sensor=sensor), missions)
        rows += [(f"{name}, N 1,000", row(results, threshold_m)) for threshold_m in LATER_THRESHOLDS_M]
    words = (
        "The Gaussian sensor is in the table above. `threshold`: 0 below 0.5 g/m³, and 30% of readings missed (0).\n"
        "`hits`: Poisson counts with a mean of 3 hits per g/m³ plus 0.1 background hits."
    )
    return words + "\n\n" + table("sensor", rows)


def section_unknowns(missions: int) -> str:
    """The stop with more unknowns; NEES of the location, and NEES of all unknowns."""
    rows, means = [], []
    for count in (1000, 4000):
        for name, case in (
            ("q", Case("q", count, (0.3, 0.5, 0.9), priors={"q": Uniform(100.0, 500.0)})),
            ("all eight", Case("all eight", count, (0.5, 0.9), all_eight=True)),
        ):
            slow = case.all_eight and count > 1000
            results = flights(case, missions // 4 if slow else missions)
            for threshold_m in case.thresholds_m:
                rows.append((f"{name}, N {count:,}", row(results, threshold_m)))
                nees = np.array([flight.stops[threshold_m].nees_all for flight in results if threshold_m in flight.stops])
                means.append(f"| {name}, N {count:,} | {threshold_m:g} | {statistic(nees)} |")
    words = (
        "`q`: x, y and the rate are unknown, q ~ U(100, 500). `all eight`: x, y, z ~ U(0, 5) m (the flight is at 5 m),\n"
        "q ~ gamma(2, 150), wind speed and direction with errors N(0, 0.5 m/s) and N(0, 10°), d ~ U(1, 8), τ ~ U(5, 20).\n"
        "The truth is drawn from these priors."
    )
    both = "| unknown | ζ, m | mean NEES of all unknowns |\n|---|---|---|\n" + "\n".join(means)
    honest = "For an honest posterior the mean NEES of all unknowns is 3 with q unknown and 8 with all eight:"
    return f"{words}\n\n{table('unknown', rows)}\n\n{honest}\n\n{both}"


def zero(_step: int, _gas: float, _before: float) -> float:
    """Stuck at zero from the start."""
    return 0.0


def three(_step: int, _gas: float, _before: float) -> float:
    """Stuck at 3 g/m³ from the start."""
    return 3.0


def frozen(step: int, gas: float, before: float) -> float:
    """Stuck at its last value from reading 10 on."""
    return gas if step <= 10 else before


def hum(step: int, _gas: float, _before: float) -> float:
    """Stuck at 1 g/m³, plus electronic noise of 0.2 g/m³."""
    return 1.0 + 0.2 * float(keyed(step, "hum").standard_normal())


def doubled(_step: int, gas: float, _before: float) -> float:
    """Reports twice the true value."""
    return 2.0 * gas


def section_faults(missions: int) -> str:
    """The stop with broken sensors."""
    rows = []
    for fault in (zero, three, frozen, hum, doubled):
        results = flights(Case(fault.__name__, thresholds_m=LATER_THRESHOLDS_M, fault=fault), missions)
        warned = share(sum(flight.warned for flight in results), len(results))
        name = f"{(fault.__doc__ or '').rstrip('.').lower()}; warned in {warned}%"
        rows += [(name, row(results, threshold_m)) for threshold_m in LATER_THRESHOLDS_M]
    words = (
        "N 1,000. No stop is declared before the third reading, or while readings do not fit the model (p < 1e-4, or the last three equal)."
    )
    return words + "\n\n" + table("fault", rows)


def harsh(seed: int) -> tuple[Scenario, list[tuple[float, float]]]:
    """A scenario from a wider distribution than Table 1, and a straight path to its source from nearby or far away."""
    rng = keyed(seed, "harsh")
    x, y = rng.uniform(0, AREA_M, 2).tolist()
    q, d = np.exp(rng.uniform(np.log([50, 0.2]), np.log([5000, 8]))).tolist()
    u, phi, tau = rng.uniform([0, 0, 2], [6, 2 * math.pi, 30]).tolist()
    bearing, distance = rng.uniform(0, 2 * math.pi), rng.choice([0.0, 0.3, 2.0, AREA_M])
    begin = np.clip([x + distance * math.cos(bearing), y + distance * math.sin(bearing)], 0, AREA_M)
    path = np.concatenate([np.linspace(begin, (x, y), 2 + int(math.dist(begin, (x, y)))), np.full((5, 2), (x, y))])
    places = [(a, b) for a, b in path.astype(np.float32).astype(float).clip(0, AREA_M).tolist()]
    return Scenario(source=(x, y), q=q, u=u, phi=phi, d=d, tau=tau, start=places[0]), places


def survive(seed: int) -> tuple[bool, float]:
    """Fly one harsh mission; returns True if its posterior stayed sound, and its greatest NEES."""
    s, places = harsh(seed)
    config = Config(1000, 0.5, derived_seed(seed, "estimator"), s.q, s.d, s.tau)
    world, posterior = World(s, seed), prior(config)
    sound, greatest = True, 0.0
    for step, place in enumerate(places):
        posterior = assimilate(posterior, Reading(step, place, ALTITUDE_M, world.wind, world.gas(place, step)), config)
        inside = bool((posterior.particles >= 0).all() and (posterior.particles <= AREA_M).all())  # NaN is not inside
        sound = sound and inside and bool(np.isfinite(posterior.log_targets).all()) and posterior.weights.max() == 1.0
        mean, covariance = moments(posterior.particles, posterior.weights)
        greatest = max(greatest, squared_error(mean - np.array(s.source), covariance))
    return sound, greatest


def section_harsh(missions: int) -> str:
    """Ten times as many missions, chosen to make the filter collapse."""
    with closing(as_flown(survive, range(FIRST_SEED, FIRST_SEED + 10 * missions), WORKERS)) as flown:
        results = [result for _, result in flown]
    beyond = sum(nees > 50 for _, nees in results)
    return (
        "N 1,000. q is log-uniform from 50 to 5,000 g/s, d log-uniform from 0.2 to 8 m²/s, u from 0 to 6 m/s, τ from 2 to 30 s.\n"
        "The path goes straight to the source from 0, 0.3, 2 or 30 m, and takes five readings there.\n\n"
        "| missions | unsound: NaN, zero weights, particles outside | NEES ever above 50 | of missions, % | greatest NEES |\n"
        "|---|---|---|---|---|\n"
        f"| {len(results)} | {sum(not sound for sound, _ in results)} | {beyond} | {share(beyond, len(results))} | "
        f"{max(nees for _, nees in results):.0f} |"
    )


SECTIONS: dict[str, tuple[str, Callable[[int], str]]] = {
    "stop": ("The stop", section_stop),
    "sensors": ("Sensors", section_sensors),
    "unknowns": ("More unknowns", section_unknowns),
    "faults": ("Broken sensors", section_faults),
    "harsh": ("Harsh missions", section_harsh),
}
"""Heading and writer of each section of the page, by name."""

HEAD = """# Reliability of the stop

Made by `python benchmarks/calibration.py`. Scenarios are the test seeds (1,000,000 and up); the policy is infotaxis with a budget of 300
steps. *located*: the error is at most 1 m, as a share of ceased. *false stop*: ceased but not located, as a share of ceased. *NEES*:
normalised estimation error squared at the stop; its mean is 2 for an honest posterior over x and y. Brackets hold 95% intervals: Wilson
for shares, bootstrap for the rest. One flight serves all thresholds: for each ζ it stops when its spread first is below ζ.
"""


def main() -> int:
    """Fly the chosen sections and write their tables into the page; the other sections stay."""
    parser = argparse.ArgumentParser(description="Write the tables of docs/calibration.md.")
    parser.add_argument("--only", choices=SECTIONS, action="append", help="section to fly, may be repeated (default: all)")
    parser.add_argument("--missions", type=int, default=1000, help="missions in each case (default: %(default)s)")
    args = parser.parse_args()
    texts = {}
    if DOCUMENT.exists():
        parts = DOCUMENT.read_text().split("\n## ")[1:]
        texts = {name: part for name, (title, _) in SECTIONS.items() for part in parts if part.startswith(title + "\n")}
    for name in args.only or SECTIONS:
        title, write = SECTIONS[name]
        try:
            texts[name] = f"{title}\n\n{write(args.missions)}\n"
        except WorkerLost as error:
            print(f"error: {error}; the sections before `{name}` are written; use --only to fly the others", file=sys.stderr)
            return cli.FAILED
        with whole(DOCUMENT) as page:
            page.write_text(HEAD + "".join(f"\n## {texts[name].rstrip()}\n" for name in SECTIONS if name in texts))
    return 0


if __name__ == "__main__":
    cli.run(main)
