"""Spikes: readings that say nothing of the source. How they are distributed, whatever the hypothesis.

A spike has any size and either sign: it is log-uniform, over a million times the noise in clean air or a
million hits. A threshold sensor reads 0 where it is below the threshold.
"""

import math

from plume.compiled import subroutine
from plume.elementary import Array
from plume.numerics import log1p
from plume.parameters import HITS_KIND, THRESHOLD_KIND

LOG_RANGE = math.log(1e6)


@subroutine
def spike_density(gas: float, sensor: Array) -> float:
    """Density of a spike of this value; its probability if that is a count, or 0 of a threshold sensor."""
    if sensor[0] == HITS_KIND:
        return log1p(1 / (gas + 1)) / LOG_RANGE
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return spike_distribution(sensor[3], sensor)
    return float(0.5 / (LOG_RANGE * (sensor[2] + abs(gas))))


@subroutine
def spike_distribution(gas: float, sensor: Array) -> float:
    """Probability of a spike of at most this value, or count of -1 or more."""
    if sensor[0] == HITS_KIND:
        return min(log1p(gas + 1) / LOG_RANGE, 1.0)
    half = 0.5 * min(log1p(abs(gas) / sensor[2]) / LOG_RANGE, 1.0)
    return 0.5 + half if gas > 0 else 0.5 - half


@subroutine
def spike_rank(gas: float, sensor: Array, chance: float) -> float:
    """Rank of a value among spikes; `chance` in (0, 1) breaks ties, as in `predictive_rank`."""
    if sensor[0] == HITS_KIND:
        below = spike_distribution(gas - 1, sensor)
        return below + chance * (spike_distribution(gas, sensor) - below)
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return chance * spike_distribution(sensor[3], sensor)
    return spike_distribution(gas, sensor)
