"""The figures of a set of missions, each with its 95% interval (Wilson's for shares, bootstrap for means)."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from estimator.criterion import Criterion
from plume.elementary import Array, Indices
from plume.scenario import AS_MODELLED
from plume.sensors.names import GAUSSIAN, text

USUAL_SENSOR = text(GAUSSIAN)
RESAMPLES = 1000
LARGEST = 2_000_000  # values that the bootstrap draws at once, at most: a limit on memory
# By figure: heading in tables, scale and digits.
COLUMNS = {
    "ceased": ("ceased, %", 100.0, 1),
    "located": ("located, %", 100.0, 1),
    "outside": ("outside, %", 100.0, 1),
    "false_stop": ("false stop, %", 100.0, 1),
    "mtd_m": ("MTD, m", 1.0, 1),
    "mtd_floors": ("MTD, floors", 1.0, 2),
    "nees_mean": ("NEES", 1.0, 2),
    "search_time_s": ("ST, s", 1.0, 3),
    "stalls": ("stalls", 1.0, 2),
    "decision_ms": ("decision, ms", 1.0, 2),
    "update_ms": ("update, ms", 1.0, 2),
}
# The same of fleets, beside those.
OF_FLEETS = {"moves": ("moves", 1.0, 1), "mtd_vehicle_m": ("MTD of each, m", 1.0, 1)}
UNKNOWN = "–"


class MissionRow(msgspec.Struct, frozen=True):
    """The result of one mission: a row of the raw results.

    If it did not cease, its figures are those of its last step.
    """

    policy: str
    particles: int
    threshold_m: float | None  # ζ; None where the stop is another
    seed: int
    budget: int
    headings: int | None  # directions that a planner chooses from; None for a learned policy
    step_m: float
    # Hypothetical readings for each move; None for a learned policy, which uses none.
    measurements: int | None
    ceased: bool
    located: bool
    estimate_x: float
    estimate_y: float
    source_x: float
    source_y: float
    error_m: float
    spread_m: float
    nees: float  # normalised estimation error squared of the location
    steps: int
    distance_m: float
    # The information floor at ζ, the path of an oracle (docs/floor.md); None where it is not known.
    floor_m: float | None
    search_time_s: float
    decision_ms: float  # mean processor time of the agent for a decision
    update_ms: float  # mean processor time of the estimator for a reading
    # Older files lack this column and those below; their rows get these defaults.
    sensor: str = USUAL_SENSOR
    # The priors given, in the form of `--prior`, separated by spaces; None where there were none.
    prior: str | None = None
    stop_on: str = "location"
    assume: str = "paper"  # what the estimator took to be known
    stop: str = "spread"  # the stop criterion: spread, with `threshold_m`, or another in the form of `--stop`
    version: str | None = None  # version of Plumeward that flew it; None where the row does not say
    world: str = AS_MODELLED
    # Whether the estimator warned, at any reading up to this end, that a stop would not be honest; False in
    # older files.
    warned: bool = False
    margin_m: float = 0.0  # how far beyond the area's edges the source could be
    outside: bool = False  # the stop said that the source is outside the area, and that is not false
    # The problem, without what has a column of its own, in the form of --problem.
    problem: str = "paper"
    # Vehicles that searched together: `steps` are moves of each, `distance_m` is that of all.
    vehicles: int = 1
    start_from: str = "point"  # where they started, in the form of --from
    separation_m: float | None = None  # least distance between the ways of two vehicles; None of one alone
    # Readings after which the search was found to repeat itself; None in older files.
    stalls: int | None = None
    # Digest of the bundle, the plug-ins and the world's files that flew it; None without, and in older files.
    files: str | None = None

    @property
    def false_stop(self) -> bool:
        """Ceased with a false claim."""
        return self.ceased and not self.located and not self.outside

    @property
    def flight(self) -> tuple[str, int, int, str]:
        """(policy, particles, seed, world)."""
        return self.policy, self.particles, self.seed, self.world

    @property
    def criterion(self) -> str:
        """The stop criterion in the form of --stop."""
        return self.stop if self.threshold_m is None else Criterion(self.threshold_m).text


class Interval(msgspec.Struct, frozen=True):
    """A figure and its 95% interval."""

    value: float
    low: float
    high: float

    def text(self, scale: float, digits: int) -> str:
        """Return it as tables show it."""
        value, low, high = (f"{scale * end:.{digits}f}" for end in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}]"


def nees(
    estimate: tuple[float, float], source: tuple[float, float], covariance: tuple[float, float, float]
) -> float:
    """Normalised estimation error squared, eᵀ C⁻¹ e; covariance C: (xx, xy, yy) m².

    Of a C without width, that along its line alone.
    """
    (east, north), (xx, xy, yy) = (a - b for a, b in zip(estimate, source, strict=True)), covariance
    determinant, trace = xx * yy - xy * xy, xx + yy
    if determinant > 1e-15 * trace * trace:
        return (yy * east * east - 2 * xy * east * north + xx * north * north) / determinant
    return (xx * east * east + 2 * xy * east * north + yy * north * north) / (trace * trace) if trace else 0.0


def wilson(hits: int, of: int) -> Interval:
    """A share and its interval (Wilson 1927); NaN with the interval [0, 1] for `of` = 0."""
    if of == 0:
        return Interval(math.nan, 0.0, 1.0)
    z, p = 1.959964, hits / of
    middle = (p + z * z / (2 * of)) / (1 + z * z / of)
    half = z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of)) / (1 + z * z / of)
    return Interval(p, max(middle - half, 0.0), min(middle + half, 1.0))


def bootstrap(
    values: Array, statistic: Callable[[Array], Array] = lambda samples: np.asarray(samples.mean(axis=1))
) -> Interval:
    """A statistic of values (n, …), by default the mean, and its percentile interval; NaN for no values.

    `statistic` maps samples (R, n, …) to (R,).
    """
    if len(values) == 0:
        return Interval(math.nan, math.nan, math.nan)
    few = len(values) * RESAMPLES <= LARGEST
    again = np.concatenate([statistic(values[one]) for one in (_kept if few else _drawn)(len(values))])
    low, high = np.quantile(again, [0.025, 0.975])
    return Interval(float(statistic(values[None])[0]), float(low), float(high))


def _drawn(count: int) -> Iterator[Indices]:
    """Yield which of so many values are in each resample, some resamples (R, count) at once."""
    rng = np.random.default_rng(0)
    at_once = max(LARGEST // count, 1)
    for done in range(0, RESAMPLES, at_once):
        yield rng.integers(count, size=(min(at_once, RESAMPLES - done), count))


@lru_cache(maxsize=4)
def _kept(count: int) -> tuple[Indices, ...]:
    """All of `_drawn`: the figures of the same missions share it."""
    return tuple(_drawn(count))


def figures(rows: Sequence[MissionRow]) -> dict[str, Any]:
    """Figures of missions of one policy, one world, one number of particles and one stop criterion.

    `false_stop_warned` is the share of false stops that a warning preceded. Figures that no such mission
    defines are None.
    """
    ceased = [row for row in rows if row.ceased]
    wrong = [row for row in ceased if row.false_stop]

    def mean_of(name: str) -> Interval:
        return bootstrap(np.array([getattr(row, name) for row in ceased]))

    # The bootstrap draws distance and floor as pairs: both grow with the distance of the source.
    both = np.array([(row.distance_m, row.floor_m) for row in ceased if row.floor_m is not None]).reshape(
        -1, 2
    )

    intervals = {
        "ceased": wilson(len(ceased), len(rows)),
        "located": wilson(sum(row.located for row in ceased), len(rows)),
        "outside": wilson(sum(row.outside for row in ceased), len(rows)),
        "false_stop": wilson(len(wrong), len(ceased)),
        "false_stop_warned": wilson(sum(row.warned for row in wrong), len(wrong)),
        "mtd_m": mean_of("distance_m"),
        "mtd_vehicle_m": bootstrap(np.array([row.distance_m / row.vehicles for row in ceased])),
        "moves": mean_of("steps"),
        "floor_m": bootstrap(both[:, 1]),
        "mtd_floors": bootstrap(both, lambda pairs: pairs[..., 0].mean(axis=1) / pairs[..., 1].mean(axis=1)),
        "nees_mean": mean_of("nees"),
        "error_mean_m": mean_of("error_m"),
        "search_time_s": mean_of("search_time_s"),
        "stalls": bootstrap(np.array([row.stalls for row in rows if row.stalls is not None])),
        "decision_ms": bootstrap(np.array([row.decision_ms for row in rows])),
        "update_ms": bootstrap(np.array([row.update_ms for row in rows])),
    }
    first = rows[0]
    summary: dict[str, Any] = {
        "missions": len(rows),
        "particles": first.particles,
        "threshold_m": first.threshold_m,
        "world": first.world,
        "assume": first.assume,
        "stop": first.criterion,
        "vehicles": first.vehicles,
    }
    for name, interval in intervals.items():
        known = not math.isnan(interval.value)
        summary[name] = interval.value if known else None
        summary[f"{name}_interval"] = [interval.low, interval.high] if known else None
    return summary


def cell(said: dict[str, Any], key: str) -> str:
    """Return a figure with its interval as tables show it."""
    if said[key] is None:
        return UNKNOWN
    _, scale, digits = (COLUMNS | OF_FLEETS)[key]
    return Interval(said[key], *said[f"{key}_interval"]).text(scale, digits)
