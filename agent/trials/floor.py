"""The information floor of a mission: how far an oracle flies before the spread can be below ζ.

docs/floor.md derives it. It uses the true source, so it may judge missions but not plan them.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from plume.compiled import kernel
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array
from plume.numerics import angle_of, cosine_and_sine, exp
from plume.scenario import AREA_M, BUDGET_STEPS, STEP_M, Scenario
from plume.sensors.names import GAUSSIAN

LEAST_THRESHOLD_M = 0.03  # below this ζ the computation takes long, and the floor may exceed the budget
# α² and β²: the variance of a reading is SLOPE m² + FLOOR.
SLOPE, FLOOR = (
    GAUSSIAN.sensor_noise * GAUSSIAN.sensor_noise,
    GAUSSIAN.environment_noise * GAUSSIAN.environment_noise,
)
# Precision of the prior for each axis, 1/m²: that of the Gaussian with the covariance of the uniform prior.
PRIOR = 12 / (AREA_M * AREA_M)
# (rad per step, number of last steps): the bends that a path may end with after a straight beginning.
BENDS = np.array(
    [
        (0.0, 1.0),
        *(
            (sign * rate, last)
            for sign in (-1, 1)
            for rate in (0.15, 0.3, 0.6, 1.2, 2.0)
            for last in (2, 4, 8, 16)
        ),
    ]
)


@dataclass(frozen=True)
class Effort:
    """How thoroughly the shortest path is searched for."""

    # Number of first bearings tried, spaced evenly within 1 rad of the bearing to the source.
    bearings: int = 21
    refined: int = 4  # number of the best paths that are refined
    finest: float = 0.02  # the refinement ends when no larger change of a heading helps, rad


@kernel("float64(float64)", error_model="numpy")
def weight(mean: float) -> float:
    """Fisher information of a reading about log m: m²/σ² (1 + 2 α⁴ m²/σ²); it grows with m to 1/α² + 2."""
    relative = mean * mean / (SLOPE * mean * mean + FLOOR)
    return relative * (1 + 2 * SLOPE * SLOPE * relative)


@kernel("Tuple((float64, float64, float64))(float64, float64, float64[::1])", error_model="numpy")
def information(x: float, y: float, model: Array) -> tuple[float, float, float]:
    """Fisher information c g gᵀ of a reading at (x, y) about the source's location, as (c, g_x, g_y).

    g = grad log m, 1/m.
    """
    dx, dy = x - model[0], y - model[1]
    distance = math.sqrt(dx * dx + dy * dy)
    radius = max(distance, SOURCE_RADIUS_M)
    mean = model[2] / radius * exp(-radius * model[3] - (dx * model[4] + dy * model[5]))
    radial = (1 / radius + model[3]) / radius if distance > SOURCE_RADIUS_M else 0.0
    return weight(mean), radial * dx + model[4], radial * dy + model[5]


@kernel("float64(float64[::1], float64[::1], float64[::1])", error_model="numpy")
def _variance(headings: Array, start: Array, model: Array) -> float:
    """Trace of the covariance after a path, m²; infinite where the path leaves the area."""
    x, y = start[0], start[1]
    c, g, h = information(x, y, model)
    xx, xy, yy = PRIOR + c * g * g, c * g * h, PRIOR + c * h * h
    for heading in headings:
        cosine, sine = cosine_and_sine(heading)
        x += STEP_M * cosine
        y += STEP_M * sine
        if not (0 <= x <= AREA_M and 0 <= y <= AREA_M):
            return math.inf
        c, g, h = information(x, y, model)
        xx += c * g * g
        xy += c * g * h
        yy += c * h * h
    return (xx + yy) / (xx * yy - xy * xy)


@kernel("float64(float64[::1], float64[::1], float64[::1], float64)", error_model="numpy")
def _refine(headings: Array, start: Array, model: Array, finest: float) -> float:
    """Compass search, in place: turn the path after a step, or shift one waypoint, while that helps.

    Then the change is halved.
    """
    steps = len(headings)
    best = _variance(headings, start, model)
    tried = headings.copy()
    change = 0.4
    while change > finest:
        before = best
        for move in range(4 * steps):
            first, shifts, turn = move // 4, move % 2 == 1, change if move % 4 < 2 else -change
            tried[:] = headings
            if shifts:
                tried[first] += turn
                if first + 1 < steps:
                    tried[first + 1] -= turn
            else:
                tried[first:] += turn
            variance = _variance(tried, start, model)
            if variance < best * (1 - 1e-4):
                best = variance
                headings[:] = tried
        if best == before:
            change *= 0.5
    return best


@kernel(
    "float64[::1](int64, float64[::1], float64[::1], float64[:, ::1], int64, int64, float64)",
    error_model="numpy",
)
def _best_headings(
    steps: int, start: Array, model: Array, bends: Array, bearings: int, refined: int, finest: float
) -> Array:
    """Headings of the best path found with this number of steps: the best of a family, refined."""
    towards = angle_of(model[0] - start[0], model[1] - start[1])
    family = np.empty((bearings * len(bends), steps))
    variances = np.empty(len(family))
    for i in range(len(family)):
        rate, last = bends[i % len(bends)]
        bearing = towards - 1 + 2 * (i // len(bends)) / (bearings - 1)
        for k in range(steps):
            family[i, k] = bearing + rate * max(k + 1 - steps + last, 0)
        variances[i] = _variance(family[i], start, model)
    order = np.argsort(variances)
    best = math.inf
    result: Array = family[order[0]]
    for i in order[:refined]:
        headings = family[i].copy()
        variance = _refine(headings, start, model, finest)
        if variance < best:
            best, result = variance, headings
    return result


def model(scenario: Scenario) -> Array:
    """(6,): source x and y, q/(4π d), 1/λ, wind_x/(2d), wind_y/(2d)."""
    s = scenario
    if s.height != 0.0:
        raise ValueError(
            f"height {s.height:g} m is not allowed; wanted 0: the floor is defined for a source in the "
            "search plane"
        )
    inverse_length = math.sqrt((1 + s.u * s.u * s.tau / (4 * s.d)) / (s.d * s.tau))
    east, north = s.wind
    return np.array(
        [*s.source, s.q / (4 * math.pi * s.d), inverse_length, east / (2 * s.d), north / (2 * s.d)]
    )


def spread_m(scenario: Scenario, headings: Sequence[float]) -> float:
    """Spread after 1 m steps on these headings, rad, from the start, m; infinite outside the area."""
    return math.sqrt(_variance(np.array(headings, np.float64), np.array(scenario.start), model(scenario)))


def best_path(scenario: Scenario, steps: int, effort: Effort = Effort()) -> tuple[float, ...]:
    """Headings, rad, of the path found with this number of steps that leaves the least spread."""
    start, parameters = np.array(scenario.start), model(scenario)
    return tuple(_best_headings(steps, start, parameters, BENDS, *astuple(effort)).tolist())


def floors_m(
    scenario: Scenario, thresholds_m: Sequence[float], budget: int = BUDGET_STEPS
) -> dict[float, float]:
    """Length of the shortest path found after which the spread can be below each ζ, m.

    It is infinite where it exceeds the budget.
    """
    # Usually close to the answer.
    steps = min(int(math.dist(scenario.start, scenario.source) / STEP_M), budget)
    result: dict[float, float] = {}
    for threshold_m in sorted(thresholds_m, reverse=True):  # a smaller ζ needs at least as many steps

        def reaches(steps: int, threshold_m: float = threshold_m) -> bool:
            return spread_m(scenario, best_path(scenario, steps)) < threshold_m

        while not result and steps > 0 and reaches(steps - 1):
            steps -= 1
        while steps <= budget and not reaches(steps):
            steps += 1
        result[threshold_m] = steps * STEP_M if steps <= budget else math.inf
    return result
