"""Random numbers keyed by (seed, step, stage, stream): SplitMix64 sequences with random access."""

import math

import numpy as np

from plume.compiled import subroutine
from plume.numerics import direction, exp, log

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_ONE = np.uint64(0xBF58476D1CE4E5B9)
MIX_TWO = np.uint64(0x94D049BB133111EB)


@subroutine
def mix(word: np.uint64) -> np.uint64:
    """SplitMix64's finaliser (Steele et al. 2014)."""
    word = (word ^ (word >> np.uint64(30))) * MIX_ONE
    word = (word ^ (word >> np.uint64(27))) * MIX_TWO
    return word ^ (word >> np.uint64(31))


@subroutine
def key_of(seed: int, step: int, stage: int, stream: int) -> np.uint64:
    """Return the start of the SplitMix64 sequence of one (seed, step, stage, stream)."""
    word = mix(seed + GOLDEN)
    word = mix(word ^ (np.uint64(step) + np.uint64(1)) * GOLDEN)
    return mix(word ^ (np.uint64(stage * 1024 + stream) + np.uint64(1)) * GOLDEN)


@subroutine
def word_at(key: np.uint64, index: int) -> np.uint64:
    """Draw number `index` of a sequence: 64 bits."""
    return mix(key + (np.uint64(index) + np.uint64(1)) * GOLDEN)


@subroutine
def uniform(key: np.uint64, index: int) -> float:
    """Draw number `index` of a sequence, uniform in (0, 1)."""
    return (float(word_at(key, index) >> np.uint64(12)) + 0.5) * 2.0**-52


@subroutine
def normals(key: np.uint64, index: int) -> tuple[float, float]:
    """Draw a pair of N(0, 1) from numbers `index` and `index` + 1 of a sequence, by Box and Muller."""
    radius = math.sqrt(-2.0 * log(uniform(key, index)))
    cosine, sine = direction(uniform(key, index + 1))
    return radius * cosine, radius * sine


@subroutine
def poisson(key: np.uint64, index: int, expected: float) -> int:
    """Draw a Poisson number of this mean, below 700, from number `index` of a sequence, by inversion."""
    chance = uniform(key, index)
    share, count = exp(-expected), 0
    total = share
    while chance > total and share > 0.0:
        count += 1
        share *= expected / count
        total += share
    return count
