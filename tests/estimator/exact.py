"""The exact posterior of the source's position, on a grid that zooms in as the posterior shrinks. It
shares no code with the filter.

The plume is derived in other terms than in plume/dispersion.py: m = exp(-v·offset) g, with v = wind/(2d),
turns the steady equation of advection, diffusion and decay into Helmholtz's, ∇²g = k² g, k² = |v|² + 1/(d
τ), and around a point source g = q/(4π d) exp(-k r)/r.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AREA_M = 30.0
CELLS = 64
"""Initial number of cells along a side; doubled while they do not resolve the posterior."""
MOST_CELLS = 2048
UNEVEN = 0.02
"""Largest allowed mass difference between the four grids of every second cell. The full grid's error is
about the fourth power of theirs: that of a midpoint sum over a Gaussian falls as exp(-2 π² σ²/h²) with the
cell h."""
CUT = 1e-9
"""Mass that a zoom may leave outside. By Ville's inequality, later readings raise it to a share s with
probability at most CUT / s.
"""


def log_likelihood(x: Array, y: Array, reading: tuple[float, ...], q: float, d: float, tau: float) -> Array:
    """log N(gas; m, (0.3 m)² + 0.2²) up to a constant, for sources at x (n, 1) and y (1, n)."""
    at_x, at_y, wind_x, wind_y, gas = reading
    vx, vy = wind_x / (2 * d), wind_y / (2 * d)
    k = math.sqrt(vx**2 + vy**2 + 1 / (d * tau))
    r = np.maximum(np.sqrt((at_x - x) ** 2 + (at_y - y) ** 2), 0.1)
    mean = np.exp(-k * r - vx * (at_x - x) - vy * (at_y - y)) / r * (q / (4 * math.pi * d))
    variance = 0.09 * mean * mean + 0.04
    return -0.5 * ((gas - mean) ** 2 / variance + np.log(variance))


class GridPosterior:
    """Mean (2,), covariance (2, 2) and spread given all readings so far; the prior is uniform over the
    area.
    """

    def __init__(self, q: float, d: float, tau: float) -> None:
        self.plume = (q, d, tau)
        self.readings: list[tuple[float, ...]] = []
        self._evaluate((0.0, AREA_M), (0.0, AREA_M), CELLS)
        self._sum_up()

    def add(self, position: tuple[float, float], wind: tuple[float, float], gas: float) -> None:
        self.readings.append((*position, *wind, gas))
        self.log_density += log_likelihood(self.x, self.y, self.readings[-1], *self.plume)
        self._sum_up()

    def _evaluate(self, x_range: tuple[float, float], y_range: tuple[float, float], cells: int) -> None:
        """Compute the log density given all readings on a new grid."""
        self.ranges, self.cells = (x_range, y_range), cells
        middles = (np.arange(cells) + 0.5) / cells
        self.x = (x_range[0] + (x_range[1] - x_range[0]) * middles)[:, None]
        self.y = (y_range[0] + (y_range[1] - y_range[0]) * middles)[None, :]
        self.log_density = np.zeros((cells, cells))
        for reading in self.readings:
            self.log_density += log_likelihood(self.x, self.y, reading, *self.plume)

    def _sum_up(self) -> None:
        """Refine and zoom until the grid fits, then compute the moments."""
        while True:
            mass = np.exp(self.log_density - self.log_density.max())
            mass /= mass.sum()
            quarters = mass.reshape(self.cells // 2, 2, self.cells // 2, 2).sum(axis=(0, 2))
            if np.abs(4 * quarters - 1).max() > UNEVEN:
                assert self.cells < MOST_CELLS, "the posterior is too thin for any grid"
                self._evaluate(*self.ranges, 2 * self.cells)
                continue
            across_x, across_y = mass.sum(axis=1), mass.sum(axis=0)
            x_range, y_range = _holding(across_x, self.ranges[0]), _holding(across_y, self.ranges[1])
            if _size(x_range) * _size(y_range) > 0.5 * _size(self.ranges[0]) * _size(self.ranges[1]):
                break
            self._evaluate(x_range, y_range, CELLS)
        x, y = self.x[:, 0], self.y[0]
        self.mean = np.array([across_x @ x, across_y @ y])
        dx, dy = x - self.mean[0], y - self.mean[1]
        xy = dx @ mass @ dy
        self.covariance = np.array([[across_x @ dx**2, xy], [xy, across_y @ dy**2]])
        self.spread = math.sqrt(np.trace(self.covariance))


def _holding(mass: Array, whole: tuple[float, float]) -> tuple[float, float]:
    """The part of a range that holds all but CUT of the mass, plus one cell at either end."""
    tail = CUT / 4
    first = int(np.searchsorted(np.cumsum(mass), tail))
    last = len(mass) - int(np.searchsorted(np.cumsum(mass[::-1]), tail))
    cell = _size(whole) / len(mass)
    return whole[0] + max(first - 1, 0) * cell, whole[0] + min(last + 1, len(mass)) * cell


def _size(span: tuple[float, float]) -> float:
    return span[1] - span[0]
