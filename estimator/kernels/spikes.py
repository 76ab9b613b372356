"""Spikes: readings that say nothing of the source. How they are distributed, whatever the hypothesis.

A spike has either sign and any size: the probability that it exceeds z is √(s/(s + z)), where s is SIZE
standard deviations of the noise in clean air. A threshold sensor reads 0 where a spike is below its
threshold, a count is never negative, and a metal oxide's spikes are around its reading in clean air.
"""

import math

from plume.compiled import subroutine
from plume.elementary import Array
from plume.parameters import CLEAN, HITS_KIND, SATURATION, THRESHOLD_KIND

SIZE = 10.0


@subroutine
def _exceeds(size: float, sensor: Array) -> float:
    """Probability that a spike is greater than a size, whatever its sign."""
    scale = SIZE * (math.sqrt(sensor[2]) if sensor[0] == HITS_KIND else sensor[2])
    return math.sqrt(scale / (scale + size))


@subroutine
def spike_density(gas: float, sensor: Array) -> float:
    """Density of a spike of this value; its probability if it is a count, at saturation, or not shown."""
    if sensor[0] == HITS_KIND:
        return _exceeds(gas, sensor) - _exceeds(gas + 1, sensor)
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return spike_distribution(sensor[3], sensor)
    if gas >= sensor[SATURATION]:
        return 1 - spike_distribution(gas, sensor)
    scale, size = SIZE * sensor[2], abs(gas - sensor[CLEAN])
    return float(0.25 * _exceeds(size, sensor) / (scale + size))


@subroutine
def spike_distribution(gas: float, sensor: Array) -> float:
    """Probability of a spike of at most this value, or count of -1 or more."""
    if sensor[0] == HITS_KIND:
        return 1 - _exceeds(gas + 1, sensor)
    half = 0.5 * _exceeds(abs(gas - sensor[CLEAN]), sensor)
    return 1 - half if gas > sensor[CLEAN] else half


@subroutine
def spike_rank(gas: float, sensor: Array, chance: float) -> float:
    """Rank of a value among spikes; `chance` in (0, 1) breaks ties, as in `predictive_rank`."""
    if sensor[0] == HITS_KIND:
        below = spike_distribution(gas - 1, sensor)
        return below + chance * (spike_distribution(gas, sensor) - below)
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return chance * spike_distribution(sensor[3], sensor)
    below = spike_distribution(gas, sensor)
    return below + chance * (1 - below) if gas >= sensor[SATURATION] else below
