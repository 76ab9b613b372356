"""The wind around buildings: the mass-consistent potential flow u = u₀ + ∇φ on their cells.

At a height z the air flows around all buildings that are higher than z, and around no others: levels do not
exchange air, as where the air is stably stratified (Hunt and Snyder 1980). So each level is a flow in the
plane. On its cells (a MAC grid) no air is made or lost in any, none goes through a wall, and at the edge of
the grid it is the given wind that blows in and out. That is a Poisson equation for φ, ∇²φ = −∇·u₀ with
∂φ/∂n = −u₀·n at walls (Sherman 1978), and linear in the wind: the flows of two unit winds give all others.
"""

import math
from functools import lru_cache

import numpy as np

from plume.compiled import kernel
from plume.elementary import Array
from plume.numerics import dot
from plume.walls.buildings import Buildings
from plume.walls.cells import Cells, Mask, cells_of

# Last index of a flow: the speed at the faces of a cell, to the east and north positive. First of a unit wind
# that blows east, then of one that blows north.
WEST, EAST, SOUTH, NORTH, PER_WIND = 0, 1, 2, 3, 4
RESIDUAL = 1e-12  # of the root of the sum of squared divergences, in cells and unit winds
MOST_ITERATIONS = 20_000
MODIFIED, SAFE = 0.99, 0.25  # of the preconditioner


@lru_cache(16)
def flow_around(found: Buildings) -> tuple[Cells, Array]:
    """Return the cells of buildings and the flow (L, nx, ny, 8) between them, one below each level."""
    cells = cells_of(found)
    flow = np.zeros((len(cells.levels), *cells.tops.shape, 2 * PER_WIND))
    for number, level in enumerate(cells.levels.tolist()):
        free = cells.tops < level
        flow[number, :, :, :PER_WIND] = unit_flow(free)
        turned = unit_flow(free.T).transpose(1, 0, 2)
        flow[number, :, :, PER_WIND:] = turned[:, :, [SOUTH, NORTH, WEST, EAST]]
    return cells, flow


def unit_flow(free: Mask) -> Array:
    """Return the speed (nx, ny, 4) at the faces of cells (nx, ny) in a wind of 1 that blows east."""
    nx, ny = free.shape
    padded = np.zeros((nx + 2, ny + 2))
    padded[1:-1, 1:-1] = free
    phi = potential(padded)
    around = np.pad(free, 1, constant_values=True)  # the air goes on beyond the edge
    flow = np.zeros((nx, ny, PER_WIND))
    there = phi[1:-1, 1:-1]
    flow[1:, :, WEST] = 1.0 + (there[1:] - there[:-1])
    flow[0, :, WEST] = flow[-1, :, EAST] = 1.0
    flow[:-1, :, EAST] = flow[1:, :, WEST]
    flow[:, 1:, SOUTH] = there[:, 1:] - there[:, :-1]
    flow[:, :-1, NORTH] = flow[:, 1:, SOUTH]
    for face, beyond in (
        (WEST, around[:-2, 1:-1]),
        (EAST, around[2:, 1:-1]),
        (SOUTH, around[1:-1, :-2]),
        (NORTH, around[1:-1, 2:]),
    ):
        flow[:, :, face] *= free & beyond
    return flow


@kernel("float64[:, ::1](float64[:, ::1])")
def potential(free: Array) -> Array:
    """Solve for φ, in cells, of a unit wind that blows east, by conjugate gradients.

    free: (nx + 2, ny + 2), 1 where air can be; 0 in the frame around, which the wind blows through.
    Each free cell: Σ over free neighbours (φ − φ') = (1 if air can leave to the east) − (… to the west).
    The preconditioner is the modified incomplete Cholesky factor (Gustafsson 1978), as in Bridson's "Fluid
    Simulation for Computer Graphics".
    """
    rows, columns = free.shape
    size = rows * columns
    first, last = columns + 1, size - columns - 1
    is_free = free.copy().reshape(size)
    degree, x, r, q, z = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    inverse, to_west, to_south = np.zeros(size), np.zeros(size), np.zeros(size)  # of the factor
    for k in range(first, last):
        east = is_free[k + columns] if k + columns < size - columns else 1.0
        west = is_free[k - columns] if k - columns >= columns else 1.0
        degree[k] = is_free[k - 1] + is_free[k + 1] + is_free[k - columns] + is_free[k + columns]
        r[k] = is_free[k] * (east - west)
        if is_free[k] == 1.0 and degree[k] > 0.0:
            w, s = inverse[k - columns], inverse[k - 1]
            lost = w * w * (1.0 + MODIFIED * is_free[k - columns + 1])
            lost += s * s * (1.0 + MODIFIED * is_free[k - 1 + columns])
            rest = degree[k] - lost
            inverse[k] = 1.0 / math.sqrt(rest if rest > SAFE * degree[k] else degree[k])
            to_west[k], to_south[k] = inverse[k] * w, inverse[k] * s
    p = np.zeros(size)
    aligned = 1.0
    for _ in range(MOST_ITERATIONS):
        if math.sqrt(dot(r, r)) <= RESIDUAL:
            break
        for k in range(first, last):
            q[k] = r[k] * inverse[k] + to_west[k] * q[k - columns] + to_south[k] * q[k - 1]
        for k in range(last - 1, first - 1, -1):
            own = inverse[k] * inverse[k]
            z[k] = (q[k] * inverse[k] + own * z[k + columns]) + own * z[k + 1]
        before, aligned = aligned, dot(r, z)
        kept = aligned / before
        for k in range(first, last):
            p[k] = z[k] + kept * p[k]
        for k in range(first, last):
            around = p[k - 1] + p[k + 1] + p[k - columns] + p[k + columns]
            q[k] = is_free[k] * (degree[k] * p[k] - around)
        step = aligned / dot(p, q)
        for k in range(first, last):
            x[k] += step * p[k]
            r[k] -= step * q[k]
    return x.reshape(rows, columns)
