"""The planners' fused loops: they reweight a belief by hypothetical readings.

Compiled by numba and cached. Plain IEEE arithmetic in a fixed order: bit-identical on every machine and in
every run.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plume.compiled import kernel, subroutine
from plume.elementary import Array, Indices
from plume.numerics import HALF_LOG_2PI, direction, erfc, exp, fma, log, log1p, total_of
from plume.parameters import HITS_KIND, THRESHOLD_KIND

# Particles per block; the intermediate arrays of a block stay in the processor's first-level cache.
BLOCK = 1024
PUSHES = 8  # from one side to the next, until a place between them is clear


@subroutine
def _variance(mean: float, noise: float, cv: float, sensor: Array) -> float:
    """Variance of a reading: the sensor's, times the squared factor `noise`, and the gas's own by its cv."""
    return float(
        noise * noise * (sensor[1] * sensor[1] * mean * mean + sensor[2] * sensor[2]) + cv * cv * mean * mean
    )


@subroutine
def _exponents(
    means: Array, noises: Array, sensor: Array, quadratic: Array, linear: Array, constant: Array
) -> None:
    """Fill in the log-likelihood of a reading z under each particle: quadratic · z² + linear · z + constant.

    A reading in intermittent gas is taken to be normal, with its true mean and variance: the exact density
    is no quadratic and takes far longer (docs/planners.md compares them). For hits, the term −log z! is
    left out.
    """
    offset = HALF_LOG_2PI - log1p(-sensor[4])
    for i in range(len(means)):
        if sensor[0] == HITS_KIND:
            expected = sensor[1] * means[i] + sensor[2]
            quadratic[i] = 0.0
            linear[i] = log(expected)
            constant[i] = -expected
        else:
            variance = _variance(means[i], noises[0, i], noises[1, i], sensor)
            inverse = 1 / variance
            quadratic[i] = -0.5 * inverse
            linear[i] = means[i] * inverse
            constant[i] = -0.5 * (means[i] * means[i] * inverse + log(variance)) - offset


@subroutine
def _silence(means: Array, noises: Array, sensor: Array, constant: Array) -> None:
    """Fill `constant` with the log-probability that a threshold sensor reads 0, under each particle."""
    for i in range(len(means)):
        std = math.sqrt(_variance(means[i], noises[0, i], noises[1, i], sensor))
        below = 0.5 * erfc((means[i] - sensor[3]) / std * math.sqrt(0.5))
        constant[i] = log(max(sensor[4] + (1 - sensor[4]) * below, 1e-300))


@subroutine
def _likelihoods(
    one: Array,
    two: Array,
    three: Array,
    z: float,
    own: float,
    weights: Array,
    exponents: Array,
    likelihoods: Array,
    products: Array,
) -> None:
    """Fill `likelihoods` with w L and `products` with w L log L of a reading z under a block of particles.

    L is relative to `own`. Two loops with few arrays each: with more arrays LLVM cannot rule out aliasing.
    """
    for i in range(len(weights)):
        exponents[i] = fma(fma(one[i], z, two[i]), z, three[i]) - own
    for i in range(len(weights)):
        likelihoods[i] = weights[i] * exp(exponents[i])
        products[i] = likelihoods[i] * exponents[i]


@subroutine
def _reweight(
    one: Array,
    two: Array,
    three: Array,
    z: float,
    own: float,
    weights: Array,
    values: Array,
    buffers: Array,
    sums: Array,
) -> None:
    """Reweight by a reading z: fill `sums` with Σ w L, Σ w L log L and Σ w L v for each row v of values.

    values: (F, N).  buffers: (3, BLOCK).
    """
    sums[:] = 0.0
    for start in range(0, len(weights), BLOCK):
        size = min(BLOCK, len(weights) - start)
        part = slice(start, start + size)
        likelihoods, products = buffers[0, :size], buffers[1, :size]
        _likelihoods(
            one[part], two[part], three[part], z, own, weights[part], buffers[2, :size], likelihoods, products
        )
        sums[0] += total_of(likelihoods)
        sums[1] += total_of(products)
        for f in range(len(values)):
            row = values[f, part]
            for i in range(len(row)):
                products[i] = likelihoods[i] * row[i]
            sums[2 + f] += total_of(products)


class Predictor(NamedTuple):
    """What is reweighted, and by which sensor."""

    weights: Array  # (N,), sum one
    imagined: Indices  # (K,) the particles from which the readings were drawn
    sensor: Array  # (5,) as of `plume.sensors.names.sensor_row`
    noises: (
        Array  # (2, N) each particle's factor on the sensor's noise, and its intermittency (cv) of the gas
    )


class Scratch(NamedTuple):
    """Arrays to compute in."""

    exponents: Array  # (5, N): the coefficients of a log-likelihood, those of a silent sensor, and one offset
    zeros: Array  # (N,)
    buffers: Array  # (3, BLOCK)
    sums: Array  # (2 + F,)


@subroutine
def _read(
    means: Array,
    readings: Array,
    values: Array,
    predictor: Predictor,
    scratch: Scratch,
    earlier: Array,
    totals: Array,
    later: Array,
    later_totals: Array,
    said: Array,
    expected: Array,
) -> None:
    """Reweight a belief by K hypothetical readings at a place, each after those taken earlier.

    means: (N,).  readings: (K,).  values: (F, N).
    earlier, totals: (K, N) log-likelihoods of the earlier readings, relative to `totals` (K,); empty, if
    there are none.  later, later_totals: where to put those with this reading; empty, if nowhere. They may be
    the same arrays.
    said: (2, K) where to put the log predictive density and the expected log-likelihood of all readings;
    (2, 0) if neither they nor the expectations are wanted.
    expected: (K, F) where to put the expectations.
    """
    rows = scratch.exponents
    quadratic, linear, constant, silent, offset = rows[0], rows[1], rows[2], rows[3], rows[4]
    weights, imagined, sensor, noises = predictor
    sums, count = scratch.sums, len(weights)
    _exponents(means, noises, sensor, quadratic, linear, constant)
    if sensor[0] == THRESHOLD_KIND:
        _silence(means, noises, sensor, silent)
    for k in range(len(readings)):
        z = readings[k]
        if sensor[0] == THRESHOLD_KIND and z == 0.0:
            one, two, three = scratch.zeros, scratch.zeros, silent
        else:
            one, two, three = quadratic, linear, constant
        own = fma(
            fma(one[imagined[k]], z, two[imagined[k]]), z, three[imagined[k]]
        )  # a scale near the greatest log-likelihood
        total = own
        if len(earlier) > 0:
            total = totals[k] + own
            for i in range(count):
                offset[i] = three[i] + earlier[k, i]
            three = offset
        if len(later) > 0:
            later_totals[k] = total
            for i in range(count):
                later[k, i] = fma(fma(one[i], z, two[i]), z, three[i]) - own
        if said.shape[1] == 0:
            continue
        _reweight(one, two, three, z, own, weights, values, scratch.buffers, sums)
        said[0, k] = total + log(sums[0])
        said[1, k] = total + sums[1] / sums[0]
        for f in range(len(values)):
            expected[k, f] = sums[2 + f] / sums[0]


@kernel(
    "Tuple((float64[:, :, ::1], float64[:, :, ::1], float64[:, :, :, ::1], float64[::1]))("
    "float64[:, :, ::1], float64[::1], float64[:, :, :, ::1], int64[::1], float64[:, :, ::1], float64[::1], "
    "float64[:, ::1], float64[:, ::1], float64[:, ::1])",
    nogil=True,
)
def imagine(
    means: Array,
    weights: Array,
    values: Array,
    imagined: Indices,
    readings: Array,
    sensor: Array,
    noises: Array,
    means_before: Array,
    readings_before: Array,
) -> tuple[Array, Array, Array, Array]:
    """Reweight a belief by hypothetical readings along A paths of L places, and by B that come before all.

    means: (A, L, N) concentration at each place under each particle, g/m³.  weights: (N,), sum one.
    values: (A, L, F, N) values of each particle at each place, or (1, 1, F, N) if they are the same at all
    places.
    imagined: (K,) the particles from which the readings were drawn.  readings: (A, L, K).  sensor: (5,) as
    of `plume.sensors.names.sensor_row`.
    noises: (2, N) each particle's factor on the sensor's noise, and its intermittency (cv) of the gas.
    means_before, readings_before: (B, N) and (B, K), of what is read before, whatever the path.

    Results at a place include all readings on the path up to it. Returns the log predictive density of
    these readings (A, L, K); their expected log-likelihood (A, L, K) and the expectation of each value (A,
    L, K, F), both under the belief after them; and the information of those before (K,). For hits, log z! is
    left out of both logarithms: it is the same for all particles and cancels in their difference.
    """
    (paths, length, count), number, rows = means.shape, len(imagined), values.shape[2]
    first = len(means_before)
    predictor = Predictor(weights, imagined, sensor, noises)
    scratch = Scratch(np.empty((5, count)), np.zeros(count), np.empty((3, BLOCK)), np.empty(2 + rows))
    said, expectations = np.empty((paths, length, 2, number)), np.empty((paths, length, number, rows))
    none, before = np.empty((0, count)), np.empty((number if first else 0, count))
    along = np.empty((number if length > 1 else 0, count))
    totals, totals_before = np.empty(number), np.empty(number)
    gains_before = np.zeros(number)
    for step in range(first):
        earlier = before if step > 0 else none
        is_last = step + 1 == first
        last, nothing = np.empty((2, number if is_last else 0)), np.empty((0, count))
        _read(
            means_before[step],
            readings_before[step],
            nothing,
            predictor,
            scratch,
            earlier,
            totals_before,
            before,
            totals_before,
            last,
            np.empty((number, 0)),
        )
        if is_last:
            gains_before = last[1] - last[0]
    for a in range(paths):
        for step in range(length):
            earlier, sums = (along, totals) if step > 0 else (before, totals_before)
            later = along if step + 1 < length else none
            seen = values[min(a, len(values) - 1), min(step, values.shape[1] - 1)]
            _read(
                means[a, step],
                readings[a, step],
                seen,
                predictor,
                scratch,
                earlier,
                sums,
                later,
                totals,
                said[a, step],
                expectations[a, step],
            )
    log_predictive, log_likelihood = said[:, :, 0].copy(), said[:, :, 1].copy()
    return log_predictive, log_likelihood, expectations, gains_before


@kernel("float64[:, ::1](float64[:, :], float64[::1], float64[::1])")
def displacements(frames: Array, turns: Array, lengths: Array) -> Array:
    """Displacements (B, 2) m of moves of these lengths (B,), at angles (B,) in turns, in frames (B, 3)."""
    result = np.empty((len(turns), 2))
    for b in range(len(turns)):
        cosine, sine, mirror = frames[b]
        share = turns[b] - math.floor(turns[b])
        ahead, aside = direction(share if share < 1.0 else 0.0)
        along, across = lengths[b] * ahead, mirror * lengths[b] * aside
        result[b, 0], result[b, 1] = cosine * along - sine * across, sine * along + cosine * across
    return result


@subroutine
def _off_side(x: float, y: float, x_1: float, y_1: float, x_2: float, y_2: float) -> tuple[float, float]:
    """The shortest way to a place from the line between two others, m east and north."""
    along_x, along_y, off_x, off_y = x_2 - x_1, y_2 - y_1, x - x_1, y - y_1
    square = along_x * along_x + along_y * along_y
    share = min(max((off_x * along_x + off_y * along_y) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return off_x - share * along_x, off_y - share * along_y


@subroutine
def _square_from(x: float, y: float, x_1: float, y_1: float, x_2: float, y_2: float) -> float:
    """Squared distance of a place from the line between two others, m²."""
    left_x, left_y = _off_side(x, y, x_1, y_1, x_2, y_2)
    return float(left_x * left_x + left_y * left_y)


@subroutine
def _side(x: float, y: float, x_1: float, y_1: float, x_2: float, y_2: float) -> float:
    """On which side of the line through two places another one, (x, y), lies: the sign."""
    return (x_2 - x_1) * (y - y_1) - (y_2 - y_1) * (x - x_1)


@subroutine
def _gap(x: float, y: float, goal_x: float, goal_y: float, way: Array) -> float:
    """Least distance of a way from another one (2, 2), m: as `plume.polygons.polygons.gaps`, in NumPy."""
    (x_1, y_1), (x_2, y_2) = way
    crosses = (
        _side(x_1, y_1, x, y, goal_x, goal_y) * _side(x_2, y_2, x, y, goal_x, goal_y) < 0.0
        and _side(x, y, x_1, y_1, x_2, y_2) * _side(goal_x, goal_y, x_1, y_1, x_2, y_2) < 0.0
    )
    of_starts = min(_square_from(x, y, x_1, y_1, x_2, y_2), _square_from(x_1, y_1, x, y, goal_x, goal_y))
    of_ends = min(
        _square_from(goal_x, goal_y, x_1, y_1, x_2, y_2), _square_from(x_2, y_2, x, y, goal_x, goal_y)
    )
    return 0.0 if crosses else math.sqrt(min(of_starts, of_ends))


@kernel("boolean[::1](float64[::1], float64[:, ::1], float64[:, :, ::1], float64[::1], float64[::1])")
def are_apart(position: Array, places: Array, ways: Array, clear_m: Array, away: Array) -> NDArray[np.bool_]:
    """Whether ways from a position (2,) to places (A, 2) keep clear of other ways (F, 2, 2) m: (A,).

    clear_m: (F,) from each. A way that begins nearer to where such a way begins may do so, too, if each metre
    of it leads so many metres away from there as `away` (F,) says.
    """
    result, (x, y) = np.ones(len(places), np.bool_), position
    for a in range(len(places)):
        goal_x, goal_y = places[a]
        flown = math.sqrt((goal_x - x) * (goal_x - x) + (goal_y - y) * (goal_y - y))
        for f in range(len(ways)):
            if _gap(x, y, goal_x, goal_y, ways[f]) >= clear_m[f]:
                continue
            there_x, there_y = ways[f, 0]
            now = math.sqrt((there_x - x) * (there_x - x) + (there_y - y) * (there_y - y))
            then = math.sqrt(
                (there_x - goal_x) * (there_x - goal_x) + (there_y - goal_y) * (there_y - goal_y)
            )
            if now >= clear_m[f] or not then >= now + away[f] * flown:
                result[a] = False
                break
    return result


@subroutine
def _is_open(
    x: float, y: float, goal_x: float, goal_y: float, sides: Array, clearance_m: float, may_graze: bool
) -> bool:
    """True if a straight way crosses no side, and stays clear of all unless it `may_graze` them."""
    low_x, high_x = min(x, goal_x) - clearance_m, max(x, goal_x) + clearance_m
    low_y, high_y = min(y, goal_y) - clearance_m, max(y, goal_y) + clearance_m
    east, north, least = goal_x - x, goal_y - y, clearance_m * clearance_m
    for s in range(len(sides)):
        x_1, y_1, x_2, y_2 = sides[s]
        if max(x_1, x_2) < low_x or min(x_1, x_2) > high_x or max(y_1, y_2) < low_y or min(y_1, y_2) > high_y:
            continue
        one = east * (y_1 - y) - north * (x_1 - x)
        other = east * (y_2 - y) - north * (x_2 - x)
        if (one < 0.0) != (other < 0.0):
            from_place = (x_2 - x_1) * (y - y_1) - (y_2 - y_1) * (x - x_1)
            from_goal = (x_2 - x_1) * (goal_y - y_1) - (y_2 - y_1) * (goal_x - x_1)
            if (from_place < 0.0) != (from_goal < 0.0):
                return False
        if not may_graze and (
            _square_from(x_1, y_1, x, y, goal_x, goal_y) <= least
            or _square_from(x_2, y_2, x, y, goal_x, goal_y) <= least
            or _square_from(x, y, x_1, y_1, x_2, y_2) <= least
            or _square_from(goal_x, goal_y, x_1, y_1, x_2, y_2) <= least
        ):
            return False
    return True


@subroutine
def _to_corners(places: Array, sides: Array, corners: Array, between: Array, clearance_m: float) -> Array:
    """Lengths (A, C) m of the shortest ways from places (A, 2) to corners; infinite if there is none."""
    result, first = np.empty((len(places), len(corners))), np.empty(len(corners))
    for a in range(len(places)):
        x, y = places[a]
        for c in range(len(corners)):
            east, north = corners[c, 0] - x, corners[c, 1] - y
            seen = _is_open(x, y, corners[c, 0], corners[c, 1], sides, clearance_m, False)
            first[c] = math.sqrt(east * east + north * north) if seen else np.inf
        result[a] = np.inf
        for by in range(len(corners)):
            if first[by] < np.inf:
                for c in range(len(corners)):
                    result[a, c] = min(result[a, c], first[by] + between[by, c])
    return result


@subroutine
def _dock(x: float, y: float, sides: Array, clearance_m: float, margin_m: float) -> tuple[bool, float, float]:
    """Whether there is a clear place near a goal, with a leg to it that crosses no side, and the place.

    It is the goal if that is clear. Else the goal is pushed a margin away from the nearest side, a few times.
    """
    end_x, end_y = x, y
    for _ in range(PUSHES):
        least, from_x, from_y = np.inf, 0.0, 0.0
        for s in range(len(sides)):
            x_1, y_1, x_2, y_2 = sides[s]
            off_x, off_y = _off_side(end_x, end_y, x_1, y_1, x_2, y_2)
            square = off_x * off_x + off_y * off_y
            if square < least:
                least, from_x, from_y = square, off_x, off_y
        if least > clearance_m * clearance_m:
            return _is_open(end_x, end_y, x, y, sides, clearance_m, True), end_x, end_y
        if least == 0.0:
            break
        further = margin_m / math.sqrt(least) - 1.0
        end_x, end_y = end_x + further * from_x, end_y + further * from_y
    return False, x, y


@kernel(
    "float64[:, ::1](float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], "
    "float64, float64)",
    nogil=True,
)
def shortest_ways(
    places: Array,
    goals: Array,
    sides: Array,
    corners: Array,
    between: Array,
    clearance_m: float,
    margin_m: float,
) -> Array:
    """Lengths (A, N) m of the shortest ways from places (A, 2) to goals (2, N), straight or by corners.

    sides: (S, 4), x and y of both ends.  corners: (C, 2), about a margin from them.  between: (C, C) m,
    lengths of ways between corners. A way stays further than the clearance from polygons. A goal that does
    not is reached from its `_dock`, or, between polygons, from corners by legs that cross no side. So a place
    that is a metre away is no more than a metre nearer to any goal, but where a passage is just as wide as
    two clearances. Without any way it is the straight distance.
    """
    result, count = np.empty((len(places), goals.shape[1])), len(corners)
    to_corners = _to_corners(places, sides, corners, between, clearance_m)
    legs, are_open, known = np.empty(count), np.empty(count, np.bool_), np.empty(count, np.bool_)
    for n in range(goals.shape[1]):
        goal_x, goal_y = goals[0, n], goals[1, n]
        docked, end_x, end_y = _dock(goal_x, goal_y, sides, clearance_m, margin_m)
        last = math.sqrt((goal_x - end_x) * (goal_x - end_x) + (goal_y - end_y) * (goal_y - end_y))
        for c in range(count):
            east, north = end_x - corners[c, 0], end_y - corners[c, 1]
            legs[c] = math.sqrt(east * east + north * north)
        known[:] = False
        by = 0  # the corner by which the place before went: a good one to begin with
        for a in range(len(places)):
            x, y = places[a]
            best = np.inf
            if docked and _is_open(x, y, end_x, end_y, sides, clearance_m, False):
                best = math.sqrt((end_x - x) * (end_x - x) + (end_y - y) * (end_y - y))
            else:
                first = by
                for k in range(first, first + count):
                    c = k if k < count else k - count
                    length = to_corners[a, c] + legs[c]
                    if length >= best:
                        continue
                    if not known[c]:
                        known[c] = True
                        are_open[c] = _is_open(
                            corners[c, 0], corners[c, 1], end_x, end_y, sides, clearance_m, not docked
                        )
                    if are_open[c]:
                        best, by = length, c
            east, north = goal_x - x, goal_y - y
            result[a, n] = best + last if best < np.inf else math.sqrt(east * east + north * north)
    return result
