"""The gas of GADEN's filaments at a place, and what lies between the values of cells, as compiled loops.

Places are in cells: cell (i, j, k) reaches from (i, j, k) to (i + 1, j + 1, k + 1).
"""

import math

import numpy as np
from numpy.typing import NDArray

from plume.compiled import kernel, subroutine
from plume.elementary import Array
from plume.numerics import exp
from plume.recorded.space import FREE, Cells

REACH = 3.0  # a filament counts within so many σ
CUBE = math.sqrt(8.0) * math.pi * math.sqrt(math.pi)  # sqrt(8 π³)
Numbers = NDArray[np.float32]


@subroutine
def is_free(cells: Cells, x: float, y: float, z: float) -> bool:
    """Whether a place is in the air."""
    depth, rows, columns = cells.shape
    if not (0.0 <= x < columns and 0.0 <= y < rows and 0.0 <= z < depth):
        return False
    return bool(cells[int(z), int(y), int(x)] == FREE)


def prepared(filaments: Array, low: Array, side: float, moles: float) -> Array:
    """Return filaments (N, 6) as `moles_at` takes them: x, y, z, reach², 1/(2 σ²) in cells; the centre's gas.

    filaments: (N, 4) x, y, z in m, σ in cm.  moles: in each.  The gas is in mol/cm³.
    """
    sigma = filaments[:, 3]
    wide = 0.01 * sigma / side
    rows = np.empty((len(filaments), 6))
    rows[:, :3] = (filaments[:, :3] - low) / side
    rows[:, 3] = REACH * REACH * wide * wide
    rows[:, 4] = 0.5 / (wide * wide)
    rows[:, 5] = moles / (CUBE * sigma * sigma * sigma)
    return rows


@kernel("void(float64[:, ::1], float64[:, ::1], uint8[:, :, ::1], float64[::1])")
def moles_at(places: Array, filaments: Array, cells: Cells, out: Array) -> None:
    """Fill `out` (M,) with the moles of gas in a cm³ at places (M, 3).

    As in GADEN 3: the gas of a filament is a Gaussian, and counts within REACH σ and in line of sight, which
    is tested once a cell on the way.
    """
    for m in range(len(places)):
        x, y, z = places[m, 0], places[m, 1], places[m, 2]
        total = 0.0
        if is_free(cells, x, y, z):
            for n in range(len(filaments)):
                dx, dy, dz = filaments[n, 0] - x, filaments[n, 1] - y, filaments[n, 2] - z
                square = dx * dx + dy * dy + dz * dz
                if square >= filaments[n, 3]:
                    continue
                if not is_free(cells, filaments[n, 0], filaments[n, 1], filaments[n, 2]):
                    continue
                steps = int(math.sqrt(square))
                seen = True
                for step in range(1, steps):
                    part = step / steps
                    if not is_free(cells, x + part * dx, y + part * dy, z + part * dz):
                        seen = False
                        break
                if seen:
                    total += filaments[n, 5] * exp(-square * filaments[n, 4])
        out[m] = total


@kernel("void(float64[:, ::1], float32[:, :, :, ::1], float64[:, ::1], uint8[::1])")
def among_cells(places: Array, values: Numbers, out: Array, inside: NDArray[np.uint8]) -> None:
    """Fill `out` (M, N) with what lies linearly between the centres of cells, whose values are (z, y, x, N).

    Beyond the outermost centres, those count.  inside: (M,) is 1 in the cells, 0 outside, where `out` is 0.
    """
    depth, rows, columns, count = values.shape
    for m in range(len(places)):
        x, y, z = places[m, 0], places[m, 1], places[m, 2]
        within = 0.0 <= x <= columns and 0.0 <= y <= rows and 0.0 <= z <= depth
        inside[m] = within
        if not within:
            out[m] = 0.0
            continue
        x = min(max(x - 0.5, 0.0), columns - 1.0)
        y = min(max(y - 0.5, 0.0), rows - 1.0)
        z = min(max(z - 0.5, 0.0), depth - 1.0)
        i, j, k = int(x), int(y), int(z)
        right, back, up = min(i + 1, columns - 1), min(j + 1, rows - 1), min(k + 1, depth - 1)
        x, y, z = x - i, y - j, z - k
        for n in range(count):
            a = values[k, j, i, n] * (1.0 - x) + values[k, j, right, n] * x
            b = values[k, back, i, n] * (1.0 - x) + values[k, back, right, n] * x
            c = values[up, j, i, n] * (1.0 - x) + values[up, j, right, n] * x
            d = values[up, back, i, n] * (1.0 - x) + values[up, back, right, n] * x
            out[m, n] = (a * (1.0 - y) + b * y) * (1.0 - z) + (c * (1.0 - y) + d * y) * z
