"""Sets of problems by name: training draws a problem of a set for each mission, by the mission's seed."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from plume.elementary import exp, log
from plume.problem import PARTS, Area, Problem
from plume.randomness import keyed
from plume.scenario import AREA_M, DIFFUSIVITIES, LIFETIME_S, RATES, WIND_SPEEDS

Draw = Callable[[int], Problem]  # the problem of a mission, by its seed

# Of `anywhere`: the side of a square as large as the area, m; its greatest aspect; the step as a part of the
# side; the lengths of Table 1's plumes, and its spread of 0.5 m at the stop, relative to the side.
SIDES_M = (20.0, 400.0)
ASPECT = 4.0
STEPS, USUAL_STEPS = (0.003, 0.1), (0.02, 0.05)
PLUMES = (0.5, 1.5)
STOPS = (0.5, 1.25)
SIDES_FLOWN = 10.0  # the budget: moves for so many sides, as in Table 1


def anywhere(seed: int) -> Problem:
    """Draw a problem: area, step, start, prior, plume and stop.

    Areas are rectangles of any aspect up to ASPECT. Half of the priors are the area, the others a rectangle
    in it of 0.3 to 1 of each side. Half of the missions start in the south-western sixth, the others
    anywhere. Three of four steps are USUAL_STEPS. Plumes are Table 1's with all lengths and times, at the
    same wind, times a number: then d grows as it, and q as its square.
    """
    rng = keyed(seed, "problem")

    def between(low: float, high: float) -> float:
        share = rng.random()
        return float(exp((1 - share) * log(low) + share * log(high)))

    side_m, aspect = between(*SIDES_M), between(1 / ASPECT, ASPECT)
    width_m, height_m = side_m * math.sqrt(aspect), side_m / math.sqrt(aspect)
    step_m = between(*USUAL_STEPS if rng.random() < 0.75 else STEPS) * side_m
    larger = side_m / AREA_M * between(*PLUMES)
    area = Area((0.0, 0.0), (width_m, height_m))
    step_m = min(step_m, min(area.size_m) / PARTS)
    prior = _part(rng, width_m, height_m) if rng.random() < 0.5 else None
    start = area if rng.random() < 0.5 else None
    return Problem(
        area=area,
        step_m=step_m,
        start=start,
        prior=prior,
        source=prior or area,
        q=_times(RATES, larger * larger),
        u=WIND_SPEEDS,
        d=_times(DIFFUSIVITIES, larger),
        tau=LIFETIME_S * larger,
        budget=math.ceil(SIDES_FLOWN * side_m / step_m),
        stop=f"spread:{0.5 * side_m / AREA_M * between(*STOPS):.6f}",
    )


def _part(rng: np.random.Generator, width_m: float, height_m: float) -> Area:
    """Draw a rectangle in an area."""
    shares, places = 0.3 + 0.7 * rng.random(2), rng.random(2)
    west, south = (1 - shares) * places * (width_m, height_m)
    east, north = west + shares[0] * width_m, south + shares[1] * height_m
    return Area((float(west), float(south)), (float(min(east, width_m)), float(min(north, height_m))))


def _times(span: tuple[float, float], factor: float) -> tuple[float, float]:
    return span[0] * factor, span[1] * factor


SETS: Mapping[str, Draw] = {"anywhere": anywhere}
