"""What observations are computed from, beside particles: the facts of a belief, and the site of a search."""

import numpy as np

from plume.elementary import Array
from plume.problem import SOURCES, Area, Problem

# The fields of a belief (`link.bus.messages.Belief`) that are used beside its particles; columns of arrays
# (B, 13).
FACTS = (
    "x",
    "y",
    "gas",
    "mean_x",
    "mean_y",
    "xx",
    "xy",
    "yy",
    "wind_x",
    "wind_y",
    "rate",
    "diffusivity",
    "lifetime",
)
X, Y, GAS, MEAN_X, MEAN_Y, XX, XY, YY, WIND_X, WIND_Y, RATE, DIFFUSIVITY, LIFETIME = range(len(FACTS))

SITE = 9  # numbers of a site: `site_of`

# Unknowns beside x and y that an observation may use, each in a row of the particles.
ROWS = ("q", "d", "tau", "wind-direction", "wind-speed", "noise", "cv")


def site_of(problem: Problem) -> Array:
    """Return what the kernels know of a problem, (9,): the ends of its area and of its prior, and its step.

    Ends are west, south, east and north, m. In Table 1's problem the prior's are those of Table 1's square.
    """
    expected = SOURCES if problem.sources == SOURCES else problem.expected
    return site_in(problem.area, problem.step_m, expected)


def site_in(area: Area, step_m: float, expected: Area | None = None) -> Array:
    """Return the same for an area, and by default with sources expected anywhere in it."""
    expected = expected or area
    return np.array([*area.low, *area.high, *expected.low, *expected.high, step_m], np.float64)
