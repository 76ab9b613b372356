"""The scenario of a seed, for Python."""

import os
from collections.abc import Mapping
from typing import Any

from plume import scenario
from plume.problem import PAPER, Problem
from plume.problems.names import named
from plume.problems.values import whole
from plume.randomness import MAX_SEED
from plume.scenario import Scenario


def draw(seed: int, problem: Problem | Mapping[str, Any] | str | os.PathLike[str] = PAPER) -> Scenario:
    """Draw a scenario of a problem, by default of the paper's training and test distribution (Table 1).

    Args:
        seed: A whole number from 0. The same seed gives the same scenario; test scenarios are the seeds
            from 1,000,000 on.
        problem: Where the source and the start are, and the release's distributions, as
            `plumeward.rollout` takes it.

    Returns:
        The release, the wind and the start of the search. It holds the true source.

    Raises:
        ValueError: The seed is not allowed, or the problem is not known.

    Examples:
        >>> x, y = plumeward.draw(7).source  # of mission 7, m
        >>> round(x, 2), round(y, 2)
        (23.31, 24.19)
    """
    return scenario.draw(whole("seed", seed, 0, MAX_SEED), named(problem))
