"""Puffs as compiled loops: the path of the air, the releases, and the gas at a place.

All draws are keyed by (seed, cell of time), so any time can be asked first.
"""

import math

import numpy as np

from plume.compiled import kernel, subroutine
from plume.draws import key_of, normals, poisson, uniform
from plume.elementary import Array
from plume.numerics import cosine_and_sine, exp, total_of

# Rows of a path: displacement of the air since its start, m; wind until the next time of the grid, m/s, to
# where it comes from; deviations of direction and speed, in standard deviations.
DX, DY, WIND_X, WIND_Y, TURNED, GUST = range(6)
# Rows of a table of puffs: time of release, s; displacement by eddies in x, y, z, in standard deviations;
# displacement of the air at the release, m.
TIME, EDDY_X, EDDY_Y, EDDY_Z, AIR_X, AIR_Y = range(6)
OF_THE_WIND, OF_THE_COUNT, OF_A_PUFF = 0, 1, 2  # streams of draws
EARLIEST = 1 << 20  # is added to the number of a cell: keys are not negative


@kernel("float64[:, ::1](uint64, int64, int64, float64[::1], float64[::1])")
def path_of(seed: int, first: int, count: int, before: Array, wind: Array) -> Array:
    """Return the air's path (6, count) at the times `first`, `first` + 1 … of the grid.

    before: (6,) the path at the time before, or empty at the start, where it is stationary.
    wind: (6,): speed m/s, direction it comes from rad, standard deviations of direction rad and of speed as a
    share, correlation from one time of the grid to the next, the grid's step s.
    The deviations are Ornstein–Uhlenbeck processes, taken as constant between two times.
    """
    speed, angle, turns, gusts, kept, step_s = wind
    new = math.sqrt(1 - kept * kept)
    path = np.empty((6, count))
    last = before.copy()
    for i in range(count):
        a, b = normals(key_of(seed, first + i + EARLIEST, 0, OF_THE_WIND), 0)
        if len(last) == 0:
            last = np.zeros(6)
        else:
            a, b = kept * last[TURNED] + new * a, kept * last[GUST] + new * b
        cosine, sine = cosine_and_sine(angle + turns * a)
        there = speed * max(1 + gusts * b, 0.0)
        path[DX, i] = last[DX] - step_s * last[WIND_X]
        path[DY, i] = last[DY] - step_s * last[WIND_Y]
        path[WIND_X, i], path[WIND_Y, i] = there * cosine, there * sine
        path[TURNED, i], path[GUST, i] = a, b
        for row in range(6):
            last[row] = path[row, i]
    return path


@subroutine
def count_of(seed: int, cell: int, expected: float) -> int:
    """Draw the number of puffs that leave in a cell of time."""
    return poisson(key_of(seed, cell + EARLIEST, 0, OF_THE_COUNT), 0, expected)


@kernel("float64[:, ::1](uint64, int64, int64, float64, float64, float64[:, ::1], int64, float64)")
def releases(
    seed: int,
    first: int,
    cells: int,
    cell_s: float,
    expected: float,
    path: Array,
    path_first: int,
    step_s: float,
) -> Array:
    """Return the puffs (6, P) that leave in so many cells of time from `first` on, in order of time.

    expected: number of puffs in a cell.  path: the air's path from the time `path_first` of the grid on.
    """
    total = 0
    for cell in range(first, first + cells):
        total += count_of(seed, cell, expected)
    puffs, done = np.empty((6, total)), 0
    for cell in range(first, first + cells):
        count, key = count_of(seed, cell, expected), key_of(seed, cell + EARLIEST, 0, OF_A_PUFF)
        times = np.empty(count)
        for k in range(count):
            times[k] = (cell + uniform(key, 5 * k)) * cell_s
        times.sort()
        for k in range(count):
            cell_of_wind = math.floor(times[k] / step_s)
            since_s, i = times[k] - cell_of_wind * step_s, int(cell_of_wind) - path_first
            puffs[TIME, done] = times[k]
            puffs[EDDY_X, done], puffs[EDDY_Y, done] = normals(key, 5 * k + 1)
            puffs[EDDY_Z, done], _ = normals(key, 5 * k + 3)
            puffs[AIR_X, done] = path[DX, i] - since_s * path[WIND_X, i]
            puffs[AIR_Y, done] = path[DY, i] - since_s * path[WIND_Y, i]
            done += 1
    return puffs


@kernel("float64[::1](float64[:, ::1], float64, float64[:, ::1], float64[::1], float64[::1])")
def gas_at(places: Array, time_s: float, puffs: Array, air: Array, release: Array) -> Array:
    """Return the gas (M,) at places (M, 3) at a time, g/m³: the sum over puffs (6, P), in order of time.

    air: (2,) displacement of the air at the time, m.  release: (9,): source x, y, z; grams a puff, lifetime,
    the oldest age, variance at the release, and by age, of a puff alone and of puffs as a whole.
    """
    x, y, z, mass, lifetime, oldest_s, least, widens, spreads = release
    times = puffs[TIME]
    first, last = 0, len(times)
    while first < last and times[first] < time_s - oldest_s:
        first += 1
    while last > first and times[last - 1] > time_s:
        last -= 1
    scale = mass / math.sqrt(2 * math.pi) ** 3
    gas, shares = np.empty(len(places)), np.empty(last - first)
    for m in range(len(places)):
        px, py, pz = places[m, 0] - x - air[0], places[m, 1] - y - air[1], places[m, 2] - z
        for k in range(first, last):
            age_s = time_s - times[k]
            own = least + widens * age_s
            moved = math.sqrt(max(spreads * age_s - own, 0.0))
            dx = px + puffs[AIR_X, k] - moved * puffs[EDDY_X, k]
            dy = py + puffs[AIR_Y, k] - moved * puffs[EDDY_Y, k]
            dz = pz - moved * puffs[EDDY_Z, k]
            exponent = -age_s / lifetime - (dx * dx + dy * dy + dz * dz) / (2 * own)
            shares[k - first] = scale / (own * math.sqrt(own)) * exp(exponent)
        gas[m] = total_of(shares)
    return gas
