"""exp, log, cos and sin, erfc, log-gamma and sums as compiled loops use them.

Plain IEEE arithmetic: bit-identical on every machine.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numba
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic
from numpy.typing import ArrayLike

from plume.compiled import kernel, subroutine
from plume.elementary import LN2_HIGH, LN2_LOW, LOG2_E, SQRT_HALF, Array

HALF_LOG_2PI = 0.9189385332046727
ROUNDER = 6755399441055744.0  # 1.5 · 2^52: adding it leaves the nearest whole number in the low bits
ROUNDER_BITS = 0x4338000000000000
SQRT_HALF_BITS = 0x3FE6A09E667F3BCD

# Coefficients of polynomials, the highest power first.
EXP = (
    *(1 / 479001600, 1 / 39916800, 1 / 3628800, 1 / 362880, 1 / 40320, 1 / 5040, 1 / 720, 1 / 120, 1 / 24),
    *(1 / 6, 0.5, 1.0, 1.0),
)
LOG = (2 / 19, 2 / 17, 2 / 15, 2 / 13, 2 / 11, 2 / 9, 2 / 7, 2 / 5, 2 / 3, 2.0)
COS = (
    *(1 / 20922789888000, -1 / 87178291200, 1 / 479001600, -1 / 3628800, 1 / 40320, -1 / 720, 1 / 24),
    *(-0.5, 1.0),
)
SIN = (-1 / 1307674368000, 1 / 6227020800, -1 / 39916800, 1 / 362880, -1 / 5040, 1 / 120, -1 / 6, 1.0)
ERFC = (
    *(-3.3888695546308687e-10, 1.2051665995883637e-09, 1.2284536350186566e-09, -9.744756625932259e-09),
    *(6.353864669505139e-09, 2.9041985444209086e-08, -5.760146697175624e-08, -1.6982724012935667e-09),
    *(1.6491163111184633e-07, -2.855481823834117e-07, -3.0587196456747096e-09, 1.00091858626541e-06),
    *(-1.8208078384029821e-06, -5.628166935192924e-07, 8.060040491028146e-06, -1.0848057268891096e-05),
    *(-1.7074336530735702e-05, 7.223535061438543e-05, -1.7185737594548938e-05, -0.00033153674761946043),
    *(0.0004186480332964868, 0.0015453060290576436, -0.0032395925339865133, -0.010755330944716365),
    *(0.018221115753442495, 0.13973604627802688, 0.34358034220690525, 0.5107913526210115),
)


def _to_bits(_context: Any, _value: Any) -> Any:
    return numba.int64(numba.float64), lambda _c, builder, _s, args: builder.bitcast(args[0], ir.IntType(64))


def _to_float(_context: Any, _value: Any) -> Any:
    return numba.float64(numba.int64), lambda _c, builder, _s, args: builder.bitcast(args[0], ir.DoubleType())


def _to_fused(_context: Any, _a: Any, _b: Any, _c: Any) -> Any:
    double = numba.float64
    return double(double, double, double), lambda _c, builder, _s, args: builder.fma(*args)


def _to_polynomial(_context: Any, _x: Any, coefficients: Any) -> Any:
    def horner(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        result, *others = (builder.extract_value(args[1], power) for power in range(len(coefficients)))
        for coefficient in others:
            result = builder.fma(result, args[0], coefficient)
        return result

    return numba.float64(numba.float64, coefficients), horner


# a · b + c, rounded once; bit-identical without the instruction, too
fma = cast(Callable[[float, float, float], float], intrinsic(_to_fused))
# (x, coefficients): by Horner's rule with `fma`
polynomial = cast(Callable[[float, tuple[float, ...]], float], intrinsic(_to_polynomial))
bits_of = cast(Callable[[float], int], intrinsic(_to_bits))  # the 64 bits of a float as an integer
float_of = cast(Callable[[int], float], intrinsic(_to_float))  # the float with these 64 bits


@subroutine
def exp(x: float) -> float:
    """e^x to the last bit or two, with x clamped to ±708; a polynomial, so that loops over it vectorise."""
    x = min(max(x, -708.0), 708.0)
    shifted = fma(x, LOG2_E, ROUNDER)
    whole = shifted - ROUNDER
    r = fma(whole, -LN2_LOW, fma(whole, -LN2_HIGH, x))
    return polynomial(r, EXP) * float_of((bits_of(shifted) - ROUNDER_BITS + 1023) << 52)


@subroutine
def log(x: float) -> float:
    """ln x to the last bit or two, for normal x > 0: the exponent, and a series of artanh for the rest."""
    bits = bits_of(x)
    exponent = (bits - SQRT_HALF_BITS) >> 52
    f = float_of(bits - (exponent << 52)) - 1.0
    s = f / (2.0 + f)
    z = s * s
    return float(exponent) * LN2_HIGH + (s * polynomial(z, LOG) + float(exponent) * LN2_LOW)


@subroutine
def log1p(x: float) -> float:
    """ln(1 + x), for x above −1; what 1 + x rounds off is added again."""
    whole = 1.0 + x
    return log(whole) + (x - (whole - 1.0)) / whole


# Inlined by force: LLVM finds it too long, and then cannot vectorise.
@partial(subroutine, forceinline=True)
def erfc(x: float) -> float:
    """The complementary error function, to a relative error of 4e-16 (1 + x²); 0 where it is below 1e-307.

    erfc(x) exp(x²) (1 + x/2) is a polynomial of degree 27 in (1 − x/2)/(1 + x/2) for x ≥ 0, from its
    Chebyshev series.
    """
    size = abs(x)
    t = 1 / (1 + 0.5 * size)
    s = 2 * t - 1
    tail = t * polynomial(s, ERFC) * exp(-size * size) if size < 26.5 else 0.0
    return tail if x >= 0 else 2.0 - tail


@subroutine
def log_gamma(x: float) -> float:
    """ln Γ(x) for x ≥ 1, by Stirling's series from 10 on.

    The error is at most 5e-15 times the greater of 1 and the result.
    """
    product = 1.0
    while x < 10.0:
        product *= x
        x += 1.0
    y = 1 / (x * x)
    series = (
        1 / 12
        - y * (1 / 360 - y * (1 / 1260 - y * (1 / 1680 - y * (1 / 1188 - y * (691 / 360360 - y / 156)))))
    ) / x
    return (x - 0.5) * log(x) - x + HALF_LOG_2PI + series - log(product)


@subroutine
def cosine_and_sine(angle: float) -> tuple[float, float]:
    """(cos, sin) of an angle in radians, to 4e-16 (1 + |angle|)."""
    turns = angle * (0.5 / np.pi)
    turns -= np.floor(turns)
    return direction(turns if turns < 1.0 else 0.0)  # a small negative number of turns rounds to a whole one


@subroutine
def angle_of(x: float, y: float) -> float:
    """The angle of (x, y) in radians, within ±π, to 2e-15.

    A rational guess is corrected by the angle between it and (x, y).
    """
    larger = max(abs(x), abs(y))
    if larger == 0.0:
        return 0.0
    a, b = x / larger, y / larger
    share = min(abs(a), abs(b))
    angle = share * (1.0584 - 0.273 * share)
    angle = angle if abs(a) >= abs(b) else np.pi / 2 - angle
    angle = angle if a >= 0 else np.pi - angle
    angle = angle if b >= 0 else -angle
    for _ in range(3):
        c, s = cosine_and_sine(angle)
        tangent = (b * c - a * s) / (a * c + b * s)
        angle += tangent - tangent * tangent * tangent / 3
    return angle


@subroutine
def direction(turns: float) -> tuple[float, float]:
    """(cos, sin) of 2π · turns, turns in [0, 1): the quarter, and a series within ±π/4 for the rest."""
    quarter = np.floor(4 * turns)
    x = (4 * turns - quarter - 0.5) * (np.pi / 2)
    z = x * x
    c, s = polynomial(z, COS), polynomial(z, SIN) * x
    a, b = (c - s) * SQRT_HALF, (c + s) * SQRT_HALF  # turned by π/4: the middle of the first quarter
    one, two = (a, b) if quarter == 0.0 or quarter == 2.0 else (-b, a)
    return (one, two) if quarter < 2.0 else (-one, -two)


@subroutine
def total_of(values: Array) -> float:
    """Sum with eight interleaved accumulators, in an order that never changes.

    Additions need not wait for each other.
    """
    a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    whole = len(values) - len(values) % 8
    for i in range(0, whole, 8):
        a += values[i]
        b += values[i + 1]
        c += values[i + 2]
        d += values[i + 3]
        e += values[i + 4]
        f += values[i + 5]
        g += values[i + 6]
        h += values[i + 7]
    for i in range(whole, len(values)):
        a += values[i]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@subroutine
def dot(one: Array, other: Array) -> float:
    """Σ one · other, summed as `total_of` does."""
    a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    whole = len(one) - len(one) % 8
    for i in range(0, whole, 8):
        a += one[i] * other[i]
        b += one[i + 1] * other[i + 1]
        c += one[i + 2] * other[i + 2]
        d += one[i + 3] * other[i + 3]
        e += one[i + 4] * other[i + 4]
        f += one[i + 5] * other[i + 5]
        g += one[i + 6] * other[i + 6]
        h += one[i + 7] * other[i + 7]
    for i in range(whole, len(one)):
        a += one[i] * other[i]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@kernel("void(float64[::1])")
def _exponentiate(values: Array) -> None:
    for i in range(len(values)):
        values[i] = exp(values[i])


@kernel("void(float64[::1])")
def _take_logs(values: Array) -> None:
    for i in range(len(values)):
        values[i] = log(values[i])


@kernel("void(float64[::1])")
def _take_erfcs(values: Array) -> None:
    for i in range(len(values)):
        values[i] = erfc(values[i])


def _each(kernel_in_place: Callable[[Array], None], values: ArrayLike) -> Array:
    result = np.array(values, np.float64, order="C")
    kernel_in_place(result.reshape(-1))
    return result


# `exp`, `log` and `erfc` of each number, for code that is not compiled; same shape.
exp_each = partial(_each, _exponentiate)
log_each = partial(_each, _take_logs)
erfc_each = partial(_each, _take_erfcs)
