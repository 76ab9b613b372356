"""What a belief's weighted particles say of one unknown: quantiles and credible intervals."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from plume.elementary import Array

Interval95 = tuple[float, float]
SHARE = 0.95  # of a belief that its region or interval holds
ENDS = (0.5 - SHARE / 2, 0.5 + SHARE / 2)  # levels of the interval's ends


def quantiles(values: Array, weights: Array, levels: ArrayLike) -> list[float]:
    """Return the weighted quantiles of values (N,): the least value that each share of the weight reaches.

    weights: (N,) up to 1 each. They are rounded to so few bits that their sums are exact: sorts leave equal
    values in different orders on different processors.
    """
    order = np.argsort(values)
    reached = np.cumsum(np.rint(weights * (2.0**52 / len(weights)))[order])
    at: list[float] = values[order[np.searchsorted(reached, np.asarray(levels) * reached[-1])]].tolist()
    return at


def interval(name: str, unknowns: Sequence[str], particles: ArrayLike) -> Interval95 | None:
    """Return the central 95% interval of an unknown in a particle array (N, D + 1), weights last.

    None where it is no unknown of the belief.
    """
    if name not in unknowns:
        return None
    rows = np.asarray(particles, np.float64)
    weights = rows[:, -1]
    low, high = quantiles(rows[:, [*unknowns].index(name)], weights / weights.max(), ENDS)
    return low, high
