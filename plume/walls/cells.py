"""The cells of the ground: which are built on, and how high.

All else in this room sees buildings as columns of cells, so that wind, puffs and lines of sight agree.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plume.elementary import Array
from plume.walls.buildings import Building, Buildings, outline

Mask = NDArray[np.bool_]

CELL_M = 0.5
MARGIN_M = 20.0  # least and greatest distance from the buildings to the grid's edge
MOST_MARGIN_M = 40.0
FREE = -math.inf  # top of a cell without a building


class Cells(NamedTuple):
    """Columns of cells around all buildings."""

    west: float  # x of the grid's edge, m
    south: float  # y of the grid's edge, m
    tops: Array  # (nx, ny) z of the roof above the search plane, m; FREE where nothing stands
    levels: Array  # (L,) the different tops, ascending


def cells_of(found: Buildings) -> Cells:
    """Return the cells around buildings."""
    if not found.buildings:
        return Cells(0.0, 0.0, np.full((1, 1), FREE), np.empty(0))
    corners = np.vstack([outline(building) for building in found.buildings])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = min(max(float((high - low).max()), MARGIN_M), MOST_MARGIN_M)
    west, south = (np.floor((low - margin) / CELL_M) * CELL_M).tolist()
    nx, ny = np.ceil((high + margin - (west, south)) / CELL_M).astype(np.int64).tolist()
    tops = np.full((nx, ny), FREE)
    for building in found.buildings:
        covered = covered_by(building, west, south, nx, ny)
        tops[covered] = np.maximum(tops[covered], building.height - found.altitude)
    return Cells(west, south, tops, np.unique(tops[tops > FREE]))


def covered_by(building: Building, west: float, south: float, nx: int, ny: int) -> Mask:
    """Return which cells (nx, ny) a footprint covers: those whose centres it holds.

    Where it passes between two centres, it covers the cell of the first, so that a thin wall has no holes.
    """
    corners = (outline(building) - (west, south)) / CELL_M - 0.5  # in cells, centres at whole numbers
    covered = np.zeros((nx, ny), bool)
    _fill(corners, covered)
    _fill(corners[:, ::-1], covered.T)
    return covered


def _fill(corners: Array, covered: Mask) -> None:
    """Mark what lies between the 1st and 2nd, 3rd and 4th … crossing of the outline with each line y = j."""
    (x1, y1), (x2, y2) = corners.T, np.roll(corners, -1, axis=0).T
    for j in range(covered.shape[1]):
        cut = (y1 <= j) != (y2 <= j)
        slope = (x2[cut] - x1[cut]) / (y2[cut] - y1[cut])
        crossings = np.sort(x1[cut] + (j - y1[cut]) * slope)
        for begin, end in zip(crossings[::2].tolist(), crossings[1::2].tolist(), strict=True):
            first, last = math.ceil(begin), math.ceil(end) - 1
            if last < first:
                first = last = math.floor(begin)
            covered[first : last + 1, j] = True
