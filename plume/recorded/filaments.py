"""The gas of GADEN's filaments at a place, as a compiled loop."""

import math

from plume.compiled import kernel, subroutine
from plume.elementary import Array
from plume.numerics import exp
from plume.recorded.space import FREE, Cells

REACH = 3.0  # a filament counts within so many σ
CUBE = math.sqrt(8.0) * math.pi * math.sqrt(math.pi)  # sqrt(8 π³)


@subroutine
def cell_of(coordinate: float, low: float, side: float, count: int) -> int:
    """The number of the cell along one axis, −1 outside."""
    position = (coordinate - low) / side
    return int(position) if 0.0 <= position < count else -1


@subroutine
def is_free(cells: Cells, x: float, y: float, z: float, low: Array, side: float) -> bool:
    """Whether a place is in the air."""
    i = cell_of(x, low[0], side, cells.shape[2])
    j = cell_of(y, low[1], side, cells.shape[1])
    k = cell_of(z, low[2], side, cells.shape[0])
    return bool(i >= 0 and j >= 0 and k >= 0 and cells[k, j, i] == FREE)


@kernel(
    "void(float64[:, ::1], float64[:, ::1], uint8[:, :, ::1], float64[::1], float64, float64, float64[::1])"
)
def moles_at(
    places: Array, filaments: Array, cells: Cells, low: Array, side: float, moles: float, out: Array
) -> None:
    """Fill `out` (M,) with the moles of gas in a cm³ at places (M, 3).

    As in GADEN: the gas of a filament is a Gaussian with its σ, and counts within REACH σ and in line of
    sight, which is tested once a cell on the way.  filaments: (N, 4) x, y, z in m, σ in cm.  moles: in each.
    """
    for m in range(len(places)):
        x, y, z = places[m, 0], places[m, 1], places[m, 2]
        total = 0.0
        if is_free(cells, x, y, z, low, side):
            for n in range(len(filaments)):
                dx, dy, dz = filaments[n, 0] - x, filaments[n, 1] - y, filaments[n, 2] - z
                sigma = filaments[n, 3]
                square = dx * dx + dy * dy + dz * dz
                reach = REACH * 0.01 * sigma
                if square >= reach * reach or not is_free(
                    cells, filaments[n, 0], filaments[n, 1], filaments[n, 2], low, side
                ):
                    continue
                steps = int(math.sqrt(square) / side)
                seen = True
                for step in range(1, steps):
                    part = step / steps
                    if not is_free(cells, x + part * dx, y + part * dy, z + part * dz, low, side):
                        seen = False
                        break
                if seen:
                    centre = moles / (CUBE * sigma * sigma * sigma)
                    total += centre * exp(-square * 10000.0 / (2.0 * sigma * sigma))
        out[m] = total
