"""exp, log, cos, sin and quantiles, bit-identical on every machine; and the kinds of arrays.

They consist of NumPy's own additions and multiplications. NumPy's `exp` and the C library's differ in their
last bits between processors. These need no compiler, so that a vehicle starts quickly; code that is compiled
has quicker ones in `plume/numerics.py`.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LOG2_E = 1.4426950408889634
# ln 2 in two parts; a whole number below 2^20 times the first one is exact.
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
SQRT_HALF = 0.7071067811865476
# Taylor's coefficients of e^x, 1/12! first.
TAYLOR = tuple(1 / n for n in (479001600, 39916800, 3628800, 362880, 40320, 5040, 720, 120, 24, 6, 2, 1, 1))


def float32(value: float) -> float:
    """Round to the nearest float32, as the wire rounds positions, wind and gas.

    In-process missions round the same way.
    """
    return float(np.float32(value))


def quantiles(values: Array, weights: Array, levels: ArrayLike) -> list[float]:
    """Return the weighted quantiles of values (N,): the least value that each share of the weight reaches.

    weights: (N,) up to 1 each. They are rounded to so few bits that their sums are exact: sorts leave equal
    values in different orders on different processors.
    """
    order = np.argsort(values)
    reached = np.cumsum(np.rint(weights * (2.0**52 / len(weights)))[order])
    at: list[float] = values[order[np.searchsorted(reached, np.asarray(levels) * reached[-1])]].tolist()
    return at


def _polynomial(x: Array, *coefficients: float) -> Array:
    """The polynomial with these coefficients, the highest first, at x (Horner)."""
    result = coefficients[0] * x + coefficients[1]
    for coefficient in coefficients[2:]:
        result = result * x + coefficient
    return result


def exp(x: ArrayLike) -> Array:
    """e^x to the last bit or two, with x clamped to ±708; NaN of NaN."""
    x = np.minimum(np.maximum(np.asarray(x, np.float64), -708.0), 708.0)
    whole = np.rint(x * LOG2_E)
    r = (x - whole * LN2_HIGH) - whole * LN2_LOW
    exponent = np.where(whole == whole, whole, 0.0).astype(np.int32)  # of NaN 0
    return np.asarray(np.ldexp(_polynomial(r, *TAYLOR), exponent))


def log(x: ArrayLike) -> Array:
    """ln x to the last bit or two, for normal x > 0: the exponent, and a series of artanh for the rest."""
    part, exponent = np.frexp(np.asarray(x, np.float64))
    small = part < SQRT_HALF
    f, exponent = np.where(small, 2 * part, part) - 1.0, exponent - small
    s = f / (2.0 + f)
    z = s * s
    series = z * _polynomial(z, *(2 / n for n in range(19, 1, -2)))
    return np.asarray(exponent * LN2_HIGH + (s * (2.0 + series) + exponent * LN2_LOW))


def direction(turns: ArrayLike) -> tuple[Array, Array]:
    """(cos, sin) of 2π · turns: the quarter is split off, the rest is a series within ±π/4."""
    turns = np.asarray(turns, np.float64)
    quarters = np.floor(4 * turns + 0.5)
    x = (4 * turns - quarters) * (np.pi / 2)
    z = x * x
    c = _polynomial(
        z,
        1 / 20922789888000,
        -1 / 87178291200,
        1 / 479001600,
        -1 / 3628800,
        1 / 40320,
        -1 / 720,
        1 / 24,
        -1 / 2,
        1,
    )
    s = x * _polynomial(
        z, -1 / 1307674368000, 1 / 6227020800, -1 / 39916800, 1 / 362880, -1 / 5040, 1 / 120, -1 / 6, 1
    )
    first_three = [quarters % 4 == quarter for quarter in (0, 1, 2)]
    return np.select(first_three, [c, -s, -c], s), np.select(first_three, [s, c, -s], -c)
