"""The exact posterior of the source's position and a third unknown, on cells that follow its mass. It
shares no code with the filter.

The plume is derived as in exact.py. Gas of intermittency cv is cut into cells of concentration; each is
replaced by a normal variable of the same mass, mean and variance, so that a reading's density is a sum of
normal densities.
"""

import math
from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AREA_M = 30.0
UNEVEN = 0.02
"""Largest allowed difference in mass between cells of even and odd number along a dimension, as in
exact.py.
"""
CUT = 1e-8
"""A cell of less mass than this, relative to the greatest, is dropped."""
MOST_CELLS = 2_000_000


def plume_mean(
    x: Array,
    y: Array,
    at: tuple[float, float],
    wind_x: Array,
    wind_y: Array,
    release: tuple[float, float, float],
) -> Array:
    """Concentration at a place for sources at x, y: the screened point source of exact.py, in a wind of
    its own for each.
    """
    q, d, tau = release
    vx, vy = wind_x / (2 * d), wind_y / (2 * d)
    r = np.maximum(np.sqrt((at[0] - x) ** 2 + (at[1] - y) ** 2), 0.1)
    k = np.sqrt(vx**2 + vy**2 + 1 / (d * tau))
    return np.exp(-k * r - vx * (at[0] - x) - vy * (at[1] - y)) / r * (q / (4 * math.pi * d))


def normal_log_density(gas: float, mean: Array) -> Array:
    variance = 0.09 * mean * mean + 0.04
    return -0.5 * ((gas - mean) ** 2 / variance + np.log(variance))


@cache
def gas_cells(cv: float) -> tuple[Array, Array, Array]:
    """Mass, mean and variance of a gamma variable of mean 1 in cells: narrow ones where it is dense, none
    wider than the noise allows.
    """
    from scipy import special

    k = 1 / cv**2
    edges = np.concatenate([np.arange(0, 2, 0.1), np.arange(2, 60, 0.4), [1e9]])
    zeroth, first, second = (np.diff(special.gammainc(k + power, k * edges)) for power in (0, 1, 2))
    kept = zeroth > 1e-14
    mass = zeroth[kept]
    mean = first[kept] / mass
    return mass, mean, np.maximum(second[kept] * (1 + cv**2) / mass - mean**2, 0)


LOG_MEANS = np.linspace(math.log(1e-3), math.log(200.0), 110)
"""Nodes of the tables below; between them, cubic interpolation."""


def intermittent_log_density(gas: float, mean: Array, cv: Array) -> Array:
    """Log-density of a reading, by a table over the mean for each value that cv has."""
    step = LOG_MEANS[1] - LOG_MEANS[0]
    place = np.clip((np.log(np.maximum(mean, 1e-300)) - LOG_MEANS[0]) / step, 0, len(LOG_MEANS) - 1)
    cell = np.clip(place.astype(np.int64), 1, len(LOG_MEANS) - 3)
    s = place - cell
    values, which = np.unique(cv, return_inverse=True)
    table = np.concatenate([_log_densities(gas, value) for value in values.tolist()])
    cell += which * len(LOG_MEANS)
    before, here, after, beyond = (table[cell + offset] for offset in (-1, 0, 1, 2))
    inner = (s + 1) * (s - 2) / 2 * ((s - 1) * here - s * after)
    return np.asarray(inner + s * (s - 1) / 6 * ((s + 1) * beyond - (s - 2) * before))


@lru_cache(4096)
def _log_densities(gas: float, cv: float) -> Array:
    """Log-density of a reading at the means of LOG_MEANS."""
    mass, at, spread = gas_cells(cv)
    mean = np.exp(LOG_MEANS)[:, None]
    variance = 0.09 * mean**2 + 0.04 + mean**2 * spread
    density = (mass / np.sqrt(variance) * np.exp(-0.5 * (gas - mean * at) ** 2 / variance)).sum(axis=1)
    return np.log(np.maximum(density, 1e-300))


Likelihood = Callable[[Array, Array, Array, tuple[float, ...], tuple[float, float, float]], Array]
"""Log-likelihood of a reading (x, y, wind_x, wind_y, gas) for sources x, y and a third unknown, given (q,
d, τ).
"""


def with_wind_direction(
    x: Array, y: Array, degrees: Array, reading: tuple[float, ...], release: tuple[float, float, float]
) -> Array:
    at_x, at_y, wind_x, wind_y, gas = reading
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turned = wind_x * cosine - wind_y * sine, wind_x * sine + wind_y * cosine
    return normal_log_density(gas, plume_mean(x, y, (at_x, at_y), *turned, release))


def with_log_gain(
    x: Array, y: Array, log_gain: Array, reading: tuple[float, ...], release: tuple[float, float, float]
) -> Array:
    at_x, at_y, wind_x, wind_y, gas = reading
    return normal_log_density(
        gas, np.exp(log_gain) * plume_mean(x, y, (at_x, at_y), np.array(wind_x), np.array(wind_y), release)
    )


def with_cv(
    x: Array, y: Array, cv: Array, reading: tuple[float, ...], release: tuple[float, float, float]
) -> Array:
    at_x, at_y, wind_x, wind_y, gas = reading
    return intermittent_log_density(
        gas, plume_mean(x, y, (at_x, at_y), np.array(wind_x), np.array(wind_y), release), cv
    )


class CellPosterior:
    """The posterior given all readings so far: normal prior of the third unknown within `low` to `high`,
    place uniform over the area.
    """

    def __init__(
        self,
        likelihood: Likelihood,
        release: tuple[float, float, float],
        low: float,
        high: float,
        std: float,
        cells: tuple[int, int, int],
        uneven: float = UNEVEN,
    ) -> None:
        """`uneven`: as UNEVEN, of the third unknown. If its density ends abruptly, even and odd cells
        differ more than their sum errs.
        """
        self.likelihood, self.release, self.std, self.uneven = (
            likelihood,
            release,
            std,
            (UNEVEN, UNEVEN, uneven),
        )
        self.low = np.array([0.0, 0.0, low])
        self.size = np.array([AREA_M, AREA_M, high - low]) / cells
        self.readings: list[tuple[float, ...]] = []
        self.take(np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij")).reshape(3, -1))

    def add(self, reading: tuple[float, ...]) -> None:
        self.readings.append(reading)
        self.log_density += self.likelihood(*self.at, reading, self.release)
        self.settle()

    def take(self, numbers: NDArray[np.int64]) -> None:
        """Compute the log density at the middles of these cells (3, M)."""
        self.numbers = numbers
        self.at = self.low[:, None] + self.size[:, None] * (numbers + 0.5)
        self.log_density = -0.5 * (self.at[2] / self.std) ** 2
        for reading in self.readings:
            self.log_density += self.likelihood(*self.at, reading, self.release)

    def settle(self) -> None:
        """Drop cells without mass, and halve all cells along each dimension in which they do not resolve
        the posterior.
        """
        while True:
            kept = self.log_density > self.log_density.max() + math.log(CUT)
            self.numbers, self.at, self.log_density = (
                self.numbers[:, kept],
                self.at[:, kept],
                self.log_density[kept],
            )
            self.mass = np.exp(self.log_density - self.log_density.max())
            self.mass /= self.mass.sum()
            uneven = [
                abs(1 - 2 * self.mass[row % 2 == 0].sum()) > most
                for row, most in zip(self.numbers, self.uneven, strict=True)
            ]
            if not any(uneven):
                return
            numbers = self.numbers
            for dimension in np.flatnonzero(uneven):
                self.size[dimension] /= 2
                numbers = np.concatenate([numbers, numbers], axis=1)
                numbers[dimension] *= 2
                numbers[dimension, numbers.shape[1] // 2 :] += 1
            assert numbers.shape[1] < MOST_CELLS, "the posterior is too thin"
            self.take(numbers)

    def moments(self) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3)."""
        mean = self.at @ self.mass
        offsets = self.at - mean[:, None]
        return mean, (offsets * self.mass) @ offsets.T
