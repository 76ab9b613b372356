"""Spikes: readings that say nothing of the source. How they are distributed, whatever the hypothesis.

A spike is no noise, and of any size: the probability that it exceeds z is 1/√(1 + (z/s)²), where s is
SIZE standard deviations of the noise in clean air. It goes up or down; for a sensor that shows nothing below
0, up. A threshold sensor reads 0 where a spike is below its threshold.
"""

import math

from plume.compiled import subroutine
from plume.elementary import Array
from plume.sensor import GAUSSIAN_KIND, HITS_KIND, THRESHOLD_KIND

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
    """Density of a spike of this value; its probability if that is a count, or 0 of a threshold sensor."""
    if sensor[0] == HITS_KIND:
        return _exceeds(gas, sensor) - _exceeds(gas + 1, sensor)
    if sensor[0] == THRESHOLD_KIND and gas == 0.0:
        return 1 - _exceeds(sensor[3], sensor)
    scale = _scale(sensor)
    ratio = abs(gas) / scale
    density = ratio * _exceeds(abs(gas), sensor) / (scale * (1 + ratio * ratio))
    return float(0.5 * density if sensor[0] == GAUSSIAN_KIND else density)


@subroutine
def spike_rank(gas: float, sensor: Array, chance: float) -> float:
    """Rank of a value among spikes; `chance` in (0, 1) breaks ties, as in `predictive_rank`."""
    if sensor[0] == GAUSSIAN_KIND:
        half = 0.5 * _exceeds(abs(gas), sensor)
        return 1 - half if gas > 0 else half
    if sensor[0] == HITS_KIND:
        return 1 - _exceeds(gas, sensor) + chance * spike_density(gas, sensor)
    return 1 - _exceeds(gas, sensor) if gas > 0 else chance * spike_density(gas, sensor)
