"""Intermittent gas as compiled loops: the density and the distribution of a reading.

A reading is g + v. The gas g is distributed as the inverse Gaussian law, of a mean m and a coefficient of
variation cv; the noise v is normal, with the variance σ². docs/physics.md says why.

With t = z/σ, μ = m/σ and λ = μ/cv² the density of z is √(λ/2π) ∫ c^(−3/2) exp(−λ (c − μ)²/(2 μ² c) −
(t − c)²/2) dc / (σ √(2π)). The exponent has one maximum, at c*, the positive root of c³ + w c² = λ/2 with
w = λ/(2μ²) − t. With ρ = λ/c*³, Laplace's method there gives the density √(ρ/(1 + ρ)) e^(exponent) / (σ
√(2π)). It leaves out the gas that piles up near 0: √((ρ + e^(−c*²))/(1 + ρ)) has it, but for a factor that
hardly varies. That depends on c* and ρ alone, and is kept in a table.
"""

import math
from functools import partial
from pathlib import Path

import numpy as np

from plume.compiled import kernel, subroutine
from plume.elementary import Array
from plume.numerics import HALF_LOG_2PI, ROUNDER, ROUNDER_BITS, bits_of, erfc, exp, float_of, fma, log

SMALLEST_CV = 0.01  # least intermittency: a hundredth of the mean is far below every noise
GREATEST = 30.0  # greatest coefficient of variation of the gas at a place
SMALLEST_MEAN = 1e-6  # least mean, in standard deviations of the noise
# The table is over log₂ c*² and log₂ ρ, as `_binary_logarithm` has them: from the lowest, in cells of a
# fraction.
LOW_SQUARE, SQUARE_CELLS, SQUARE_FRACTION = -6.0, 136, 8.0
LOW_RATIO, RATIO_CELLS, RATIO_FRACTION = -30.0, 88, 2.0
HALLEY = 2  # steps to the mode, from a place that is at most a fifth of it away
# The distribution function sums over concentrations: of BODY shares of 5% each, and of TAIL shares, each half
# of what is left. They are tabled over cv/(1 + cv) in CV_CELLS cells.
BODY, TAIL, CV_CELLS = 18, 12, 60
ONE_BY_ROOT_2PI = 1 / math.sqrt(2 * math.pi)
WHOLE, WHOLE_BITS = 4503599627370496.0, 0x4330000000000000  # 2^52 and its bits
# The upper half of the bits of a number is nearly 2^20 (1023 + its binary logarithm). What is added to a
# multiple of that is tuned for the least error of the power.
OF_ONE, CUBE_ROOT, INVERSE_CUBE_ROOT = 1_072_693_248.0, 715_093_163.0, 1_430_188_326.0
INVERSE_ROOT = 1_608_969_040.0


@partial(subroutine, forceinline=True)
def _upper_half(x: float) -> float:
    """The upper half of the bits of a positive number, as a number."""
    return float_of((bits_of(x) >> 32) | WHOLE_BITS) - WHOLE


@partial(subroutine, forceinline=True)
def _binary_logarithm(x: float) -> float:
    """log₂ x to 0.09: exact for powers of 2, and linear between them."""
    return (_upper_half(x) - OF_ONE) * 2.0**-20


@partial(subroutine, forceinline=True)
def _power(x: float, exponent: float, added: float) -> float:
    """A power of a positive number, to some percent: a multiple of its logarithm, as its bits have it."""
    return float_of((bits_of(fma(_upper_half(x), exponent, added) + ROUNDER) - ROUNDER_BITS) << 32)


@partial(subroutine, forceinline=True)
def _mode(scale: float, offset: float) -> float:
    """Return the positive root s of f(s) = s² (s + offset) − scale, scale > 0, by Halley's method."""
    v = offset * _power(scale, -1 / 3, INVERSE_CUBE_ROOT)
    positive, square = max(v, 0.0), v * v + 4
    above = _power(positive + _power(positive + 1, -0.5, INVERSE_ROOT), -0.5, INVERSE_ROOT)
    below = 0.5 * (square * _power(square, -0.5, INVERSE_ROOT) - v)
    s = _power(scale, 1 / 3, CUBE_ROOT) * (above if v > 0 else below)
    for _ in range(HALLEY):
        f, slope, bend = s * s * (s + offset) - scale, s * (3 * s + 2 * offset), 6 * s + 2 * offset
        s -= 2 * f * slope / (2 * slope * slope - f * bend)
    return s


@subroutine
def _log_integral(lam: float, w: float, mode: float) -> float:
    """Log of ∫ c^(−3/2) exp(−λ/(2c) − w c − c²/2) dc by the trapezoid rule over log c."""
    width = 1 / math.sqrt(lam / mode + mode * mode)
    low, high = log(mode) - 60 * min(width, 1.0), log(mode) + min(40 * width, 3.0)
    if lam < mode * mode * mode or mode < 3:  # the gas near 0 matters, too
        low = min(low, log(lam / 3) - 8) if lam < 0.5 else low - 60
    nodes = int((high - low) / min(0.02, width / 12)) + 10
    step, top = (high - low) / nodes, -math.inf
    for node in range(nodes + 1):
        c = exp(low + node * step)
        top = max(top, -0.5 * log(c) - lam / (2 * c) - w * c - 0.5 * c * c)
    total = 0.0
    for node in range(nodes + 1):
        c = exp(low + node * step)
        total += exp(-0.5 * log(c) - lam / (2 * c) - w * c - 0.5 * c * c - top)
    return top + log(total * step)


@subroutine
def _binary_power(x: float) -> float:
    """Return the inverse of `_binary_logarithm`."""
    whole = math.floor(x)
    return (1 + x - whole) * 2.0**whole


@subroutine
def correction_row(row: int) -> Array:
    """Compute a row (RATIO_CELLS + 1,) of CORRECTIONS by quadrature: the factor that is left out, 1 at great
    modes.
    """
    result = np.ones(RATIO_CELLS + 1)
    if row == SQUARE_CELLS:
        return result
    c = math.sqrt(_binary_power(LOW_SQUARE + row / SQUARE_FRACTION))
    for column in range(RATIO_CELLS + 1):
        ratio = _binary_power(LOW_RATIO + column / RATIO_FRACTION)
        lam, w = ratio * c * c * c, 0.5 * ratio * c - c
        at_mode = -1.5 * log(c) - lam / (2 * c) - w * c - 0.5 * c * c + HALF_LOG_2PI
        near_0 = math.sqrt((ratio + exp(-c * c)) / (ratio * (1 + ratio)))
        result[column] = exp(_log_integral(lam, w, c) - at_mode) / near_0
    return result


# (SQUARE_CELLS + 1, RATIO_CELLS + 1): all rows of `correction_row`, in a file because they take seconds.
CORRECTIONS_FILE = Path(__file__).with_suffix(".npy")
CORRECTIONS = np.load(CORRECTIONS_FILE)


@partial(subroutine, forceinline=True)
def correction(square: float, ratio: float) -> float:
    """Return the tabled factor of a density: of c*² and ρ."""
    x = (_binary_logarithm(square) - LOW_SQUARE) * SQUARE_FRACTION
    y = (_binary_logarithm(ratio) - LOW_RATIO) * RATIO_FRACTION
    x, y = min(max(x, 0.0), float(SQUARE_CELLS)), min(max(y, 0.0), float(RATIO_CELLS))
    row, column = min(int(x), SQUARE_CELLS - 1), min(int(y), RATIO_CELLS - 1)
    x -= row
    y -= column
    low = CORRECTIONS[row, column] + y * (CORRECTIONS[row, column + 1] - CORRECTIONS[row, column])
    high = CORRECTIONS[row + 1, column] + y * (
        CORRECTIONS[row + 1, column + 1] - CORRECTIONS[row + 1, column]
    )
    return float(low + x * (high - low))


@partial(subroutine, forceinline=True)
def parts_of_density(
    gas: float, mean: float, variance: float, square: float
) -> tuple[float, float, float, float]:
    """Return (e, f, c*², ρ) of the density e f `correction(c*², ρ)` of a reading.

    Its gas has this mean and squared coefficient of variation; its noise is N(0, variance).
    """
    square = min(max(square, SMALLEST_CV * SMALLEST_CV), GREATEST * GREATEST)
    mean = max(mean, SMALLEST_MEAN * math.sqrt(variance))
    inverse = 1 / (square * mean)
    by_mean = square * inverse
    scale = 0.5 * variance * inverse * by_mean
    s = _mode(scale, scale - gas * by_mean)
    ratio = 2 * scale / (s * s * s)  # ρ
    by_both = 1 / ((1 + ratio) * variance)
    by_variance = (1 + ratio) * by_both
    at_mode = s * mean
    squared = at_mode * at_mode * by_variance  # c*²
    to_mean, to_gas = 1 - s, gas - at_mode
    exponent = -0.5 * (ratio * squared * to_mean * to_mean + to_gas * to_gas * by_variance)
    near_0 = math.sqrt((ratio + exp(-squared)) * by_both)
    return exp(exponent), ONE_BY_ROOT_2PI * near_0, squared, ratio


@subroutine
def density(gas: float, mean: float, variance: float, square: float) -> float:
    """Density of a reading, as of `parts_of_density`."""
    at_mode, factor, squared, ratio = parts_of_density(gas, mean, variance, square)
    return at_mode * (factor * correction(squared, ratio))


@kernel("float64[:, ::1]()")
def _concentrations() -> Array:
    """Concentrations (CV_CELLS + 1, BODY + TAIL) that stand for shares of the gas: the medians of the shares.

    They are in units of the mean.
    """
    result = np.ones((CV_CELLS + 1, BODY + TAIL))
    nodes = 12000
    cumulative = np.empty(nodes + 1)
    for row in range(1, CV_CELLS + 1):
        x = min(row / CV_CELLS, GREATEST / (1 + GREATEST))
        lam = ((1 - x) / x) ** 2
        low, high = log(lam / (2 * lam + 100)), log((3 * lam + 100) / lam)
        step = (high - low) / nodes
        total, before = 0.0, 0.0
        for node in range(nodes + 1):
            at = low + node * step
            c = exp(at)
            here = exp(-0.5 * at - 0.5 * lam * (c - 1) * (c - 1) / c)
            total += 0.5 * (before + here)
            before = here
            cumulative[node] = total
        node = 0
        for cell in range(BODY + TAIL):
            inner = 0.75 if cell < BODY + TAIL - 1 else 0.5
            share = (cell + 0.5) / 20 if cell < BODY else 1 - 0.1 * 0.5 ** (cell - BODY) * inner
            while node < nodes and cumulative[node] < share * total:
                node += 1
            before = cumulative[node - 1] if node > 0 else 0.0
            part = (share * total - before) / max(cumulative[node] - before, 1e-300)
            result[row, cell] = exp(low + (node - 1 + part) * step)
    return result


CONCENTRATIONS = _concentrations()
# The share of the gas that each concentration stands for.
SHARES = np.array([0.05] * BODY + [0.05 * 0.5**cell for cell in range(TAIL - 1)] + [0.1 * 0.5 ** (TAIL - 1)])


@subroutine
def _row_of(square: float) -> tuple[int, float]:
    """Return the row of CONCENTRATIONS for a squared cv, and how far it is to the next."""
    cv = min(math.sqrt(square), GREATEST)
    x = cv / (1 + cv) * CV_CELLS
    row = min(int(x), CV_CELLS - 1)
    return row, x - row


@subroutine
def exceeding(gas: float, mean: float, variance: float, square: float) -> float:
    """P(Z > gas) of a reading, as by `distributions`; small ones keep their digits."""
    row, x = _row_of(square)
    inverse, total = math.sqrt(0.5 / variance), 0.0
    low, high = CONCENTRATIONS[row], CONCENTRATIONS[row + 1]
    for cell in range(BODY + TAIL):
        total += SHARES[cell] * erfc((gas - mean * (low[cell] + x * (high[cell] - low[cell]))) * inverse)
    return 0.5 * total


@subroutine
def distributions(gas: Array, means: Array, variances: Array, squares: Array, result: Array) -> None:
    """Fill `result` with P(Z ≤ gas) of readings (count,), as of `density`; right to about 0.01.

    One loop over all concentrations of all readings is the shortest: LLVM vectorises it.
    """
    cells = BODY + TAIL
    tails = np.empty(len(gas) * cells)
    for i in range(len(gas)):
        row, x = _row_of(squares[i])
        inverse = math.sqrt(0.5 / variances[i])
        low, high = CONCENTRATIONS[row], CONCENTRATIONS[row + 1]
        for cell in range(cells):
            concentration = means[i] * (low[cell] + x * (high[cell] - low[cell]))
            tails[i * cells + cell] = (concentration - gas[i]) * inverse
    for at in range(len(tails)):
        tails[at] = erfc(tails[at])
    for i in range(len(gas)):
        total = 0.0
        for cell in range(cells):
            total += SHARES[cell] * tails[i * cells + cell]
        result[i] = 0.5 * total
