"""Spikes: readings that say nothing of the source. How they are distributed, whatever the hypothesis.

A spike is no noise, and of any size: the probability that it exceeds z is 1/√(1 + (z/s)²), where s is
SIZE standard deviations of the noise in clean air. It goes up or down; for a sensor that shows nothing below
0, up. A threshold sensor reads 0 where a spike is below its threshold, and a metal oxide's spikes are around
its reading in clean air.
"""

import math

from plume.compiled import subroutine
from plume.elementary import Array
from plume.parameters import CLEAN, GAUSSIAN_KIND, HITS_KIND, SATURATION, THRESHOLD_KIND

SIZE = 7.0


@subroutine
def _scale(sensor: Array) -> float:
    return SIZE * (math.sqrt(sensor[2]) if sensor[0] == HITS_KIND else sensor[2])


@subroutine
def _exceeds(size: float, sensor: Array) -> float:
    """Probability that a spike is greater than a size, whatever its sign."""
    ratio = size / _scale(sensor)
    return 1 / math.sqrt(1 + ratio * ratio)


@subroutine
def spike_density(gas: float, sensor: Array) -> float:
    """Density of a spike of this value.

    Its probability if that is a count, 0 of a threshold sensor, or saturation.
    """
    if sensor[0] == HITS_KIND:
        return _exceeds(gas, sensor) - _exceeds(gas + 1, sensor)
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return 1 - _exceeds(sensor[3], sensor)
    scale, size = _scale(sensor), abs(gas - sensor[CLEAN])
    sides = 0.5 if sensor[0] == GAUSSIAN_KIND else 1.0
    if gas >= sensor[SATURATION]:
        return sides * _exceeds(size, sensor)
    ratio = size / scale
    return float(sides * (ratio * _exceeds(size, sensor) / (scale * (1 + ratio * ratio))))


@subroutine
def spike_rank(gas: float, sensor: Array, chance: float) -> float:
    """Rank of a value among spikes; `chance` in (0, 1) breaks ties, as in `predictive_rank`."""
    if sensor[0] == GAUSSIAN_KIND:
        half = 0.5 * _exceeds(abs(gas - sensor[CLEAN]), sensor)
        if gas >= sensor[SATURATION]:
            return 1 - half + chance * half
        return 1 - half if gas > sensor[CLEAN] else half
    if sensor[0] == HITS_KIND:
        return 1 - _exceeds(gas, sensor) + chance * spike_density(gas, sensor)
    return 1 - _exceeds(gas, sensor) if gas > 0 else chance * spike_density(gas, sensor)
