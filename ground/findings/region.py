"""The 95% region of a source: the ellipse of its covariance, and the contour of the belief's particles; and
how much wider a stop's is than the belief's own.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from link.bus.messages import Belief, Particles
from plume.outcome import width_of_few_puffs
from scene.scene import ellipse

Array = NDArray[np.float64]
CHI2_95 = 5.991464547107979  # of two degrees of freedom: -2 log 0.05
POINTS = 72  # of the ellipse's outline
CELLS = 161  # of the contour's grid, along a side
REACH = 6.0  # half its side, in standard deviations
LEAST_M = 1e-3  # a narrower belief has no contour
# A stop's region by the belief's own, in area: this times the coefficient of variation of the gas near the
# source. docs/findings.md has how it was chosen and what it holds; beyond these scales it was not tried.
AREA_BY_CV = 1.5
LEAST_SCALE, GREATEST_SCALE = 0.5, 2.0


class Ellipse95(NamedTuple):
    """The ellipse that holds 95% of a Gaussian with the belief's covariance."""

    centre: tuple[float, float]  # m
    longer_m: float  # half axes
    shorter_m: float
    angle: float  # of the longer one, rad, counter-clockwise from east

    @property
    def outline(self) -> Array:
        """(POINTS + 1, 2) m, counter-clockwise, the first point again at the end."""
        turn = np.linspace(0.0, 2 * math.pi, POINTS + 1)
        along, across = self.longer_m * np.cos(turn), self.shorter_m * np.sin(turn)
        cosine, sine = math.cos(self.angle), math.sin(self.angle)
        outline = np.stack(
            [
                self.centre[0] + cosine * along - sine * across,
                self.centre[1] + sine * along + cosine * across,
            ],
            axis=1,
        )
        outline[-1] = outline[0]
        return outline

    @property
    def bearing_deg(self) -> float:
        """Direction of the longer axis, degrees clockwise from north, 0 to 180."""
        return (90.0 - math.degrees(self.angle)) % 180.0


def ellipse_95(
    mean: tuple[float, float], covariance: tuple[float, float, float], scale: float = 1.0
) -> Ellipse95:
    """Return the 95% ellipse of a mean, m, and a covariance (xx, xy, yy), m²; its axes times `scale`."""
    longer, shorter, angle = ellipse(covariance)
    scale *= math.sqrt(CHI2_95) / 2.0
    return Ellipse95(mean, scale * longer, scale * shorter, angle)


def scale_of(last: Belief) -> float:
    """Return how much wider the 95% region is than the belief's own; 1 if the search did not stop.

    The filter takes readings for independent, and its priors allow for more errors than there mostly are. So
    a stop's belief is too wide where the gas is steady, and too narrow where it comes and goes, and the more
    so the fewer its puffs are.
    """
    if not last.ceased or "downwind" not in last.intermittency:
        return 1.0
    _, cv, _ = last.intermittency["downwind"]
    scale = math.sqrt(AREA_BY_CV * cv) * width_of_few_puffs(last.intermittency)
    return min(max(scale, LEAST_SCALE), GREATEST_SCALE)


class Contour95(NamedTuple):
    """The smallest region that holds 95% of the particles' weight: a density, and its level.

    The density is that of the particles, each spread by a Gaussian (Scott 1992), on a grid in coordinates in
    which their covariance is the unit matrix.
    """

    mean: Array  # (2,) m
    root: Array  # (2, 2): from the grid's coordinates to m
    density: Array  # (CELLS, CELLS), by the first coordinate, then the second
    level: float

    def contains(self, place: tuple[float, float]) -> bool:
        """Whether a place, (x, y) m, lies in the region."""
        return bool(self._at(np.array([place]))[0] >= self.level)

    def _at(self, places: Array) -> Array:
        return _sampled(self.density, _white(self.root, places - self.mean))

    @property
    def rings(self) -> list[Array]:
        """Its outlines, each (K, 2) m, the first point again at the end.

        Outer ones run counter-clockwise, holes clockwise.
        """
        step = 2 * REACH / (CELLS - 1)
        rings = [ring * step - REACH for ring in _rings(self.density, self.level)]
        return [ring @ self.root.T + self.mean for ring in rings]


def contour_95(places: Array, weights: Array, scale: float = 1.0) -> Contour95 | None:
    """Return the 95% contour of particles at places (N, 2) m with weights (N,); None on a line.

    Distances from the particles' mean are those times `scale`.
    """
    weights = np.asarray(weights, np.float64) / np.sum(weights, dtype=np.float64)
    mean: Array = weights @ places
    offsets: Array = scale * (places - mean)
    covariance = (weights[:, None] * offsets).T @ offsets
    if np.linalg.eigvalsh(covariance)[0] < LEAST_M * LEAST_M:
        return None
    root = np.asarray(np.linalg.cholesky(covariance), np.float64)
    white = _white(root, offsets)
    effective = 1.0 / float(np.square(weights).sum())
    density: Array = _smoothed(_binned(white, weights), effective ** (-1.0 / 6.0))
    at = _sampled(density, white)
    order = np.argsort(-at, kind="stable")
    held = np.searchsorted(np.cumsum(weights[order]), 0.95)
    level = float(at[order[min(int(held), len(order) - 1)]])
    return Contour95(mean, root, density, level) if level > 0 else None


def places_of(
    particles: Particles, unknowns: tuple[str, ...], mean: tuple[float, float]
) -> tuple[Array, Array]:
    """Return the particles' places (N, 2) m and weights (N,); a known x or y is the estimate's own."""
    rows = np.asarray(particles, np.float64)
    columns = [
        rows[:, unknowns.index(name)] if name in unknowns else np.full(len(rows), known)
        for name, known in zip("xy", mean, strict=True)
    ]
    return np.stack(columns, axis=1), rows[:, -1]


def _grid(white: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the cells (N, 2) that places lie in, and where in them, 0 to 1."""
    at = np.clip((white + REACH) * ((CELLS - 1) / (2 * REACH)), 0.0, CELLS - 1 - 1e-9)
    cells = at.astype(np.int64)
    return cells, at - cells


def _white(root: Array, offsets: Array) -> Array:
    """Return offsets (N, 2) m in the grid's coordinates."""
    return np.asarray(np.linalg.solve(root, offsets.T).T, np.float64)


def _binned(white: Array, weights: Array) -> Array:
    """Return the weight of each node of the grid; a particle's goes to the four around it."""
    cells, within = _grid(white)
    grid = np.zeros((CELLS, CELLS))
    for i in (0, 1):
        for j in (0, 1):
            share = np.abs(1 - i - within[:, 0]) * np.abs(1 - j - within[:, 1])
            np.add.at(grid, (cells[:, 0] + i, cells[:, 1] + j), weights * share)
    return grid


def _smoothed(grid: Array, width: float) -> Array:
    step = 2 * REACH / (CELLS - 1)
    offsets = np.subtract.outer(np.arange(CELLS), np.arange(CELLS)) * (step / width)
    kernel = np.exp(-0.5 * np.square(offsets))
    smooth: Array = kernel @ grid @ kernel
    smooth[[0, -1]] = smooth[:, [0, -1]] = 0.0  # so that every outline is closed
    return smooth


def _sampled(density: Array, white: Array) -> Array:
    """Return the density at places, linear between the grid's nodes; 0 beyond it."""
    (cells, within), result = _grid(white), np.zeros(len(white))
    for i in (0, 1):
        for j in (0, 1):
            share = np.abs(1 - i - within[:, 0]) * np.abs(1 - j - within[:, 1])
            result += share * density[cells[:, 0] + i, cells[:, 1] + j]
    return np.where((np.abs(white) <= REACH).all(axis=1), result, 0.0)


def _rings(density: Array, level: float) -> list[Array]:
    """Return the outlines of density ≥ level in units of cells, by marching squares.

    What is above the level lies to the left of each outline.
    """
    ahead: dict[tuple[int, int, int], tuple[int, int, int]] = {}
    above = density >= level
    mixed = above[:-1, :-1].astype(int) + above[1:, :-1] + above[1:, 1:] + above[:-1, 1:]
    for i, j in np.argwhere((mixed > 0) & (mixed < 4)).tolist():
        corners = above[i, j], above[i + 1, j], above[i + 1, j + 1], above[i, j + 1]
        edges = (i, j, 0), (i + 1, j, 1), (i, j + 1, 0), (i, j, 1)  # the first node of each, and its axis
        # Counter-clockwise around a cell the region is left at an edge from above to below.
        leaves = [k for k in range(4) if corners[k] and not corners[(k + 1) % 4]]
        enters = [k for k in range(4) if not corners[k] and corners[(k + 1) % 4]]
        for leave in leaves:
            nearest = (leave + 3) % 4  # with two pairs the corners that are above stay apart
            ahead[edges[leave]] = edges[nearest if nearest in enters else enters[0]]
    rings = []
    while ahead:
        first = next(iter(ahead))
        ring, at = [first], ahead.pop(first)
        while at != first:
            ring.append(at)
            at = ahead.pop(at)
        rings.append(_crossings([*ring, first], density, level))
    return rings


def _crossings(edges: list[tuple[int, int, int]], density: Array, level: float) -> Array:
    result = np.empty((len(edges), 2))
    for number, (i, j, axis) in enumerate(edges):
        a, b = density[i, j], density[i + 1, j] if axis == 0 else density[i, j + 1]
        along = float((level - a) / (b - a)) if b != a else 0.5
        result[number] = (i + along, j) if axis == 0 else (i, j + along)
    return result
