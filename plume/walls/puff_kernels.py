"""Puffs among buildings as compiled loops: releases, their ways, and the gas and the wind at a place.

All draws are keyed by (seed, cell of time), and a puff's way is cut at the times of one grid, so that any
time can be asked first.
"""

import math

import numpy as np

from plume.compiled import kernel, subroutine
from plume.draws import key_of, normals, poisson, uniform
from plume.elementary import Array
from plume.numerics import exp, total_of
from plume.walls.motion import carried, cell_of, moved, sees, top_at, velocity_at

STEP_S = 0.25  # grid of times: in between, the wind carries a puff first, and eddies move it then
CELL_S = 1.0  # releases are drawn by cells of time
# Rows of a table of puffs: time of release, s; place, m; displacement by eddies, in standard deviations, with
# the sign that walls have given it.
TIME, X, Y, Z, EDDY_X, EDDY_Y, EDDY_Z = range(7)
# Rows of what is in the air: place, m; variance of a puff's own, m²; what it holds, g.
OWN, MASS, IN_THE_AIR = 3, 4, 5
OF_THE_COUNT, OF_A_PUFF = 0, 1  # streams of draws
EARLIEST = 1 << 20  # is added to the number of a cell: keys are not negative
FAR = 18.0  # half the squared distance from a puff, by its variance, from which on its gas does not count


@subroutine
def count_of(seed: int, cell: int, expected: float) -> int:
    """Draw the number of puffs that leave in a cell of time."""
    return poisson(key_of(seed, cell + EARLIEST, 0, OF_THE_COUNT), 0, expected)


@kernel("float64[:, ::1](uint64, int64, int64, float64, float64[::1])")
def releases(seed: int, first: int, cells: int, expected: float, source: Array) -> Array:
    """Return the puffs (7, P) that leave in so many cells of time from `first` on, in order of time.

    expected: number of puffs in a cell.  source: (3,) or more, its place.
    """
    total = 0
    for cell in range(first, first + cells):
        total += count_of(seed, cell, expected)
    puffs, done = np.empty((7, total)), 0
    for cell in range(first, first + cells):
        count, key = count_of(seed, cell, expected), key_of(seed, cell + EARLIEST, 0, OF_A_PUFF)
        times = np.empty(count)
        for k in range(count):
            times[k] = (cell + uniform(key, 5 * k)) * CELL_S
        times.sort()
        for k in range(count):
            puffs[TIME, done] = times[k]
            puffs[X, done], puffs[Y, done], puffs[Z, done] = source[0], source[1], source[2]
            puffs[EDDY_X, done], puffs[EDDY_Y, done] = normals(key, 5 * k + 1)
            puffs[EDDY_Z, done], _ = normals(key, 5 * k + 3)
            done += 1
    return puffs


@subroutine
def own_of(age_s: float, release: Array) -> float:
    """Return the variance of a puff's own at an age, m²."""
    return float(release[6] + release[7] * age_s)


@subroutine
def eddies_of(age_s: float, release: Array) -> float:
    """Return the standard deviation of a puff's displacement by eddies at an age, m."""
    return math.sqrt(max(release[8] * age_s - own_of(age_s, release), 0.0))


@subroutine
def follow(
    puffs: Array,
    k: int,
    from_s: float,
    to_s: float,
    release: Array,
    tops: Array,
    flow: Array,
    levels: Array,
    frame: Array,
) -> None:
    """Bring puff k from one time to another, in place; it has not been anywhere before its release."""
    from_s = max(from_s, puffs[TIME, k])
    if to_s <= from_s:
        return
    x, y, z = puffs[X, k], puffs[Y, k], puffs[Z, k]
    x, y = carried(x, y, z, to_s - from_s, flow, levels, frame)
    way = eddies_of(to_s - puffs[TIME, k], release) - eddies_of(from_s - puffs[TIME, k], release)
    dx, dy, dz = way * puffs[EDDY_X, k], way * puffs[EDDY_Y, k], way * puffs[EDDY_Z, k]
    x, y, z, back_x, back_y, back_z = moved(x, y, z, dx, dy, dz, tops, frame)
    puffs[X, k], puffs[Y, k], puffs[Z, k] = x, y, z
    puffs[EDDY_X, k] *= back_x
    puffs[EDDY_Y, k] *= back_y
    puffs[EDDY_Z, k] *= back_z


@kernel(
    "void(float64[:, ::1], int64, int64, float64[::1], float64[:, ::1], float64[:, :, :, ::1], float64[::1], "
    "float64[::1])"
)
def advance(
    puffs: Array,
    first: int,
    last: int,
    release: Array,
    tops: Array,
    flow: Array,
    levels: Array,
    frame: Array,
) -> None:
    """Bring puffs (7, P), in place, from time `first` of the grid to time `last`.

    release: (9,): source x, y, z; grams a puff, lifetime, the oldest age, variance at the release, and by
    age, of a puff alone and of puffs as a whole.
    """
    for k in range(puffs.shape[1]):
        too_old_s = puffs[TIME, k] + release[5] + STEP_S
        for step in range(first, last):
            if step * STEP_S < too_old_s:
                follow(puffs, k, step * STEP_S, (step + 1) * STEP_S, release, tops, flow, levels, frame)


@kernel(
    "float64[:, ::1](float64[:, ::1], int64, float64, float64[::1], float64[:, ::1], float64[:, :, :, ::1], "
    "float64[::1], float64[::1])"
)
def in_the_air(
    puffs: Array,
    step: int,
    time_s: float,
    release: Array,
    tops: Array,
    flow: Array,
    levels: Array,
    frame: Array,
) -> Array:
    """Return what is in the air (5, P) at a time from time `step` of the grid on, in order of release.

    puffs: (7, …) at time `step`.
    """
    times = puffs[TIME]
    first, last = 0, len(times)
    while first < last and times[first] < time_s - release[5]:
        first += 1
    while last > first and times[last - 1] > time_s:
        last -= 1
    there = puffs[:, first:last].copy()
    air = np.empty((IN_THE_AIR, last - first))
    for k in range(last - first):
        follow(there, k, step * STEP_S, time_s, release, tops, flow, levels, frame)
        age_s = time_s - there[TIME, k]
        air[0, k], air[1, k], air[2, k] = there[X, k], there[Y, k], there[Z, k]
        air[OWN, k] = own_of(age_s, release)
        air[MASS, k] = release[3] * exp(-age_s / release[4])
    return air


@kernel("float64[::1](float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1])")
def gas_at(places: Array, air: Array, tops: Array, frame: Array) -> Array:
    """Return the gas (M,) at places (M, 3), g/m³: the sum over the puffs (5, P) that can be seen from there.

    None in a building.
    """
    scale = 1.0 / math.sqrt(2.0 * math.pi) ** 3
    count = air.shape[1]
    gas, shares = np.zeros(len(places)), np.empty(count)
    for m in range(len(places)):
        x, y, z = places[m, 0], places[m, 1], places[m, 2]
        i, j = cell_of(x, y, frame)
        if z < top_at(tops, i, j):
            continue
        for k in range(count):
            dx, dy, dz, own = air[0, k] - x, air[1, k] - y, air[2, k] - z, air[OWN, k]
            exponent = (dx * dx + dy * dy + dz * dz) / (2.0 * own)
            shares[k] = 0.0
            if exponent < FAR and sees(x, y, z, air[0, k], air[1, k], air[2, k], tops, frame):
                shares[k] = scale * air[MASS, k] / (own * math.sqrt(own)) * exp(-exponent)
        gas[m] = total_of(shares)
    return gas


@kernel(
    "float64[:, ::1](float64[:, ::1], float64[:, ::1], float64[:, :, :, ::1], float64[::1], float64[::1])"
)
def wind_at(places: Array, tops: Array, flow: Array, levels: Array, frame: Array) -> Array:
    """Return the wind (M, 2) at places (M, 3), m/s, to where it comes from; none in a building."""
    winds = np.zeros((len(places), 2))
    for m in range(len(places)):
        x, y, z = places[m, 0], places[m, 1], places[m, 2]
        i, j = cell_of(x, y, frame)
        if z >= top_at(tops, i, j):
            air_x, air_y = velocity_at(x, y, z, flow, levels, frame)
            winds[m, 0], winds[m, 1] = -air_x, -air_y
    return winds
