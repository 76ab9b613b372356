"""The information floor: the shortest path on which an oracle that knows the source brings the posterior's
spread below ζ.

    python benchmarks/floor.py                              # the table of docs/floor.md, test seeds
    (1,000,000 and up) python benchmarks/floor.py --threshold 0.5 --fly        # also flies the paths with
    noisy readings and the filter python benchmarks/floor.py --missions 200 --convergence # the effect of
    more search effort

The distances of search policies are reported as multiples of this floor; docs/floor.md derives it.
"""
# mypy: allow-untyped-decorators

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.trials import floor
from agent.trials.figures import bootstrap
from agent.trials.floor import LEAST_THRESHOLD_M, PRIOR, best_path, information, model, spread_m, weight
from estimator.filter import Config, assimilate, prior
from estimator.kernels.weights import moments
from link.bus.mavlink import Reading
from plume.compiled import kernel
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import float32
from plume.randomness import derived_seed
from plume.scenario import AREA_M, BUDGET_STEPS, STEP_M, Scenario, draw
from plume.worlds.world import World

Array = NDArray[np.float64]

FIRST_SEED = 1_000_000
THRESHOLDS_M = (0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
ALTITUDE_M = 5.0
FLOWN_PARTICLES = 4000
THOROUGH = floor.Effort(refined=16)


@dataclass(frozen=True)
class Effort:
    """The search effort for both sides of the bracket."""

    paths: floor.Effort = THOROUGH
    sectors: int = 120
    """Cells around the source for the relaxation."""
    growth: float = 0.05
    """Depth of a ring of cells as a share of its inner radius, at most 0.1 m."""
    iterations: int = 40
    """Steps of the search for the relaxation's best W."""


@dataclass(frozen=True)
class Bracket:
    """The floor of one mission at one ζ lies from `lower_m` to `found_m`."""

    found_m: float
    """Length of the shortest path found, m; infinite if none is within the budget."""
    lower_m: float
    """Proven lower bound on the length of every path, m."""
    headings: tuple[float, ...]
    """The path found: one heading per step, rad."""


@kernel("float64[:, ::1](float64[::1], float64[::1], int64, float64)", error_model="numpy")
def _cells(start: Array, model: Array, sectors: int, growth: float) -> Array:
    """Cells around the source that cover the area, sorted by the first step that can reach each.

    Each row holds: that step; the greatest c in the cell; g on the cell's middle bearing at its inner and
    at its outer edge (x, y each); a bound on the deviation of g on its other bearings.
    """
    cells = []
    half_angle = math.pi / sectors
    drift = math.hypot(model[4], model[5])
    inner = 0.0
    while inner < math.sqrt(2) * AREA_M:
        core = inner == 0.0
        outer = SOURCE_RADIUS_M if core else inner + min(inner * growth, 0.1)
        middle = 0.5 * (inner + outer)
        half = (
            0.5 * (outer - inner) + outer * half_angle
        )  # greatest distance of the cell's points from its middle
        for sector in range(sectors):
            angle = (2 * sector + 1) * half_angle
            cos, sin = math.cos(angle), math.sin(angle)
            x, y = model[0] + middle * cos, model[1] + middle * sin
            if min(x, y) < -half or max(x, y) > AREA_M + half:
                continue
            step = max(math.ceil((math.hypot(x - start[0], y - start[1]) - half) / STEP_M), 1)
            # m falls with r on every bearing, because 1/λ > u/(2d), and is greatest on the most downwind
            # bearing.
            off_wind = abs(math.atan2(sin * model[4] - cos * model[5], cos * model[4] + sin * model[5]))
            along = -1.0 if core else math.cos(min(off_wind + half_angle, math.pi))
            radius = max(inner, SOURCE_RADIUS_M)
            c = weight(model[2] / radius * math.exp(-radius * (model[3] + drift * along)))
            near, far = (0.0, 0.0) if core else (1 / inner + model[3], 1 / outer + model[3])
            cells.append(
                (
                    step,
                    c,
                    near * cos + model[4],
                    near * sin + model[5],
                    far * cos + model[4],
                    far * sin + model[5],
                    near * half_angle,
                )
            )
        inner = outer
    table = np.array(cells)
    return table[np.argsort(table[:, 0])]


@kernel("boolean(int64, float64, float64[:, ::1], float64[::1], float64[::1], int64)", error_model="numpy")
def _excluded(steps: int, variance: float, cells: Array, start: Array, model: Array, iterations: int) -> bool:
    """True if it is proven that no path of `steps` steps has a covariance with a trace below `variance`,
    m².

    tr M⁻¹ ≥ 2 tr W − tr W M W for every symmetric W. The last term is a sum over the readings; each is at
    most the greatest value that is reachable at its step. W = M⁻¹, with M improved as by Frank and Wolfe
    (1956), makes this bound as large as possible.
    """
    c, g, h = information(start[0], start[1], model)
    base = PRIOR + c * g * g, c * g * h, PRIOR + c * h * h
    xx, xy, yy = base[0] + 1.0, base[1], base[2] + 1.0
    most, where = np.empty(steps + 1), np.empty(steps + 1, np.int64)
    for iteration in range(iterations):
        determinant = xx * yy - xy * xy
        wxx, wxy, wyy = yy / determinant, -xy / determinant, xx / determinant
        norm = 0.5 * (wxx + wyy) + math.hypot(0.5 * (wxx - wyy), wxy)
        most[:], where[:] = 0.0, -1
        for i in range(len(cells)):
            k = int(cells[i, 0])
            if k > steps:
                break
            near = math.hypot(wxx * cells[i, 2] + wxy * cells[i, 3], wxy * cells[i, 2] + wyy * cells[i, 3])
            far = math.hypot(wxx * cells[i, 4] + wxy * cells[i, 5], wxy * cells[i, 4] + wyy * cells[i, 5])
            value = cells[i, 1] * (max(near, far) + norm * cells[i, 6]) ** 2
            if value > most[k]:
                most[k], where[k] = value, i
        bound = (
            2 * (wxx + wyy)
            - base[0] * (wxx**2 + wxy**2)
            - 2 * base[1] * wxy * (wxx + wyy)
            - base[2] * (wxy**2 + wyy**2)
        )
        share = 2.0 / (iteration + 3)
        xx, xy, yy = xx + share * (base[0] - xx), xy + share * (base[1] - xy), yy + share * (base[2] - yy)
        for k in range(1, steps + 1):
            if most[k - 1] > most[k]:
                most[k], where[k] = most[k - 1], where[k - 1]
            bound -= most[k]
            if where[k] >= 0:
                c, g, h = cells[where[k], 1], cells[where[k], 2], cells[where[k], 3]
                xx, xy, yy = xx + share * c * g * g, xy + share * c * g * h, yy + share * c * h * h
        if bound >= variance:
            return True
    return False


def brackets(
    scenario: Scenario, thresholds_m: Sequence[float], effort: Effort = Effort(), budget: int = BUDGET_STEPS
) -> dict[float, Bracket]:
    """Bracket the floor at each ζ (m); the bracket of one ζ does not depend on the others."""
    start, parameters = np.array(scenario.start), model(scenario)
    cells = _cells(start, parameters, effort.sectors, effort.growth)
    result = {}
    lower = found = 0
    paths: dict[int, tuple[float, ...]] = {}
    for threshold_m in sorted(thresholds_m, reverse=True):  # a smaller ζ never needs fewer steps
        while lower <= budget and _excluded(
            lower, threshold_m**2, cells, start, parameters, effort.iterations
        ):
            lower += 1
        found = max(found, lower)
        while found <= budget:
            if found not in paths:
                paths[found] = best_path(scenario, found, effort.paths)
            if spread_m(scenario, paths[found]) < threshold_m:
                break
            found += 1
        reached = found <= budget
        result[threshold_m] = Bracket(
            found * STEP_M if reached else math.inf,
            lower * STEP_M if lower <= budget else math.inf,
            paths[found] if reached else (),
        )
    return result


def lower_m(scenario: Scenario, threshold_m: float, budget: int = BUDGET_STEPS) -> float:
    """Lower bound on the length of a path that brings the spread below ζ, m; infinite if it exceeds the
    budget.
    """
    return brackets(scenario, [threshold_m], budget=budget)[threshold_m].lower_m


def fly(seed: int, headings: Sequence[float], threshold_m: float) -> float:
    """Distance at which the filter's spread first is below ζ on a path with noisy readings, m; infinite if
    it never is.

    If the path ends earlier, the flight continues around the source on a triangle with sides of one step.
    """
    scenario = draw(seed)
    config = Config(
        FLOWN_PARTICLES, threshold_m, derived_seed(seed, "estimator"), scenario.q, scenario.d, scenario.tau
    )
    world, posterior = World(scenario, seed), prior(config)
    (x, y), (source_x, source_y) = scenario.start, scenario.source
    for step in range(BUDGET_STEPS + 1):
        position = float32(x), float32(y)
        reading = Reading(step, position, ALTITUDE_M, world.wind, world.gas(position, step))
        posterior = assimilate(posterior, reading, config)
        _, covariance = moments(posterior.particles, posterior.weights)
        if math.sqrt(np.trace(covariance)) < threshold_m:
            return step * STEP_M
        if step < len(headings):
            heading = headings[step]
        else:
            corner = math.atan2(y - source_y, x - source_x) + 2 * math.pi / 3
            radius = STEP_M / math.sqrt(3)
            heading = math.atan2(
                source_y + radius * math.sin(corner) - y, source_x + radius * math.cos(corner) - x
            )
        x, y = x + STEP_M * math.cos(heading), y + STEP_M * math.sin(heading)
    return math.inf


def straight(scenario: Scenario) -> list[float]:
    """Headings of the straight path to the source, rad, in whole steps."""
    (x, y), (source_x, source_y) = scenario.start, scenario.source
    return [math.atan2(source_y - y, source_x - x)] * int(math.dist(scenario.start, scenario.source) / STEP_M)


def figures(
    missions: int, thresholds_m: Sequence[float], flown: bool, effort: Effort = Effort()
) -> dict[float, dict[str, float]]:
    """One row of the table for each ζ: figures by name; means in m."""
    seeds = range(FIRST_SEED, FIRST_SEED + missions)
    scenarios = [draw(seed) for seed in seeds]
    bracketed = [brackets(scenario, thresholds_m, effort) for scenario in scenarios]
    rows = {}
    for threshold_m in thresholds_m:
        found = np.array([each[threshold_m].found_m for each in bracketed])
        row: dict[str, float] = {"missions": missions}
        row |= zip(("floor_m", "low_m", "high_m"), msgspec.structs.astuple(bootstrap(found)), strict=True)
        row["lower_bracket_m"] = float(np.mean([each[threshold_m].lower_m for each in bracketed]))
        row["source_m"] = float(np.mean([math.dist(s.start, s.source) for s in scenarios]))
        if flown:
            for name, paths in (
                ("flown", [each[threshold_m].headings for each in bracketed]),
                ("straight", [straight(scenario) for scenario in scenarios]),
            ):
                real = np.array(
                    [fly(seed, path, threshold_m) for seed, path in zip(seeds, paths, strict=True)]
                )
                reached = np.isfinite(real)
                row[f"{name}_reached"] = float(reached.mean())
                names = f"{name}_m", f"{name}_low_m", f"{name}_high_m"
                row |= zip(names, msgspec.structs.astuple(bootstrap(real[reached])), strict=True)
                row[f"{name}_before_floor"] = float((real < found).mean())
        rows[threshold_m] = row
    return rows


def table(rows: dict[float, dict[str, float]]) -> str:
    """The figures as Markdown tables: the floor, and the flown paths."""
    lines = ["| ζ, m | missions | floor, m | lower bracket, m | to the source, m |", "|---|---|---|---|---|"]
    for threshold_m, row in rows.items():
        floor = f"{row['floor_m']:.2f} [{row['low_m']:.2f}, {row['high_m']:.2f}]"
        lines.append(
            f"| {threshold_m:g} | {row['missions']} | {floor} | {row['lower_bracket_m']:.2f} | "
            f"{row['source_m']:.2f} |"
        )
    if all("flown_m" in row for row in rows.values()):
        lines += [
            "",
            "| ζ, m | path | reached, % | flown, m | before the floor, % |",
            "|---|---|---|---|---|",
        ]
        for threshold_m, row in rows.items():
            for name, words in (("flown", "the shortest found"), ("straight", "straight")):
                flown = f"{row[f'{name}_m']:.2f} [{row[f'{name}_low_m']:.2f}, {row[f'{name}_high_m']:.2f}]"
                reached, before = 100 * row[f"{name}_reached"], 100 * row[f"{name}_before_floor"]
                lines.append(f"| {threshold_m:g} | {words} | {reached:.1f} | {flown} | {before:.1f} |")
    return "\n".join(lines)


EFFORTS = {
    "4 paths refined, to 0.02 rad (as in `evaluate`)": Effort(floor.Effort()),
    "16 paths, to 0.02 rad; cells of 5%, 120 sectors (used here)": Effort(),
    "16 paths, to 0.005 rad": Effort(floor.Effort(refined=16, finest=0.005)),
    "64 paths, to 0.02 rad": Effort(floor.Effort(refined=64)),
    "64 paths from 41 bearings, to 0.005 rad; cells of 2%, 240 sectors": Effort(
        floor.Effort(41, 64, 0.005), 240, 0.02, 80
    ),
}
"""Rows of the convergence table."""


def convergence(missions: int, thresholds_m: Sequence[float]) -> str:
    """Mean floor and lower bracket with less and more effort, as a Markdown table."""
    heads = ["effort", *(f"ζ {threshold_m:g}: floor, lower bracket, m" for threshold_m in thresholds_m)]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for name, effort in EFFORTS.items():
        rows = figures(missions, thresholds_m, flown=False, effort=effort).values()
        cells = [f"{row['floor_m']:.3f}, {row['lower_bracket_m']:.3f}" for row in rows]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Print the chosen table."""
    parser = argparse.ArgumentParser(
        description="The shortest path that brings the spread below ζ, for an oracle that knows the source."
    )
    parser.add_argument(
        "--missions", type=int, default=1000, help="test seeds, from 1,000,000 (default: %(default)s)"
    )
    parser.add_argument(
        "--threshold", type=float, nargs="+", default=THRESHOLDS_M, help="ζ, m (default: %(default)s)"
    )
    parser.add_argument(
        "--fly", action="store_true", help="also fly the paths with noisy readings and the filter"
    )
    parser.add_argument(
        "--convergence", action="store_true", help="instead, print the results of less and more search effort"
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout; the table goes to stderr"
    )
    args = parser.parse_args()
    if args.missions < 1:
        parser.error(f"argument --missions: {args.missions} given; allowed is 1 and up")
    if min(args.threshold) < LEAST_THRESHOLD_M:
        parser.error(
            f"argument --threshold: {min(args.threshold):g} given; allowed is {LEAST_THRESHOLD_M:g} m and up"
        )
    if args.convergence:
        print(convergence(args.missions, args.threshold))
        return
    rows = figures(args.missions, args.threshold, args.fly)
    print(table(rows), file=sys.stderr if args.json else sys.stdout)
    if args.json:
        print(json.dumps({f"{threshold_m:g}": row for threshold_m, row in rows.items()}))


if __name__ == "__main__":
    main()
