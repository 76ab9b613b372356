"""The scenarios that missions are flown in: the paper's Table 1, drawn by seed."""

import math
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from plume.elementary import direction
from plume.randomness import keyed, uniform

if TYPE_CHECKING:
    from plume.problem import Problem

AREA_M = 30.0  # side of the square search area [0, AREA_M]², m
SOURCE_LOW_M, SOURCE_HIGH_M = 10.0, 25.0  # Table 1 draws the source's x and y from this range, m
STEP_M = 1.0  # length of one move, m
SEPARATION_M = 3.0  # least distance between the ways of two vehicles that search together, m
BUDGET_STEPS = 300  # most moves of a mission; the paper states no budget
# A stop counts as located if the estimate is this close to the source, m; the paper states none.
SUCCESS_RADIUS_M = 1.0
# A stop claims that the source is outside the area if at least this share of the belief is.
SURE_OUTSIDE = 0.95
# In gas that comes and goes neighbouring readings are alike: their correlation counts as this share of the
# coefficient of variation, up to the second number. docs/trust.md has the searches that chose them.
ALIKE, MOST_ALIKE = 0.5, 0.4
INCOMPATIBLE = 1e-4  # below this p-value the readings do not fit the model: there is no stop
AS_MODELLED = "as-modelled"  # the world that matches what the estimator assumes
# τ, s. Table 1 states none; the paper's illustration has 10 s.
LIFETIME_S = 10.0
# Table 1's uniform distributions: q, g/s; u, m/s; φ, rad; d, m²/s.
SOURCE, START = (SOURCE_LOW_M, SOURCE_HIGH_M), (0.0, 5.0)  # of x and y, m
RATES, WIND_SPEEDS, WIND_FROM, DIFFUSIVITIES = (100.0, 500.0), (1.0, 4.0), (0.0, math.tau), (1.0, 8.0)
# Least and greatest of the source's x and y, q, u, φ, d, and the start's x and y.
TABLE_1 = tuple(
    np.array(
        [each[end] for each in (*[SOURCE] * 2, RATES, WIND_SPEEDS, WIND_FROM, DIFFUSIVITIES, *[START] * 2)]
    )
    for end in (0, 1)
)


class WorldError(ValueError):
    """A world could not be asked, or said what no air can say; the text is one line."""


class NoRelease(ValueError):
    """In this world gas cannot leave where the source is, as inside a building; elsewhere it can."""


class BrokenFile(WorldError):
    """A file of one of our worlds is wrong or cut off; the text is one line."""


class Scenario(msgspec.Struct, frozen=True, omit_defaults=True):
    """One gas release. It holds the true source: never give it to code that estimates or plans.

    Examples:
        >>> it = plumeward.Scenario((12.0, 15.0), q=250.0, u=2.0, phi=0.0, d=3.0, tau=10.0, start=(1.0, 2.0))
        >>> it.wind  # 2 m/s from the east
        (2.0, 0.0)
    """

    source: tuple[float, float]  # (x, y) m, x east, y north
    q: float  # release rate, g/s
    u: float  # wind speed, m/s
    phi: float  # direction the wind comes from, rad, counter-clockwise from +x
    d: float  # effective diffusivity, m²/s
    tau: float  # lifetime of the gas, s
    start: tuple[float, float]  # where the search begins, m
    height: float = 0.0  # height of the source above the search plane, m
    second: tuple[float, float] | None = None  # another source like it, (x, y) m

    @property
    def wind(self) -> tuple[float, float]:
        """(u cos φ, u sin φ), m/s: points to where the wind comes from; the air moves the other way."""
        cosine, sine = direction(self.phi / math.tau)
        return self.u * float(cosine), self.u * float(sine)

    def nearest(self, place: tuple[float, float]) -> tuple[float, float]:
        """Return the source that is nearest to a place, (x, y) m: a find may be of either."""
        return nearest(place, self.source, self.second)


def stretch(cv: float) -> float:
    """Return how many times wider than a belief its errors may be, since neighbouring readings are alike.

    Gas that comes in gusts can stay above or below its mean for several readings. The filter takes them
    for independent. Then T readings are worth T (1 − ρ) / (1 + ρ), where ρ is the correlation of
    neighbours (Bayley and Hammersley 1946), and the errors grow by the root of its inverse. Too few readings
    of a search are in the gas to measure ρ: it follows from the coefficient of variation that the belief
    expects, `cv`. The result is 1 for gas that is steady.
    """
    correlation = min(ALIKE * max(cv, 0.0), MOST_ALIKE)  # a belief from elsewhere may say anything
    return math.sqrt((1 + correlation) / (1 - correlation))


def nearest(
    place: tuple[float, float], source: tuple[float, float], second: tuple[float, float] | None
) -> tuple[float, float]:
    """Return the one of two sources, if there are two, that is nearest to a place, (x, y) m."""
    return second if second and math.dist(place, second) < math.dist(place, source) else source


def draw(seed: int, problem: "Problem | None" = None) -> Scenario:
    """Draw a scenario of a problem, by default of the paper's training and test distribution (Table 1).

    The same seed, a whole number from 0 to `MAX_SEED`, gives the same scenario.
    """
    low, high = problem.spans if problem else TABLE_1
    x, y, q, u, phi, d, start_x, start_y = uniform(keyed(seed, "scenario"), low, high).tolist()
    tau = problem.tau if problem else LIFETIME_S
    if isinstance(tau, tuple):
        shortest, longest = tau
        tau = shortest + (longest - shortest) * keyed(seed, "lifetime").random()
    source, start = (x, y), (start_x, start_y)
    if problem:
        source, start = problem.allowed(seed, source, start)
    return Scenario(source=source, q=q, u=u, phi=phi, d=d, tau=tau, start=start)
