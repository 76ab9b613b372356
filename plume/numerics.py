"""exp, log, cos and sin, fused multiply-add, sum: plain IEEE arithmetic, bit-identical on every machine, vectorisable."""

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic
from numpy.typing import NDArray

LOG2_E = 1.4426950408889634
LN2_HIGH = 6.93147180369123816490e-01
LN2_LOW = 1.90821492927058770002e-10
ROUNDER = 6755399441055744.0  # 1.5 · 2^52: adding it leaves the nearest whole number in the low bits
ROUNDER_BITS = 0x4338000000000000
SQRT_HALF = 0.7071067811865476
SQRT_HALF_BITS = 0x3FE6A09E667F3BCD


def _to_bits(_context: Any, _value: Any) -> Any:
    return numba.int64(numba.float64), lambda _c, builder, _s, args: builder.bitcast(args[0], ir.IntType(64))


def _to_float(_context: Any, _value: Any) -> Any:
    return numba.float64(numba.int64), lambda _c, builder, _s, args: builder.bitcast(args[0], ir.DoubleType())


def _to_fused(_context: Any, _a: Any, _b: Any, _c: Any) -> Any:
    return numba.float64(numba.float64, numba.float64, numba.float64), lambda _x, builder, _s, args: builder.fma(*args)


fma: Any = intrinsic(_to_fused)
"""a · b + c, rounded once; bit-identical on processors without the instruction."""
bits_of: Any = intrinsic(_to_bits)
"""The 64 bits of a float as an integer."""
float_of: Any = intrinsic(_to_float)
"""The float with these 64 bits."""


@numba.njit(error_model="numpy")
def exp(x: float) -> float:
    """e^x to the last bit or two, with x clamped to ±708; a polynomial, so that loops over it vectorise."""
    x = min(max(x, -708.0), 708.0)
    shifted = fma(x, LOG2_E, ROUNDER)
    whole = shifted - ROUNDER
    r = fma(whole, -LN2_LOW, fma(whole, -LN2_HIGH, x))
    p = fma(r, 1 / 479001600, 1 / 39916800)
    p = fma(p, r, 1 / 3628800)
    p = fma(p, r, 1 / 362880)
    p = fma(p, r, 1 / 40320)
    p = fma(p, r, 1 / 5040)
    p = fma(p, r, 1 / 720)
    p = fma(p, r, 1 / 120)
    p = fma(p, r, 1 / 24)
    p = fma(p, r, 1 / 6)
    p = fma(p, r, 0.5)
    p = fma(p, r, 1.0)
    p = fma(p, r, 1.0)
    result: float = p * float_of((bits_of(shifted) - ROUNDER_BITS + 1023) << 52)
    return result


@numba.njit(error_model="numpy")
def log(x: float) -> float:
    """ln x to the last bit or two, for normal x > 0: the exponent is split off, the rest is a series of artanh."""
    bits: int = bits_of(x)
    exponent = (bits - SQRT_HALF_BITS) >> 52
    f: float = float_of(bits - (exponent << 52)) - 1.0
    s = f / (2.0 + f)
    z = s * s
    p = fma(z, 2 / 19, 2 / 17)
    p = fma(p, z, 2 / 15)
    p = fma(p, z, 2 / 13)
    p = fma(p, z, 2 / 11)
    p = fma(p, z, 2 / 9)
    p = fma(p, z, 2 / 7)
    p = fma(p, z, 2 / 5)
    p = fma(p, z, 2 / 3)
    result: float = float(exponent) * LN2_HIGH + (s * fma(p, z, 2.0) + float(exponent) * LN2_LOW)
    return result


@numba.njit(error_model="numpy")
def direction(turns: float) -> tuple[float, float]:
    """(cos, sin) of 2π · turns, turns in [0, 1): the quarter is split off, the rest is a series within ±π/4."""
    quarter = float(int(4 * turns))
    x = (4 * turns - quarter - 0.5) * (np.pi / 2)
    z = x * x
    c = fma(z, 1 / 20922789888000, -1 / 87178291200)
    c = fma(c, z, 1 / 479001600)
    c = fma(c, z, -1 / 3628800)
    c = fma(c, z, 1 / 40320)
    c = fma(c, z, -1 / 720)
    c = fma(c, z, 1 / 24)
    c = fma(c, z, -0.5)
    c = fma(c, z, 1.0)
    s = fma(z, -1 / 1307674368000, 1 / 6227020800)
    s = fma(s, z, -1 / 39916800)
    s = fma(s, z, 1 / 362880)
    s = fma(s, z, -1 / 5040)
    s = fma(s, z, 1 / 120)
    s = fma(s, z, -1 / 6)
    s = fma(s, z, 1.0) * x
    a, b = (c - s) * SQRT_HALF, (c + s) * SQRT_HALF  # turned by π/4: the middle of the first quarter
    one, two = (a, b) if quarter == 0.0 or quarter == 2.0 else (-b, a)
    return (one, two) if quarter < 2.0 else (-one, -two)


@numba.njit(error_model="numpy")
def total_of(values: NDArray[np.float64]) -> float:
    """Sum with eight interleaved accumulators: additions need not wait for each other, and their order never changes."""
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
