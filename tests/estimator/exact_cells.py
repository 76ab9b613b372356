"""The exact posterior of the source's position and a third unknown, on cells that follow its mass. It
shares no code with the filter.

The plume is derived as in exact.py. In gas of intermittency cv a reading is blank or inverse Gaussian gas
plus noise, whose density is a sum over the logarithm of the gas.
"""

import math
from collections.abc import Callable
from functools import lru_cache

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


def gas_density(gas: float, there: Array, std: Array, square: float | Array) -> Array:
    """Density of a reading: inverse Gaussian gas of these means (M,) and squared coefficients of variation,
    plus normal noise of these standard deviations.

    The trapezoid rule over x = ln(gas/mean), where the gas is within 9 standard deviations of the reading and
    its own density e^(−x/2 − (cosh x − 1)/S) is above about e^−50. At both ends the integrand vanishes, and so
    does the rule's error.
    """
    widest = np.arccosh(1 + 55 * square)
    with np.errstate(divide="ignore"):
        first = np.log(np.maximum(gas - 9 * std, 0.0) / there)
        last = np.log(np.maximum(gas + 9 * std, 1e-300) / there)
    first, last = np.clip(first, -widest, widest), np.clip(last, -widest, widest)
    x = first + (last - first) * np.linspace(0.0, 1.0, CELLS)[:, None]
    exponent = -0.5 * x - (np.cosh(x) - 1) / square - 0.5 * np.square((gas - there * np.exp(x)) / std)
    return np.asarray(np.exp(exponent).sum(axis=0) * (last - first) / (CELLS - 1)) / (
        2 * math.pi * np.sqrt(square) * std
    )


LOG_MEANS = np.linspace(math.log(1e-3), math.log(200.0), 110)
"""Nodes of the tables below; between them, cubic interpolation."""
CELLS = 400
"""Of the gas, at each node."""


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
    """Log-density of a reading at the means of LOG_MEANS, without its factor 1/√2π.

    The gas of readings that are not blank keeps the mean and the mean square of all. Its noise, 0.3 of it, has
    a variance for the gas's mean and one more for how far it varies; of the first a share is normal, and all
    else goes with the gas.
    """
    mean = np.exp(LOG_MEANS)
    blank = 0.4 * cv**2 / (1 + cv**2)
    there, own = mean / (1 - blank), (1 - blank) * (1 + cv**2) - 1
    normal = 0.09**2 / (0.09 + own)
    square = own + 0.09 * (1 + own) - normal
    silent = 0.09 * mean**2 + 0.04
    density = blank * np.exp(-0.5 * gas**2 / silent) / np.sqrt(silent)
    loud = gas_density(gas, there, np.sqrt(normal * there**2 + 0.04), square)
    return np.log(np.maximum(density + (1 - blank) * math.sqrt(2 * math.pi) * loud, 1e-300))


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
