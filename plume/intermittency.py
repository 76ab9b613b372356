"""Intermittent gas as compiled loops: the density and the distribution of a reading.

A reading is c + v: the gas c is gamma-distributed, the noise v normal.

With t = z/σ, μ = m/σ, shape k = 1/cv² the density of z is φ(t) (k/μ)^k / Γ(k) · ∫ c^(k−1) exp(−w c − c²/2)
dc / σ, w = k/μ − t. Laplace's method, with the integral taken over log c, gives it up to a factor that
hardly varies. That factor depends on k and w alone. Its logarithm is kept in a table over cv and v =
c*²/(1 + k + c*²), c* the integrand's mode: the log-density is right to 0.005, and to 0.0003 up to a cv of
1.2.
"""

import math
from functools import partial

import numpy as np

from plume.compiled import kernel, subroutine
from plume.elementary import Array
from plume.numerics import HALF_LOG_2PI, erfc, exp, log
from plume.parameters import GREATEST_CV

CV_CELLS, MODE_CELLS = 60, 64  # cells of the table over cv from 0 to GREATEST_CV and over v from 0 to 1
SMALLEST_CV = 0.01  # least intermittency: a hundredth of the mean is far below every noise
SMALLEST_MEAN = 1e-6  # least mean, in standard deviations of the noise
NODES = 600  # nodes of the integrals behind the table
# The distribution function sums over concentrations: of BODY shares of 5% each, and of TAIL shares, each half
# of what is left.
BODY, TAIL = 18, 12


@subroutine
def _log_moment(power: float, w: float) -> float:
    """Log of ∫ c^(power−1) exp(−w c − c²/2) dc for a power of 1 or more, by the trapezoid rule over log c."""
    root = math.sqrt(w * w + 4 * power)
    mode = 2 * power / (root + w) if w > 0 else (root - w) / 2
    width = 1 / math.sqrt(power + mode * mode)
    low, high = log(mode) - 40 * width - 40 / power, log(mode) + min(40 * width, 4.0)
    top = power * log(mode) - mode * w - 0.5 * mode * mode
    total, step = 0.0, (high - low) / NODES
    for node in range(NODES + 1):
        at = low + node * step
        c = exp(at)
        total += exp(power * at - c * w - 0.5 * c * c - top)
    return top + log(total * step)


@kernel("float64[:, ::1]()")
def _corrections() -> Array:
    """The table (CV_CELLS + 1, MODE_CELLS + 1): log of what Laplace's method leaves out, 0 at v = 0."""
    result = np.zeros((CV_CELLS + 1, MODE_CELLS + 1))
    for row in range(1, CV_CELLS + 1):
        k = (CV_CELLS / (GREATEST_CV * row)) ** 2
        for column in range(MODE_CELLS):
            v = max(column / MODE_CELLS, 1e-7)
            c = math.sqrt((1 + k) * v / (1 - v))
            w = (k - c * c) / c
            if k >= 1:
                exact = _log_moment(k, w)
            else:  # by parts: the gas piles up at 0
                one, two = _log_moment(k + 1, w), _log_moment(k + 2, w)
                exact = one + log((w + exp(two - one)) / k)
            laplace = k * log(c) - c * w - 0.5 * c * c + HALF_LOG_2PI - 0.5 * log(k + c * c)
            result[row, column] = exact - laplace
        first = result[row, 0]
        for column in range(MODE_CELLS + 1):
            result[row, column] -= first
    return result


@kernel("float64[:, ::1]()")
def _concentrations() -> Array:
    """Concentrations (CV_CELLS + 1, BODY + TAIL) that stand for shares of the gas: the medians of the shares.

    They are in units of the mean.
    """
    result = np.ones((CV_CELLS + 1, BODY + TAIL))
    nodes = 20 * NODES
    cumulative = np.empty(nodes + 1)
    for row in range(1, CV_CELLS + 1):
        k = (CV_CELLS / (GREATEST_CV * row)) ** 2
        low, high = log(k) - 40 / k - 40 / math.sqrt(k), log(k + 40 * math.sqrt(k) + 40)
        step = (high - low) / nodes
        total, before = 0.0, 0.0
        for node in range(nodes + 1):
            at = low + node * step
            here = exp(k * (at - log(k)) - exp(at) + k)
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
            result[row, cell] = exp(low + (node - 1 + part) * step) / k
    return result


CORRECTIONS = _corrections()
CONCENTRATIONS = _concentrations()
# The share of the gas that each concentration stands for.
SHARES = np.array([0.05] * BODY + [0.05 * 0.5**cell for cell in range(TAIL - 1)] + [0.1 * 0.5 ** (TAIL - 1)])


@partial(subroutine, forceinline=True)
def _parts(gas: float, mean: float, variance: float, cv: float) -> tuple[float, float, float, float]:
    """Return (a, b, c, d) of a log-density a + (b + log c)/2 + d − log(2π)/2."""
    cv = max(cv, SMALLEST_CV)
    k = 1 / (cv * cv)
    inverse = 1 / math.sqrt(variance)
    t = gas * inverse
    mu = max(mean * inverse, SMALLEST_MEAN)
    a = k - t * mu  # μ w
    root = math.sqrt(a * a + 4 * k * mu * mu)
    ratio = 2 * k / (root + a) if a > 0 else (root - a) / (2 * mu * mu)  # c*/μ
    square = ratio * mu * ratio * mu
    total = k + square
    x = cv * (CV_CELLS / GREATEST_CV)
    row = min(int(x), CV_CELLS - 1)
    x -= row
    y = square / (1 + total) * MODE_CELLS
    column = min(int(y), MODE_CELLS - 1)
    y -= column
    low = CORRECTIONS[row, column] + y * (CORRECTIONS[row, column + 1] - CORRECTIONS[row, column])
    high = CORRECTIONS[row + 1, column] + y * (
        CORRECTIONS[row + 1, column + 1] - CORRECTIONS[row + 1, column]
    )
    return k * log(ratio), square - t * t, k * inverse * inverse / total, low + x * (high - low)


@partial(subroutine, forceinline=True)
def log_density(gas: float, mean: float, variance: float, cv: float) -> float:
    """Log-density of a reading: gas of this mean and coefficient of variation plus noise N(0, variance)."""
    log_ratio, square, factor, correction = _parts(gas, mean, variance, cv)
    return float(log_ratio + 0.5 * (square + log(factor)) + correction - HALF_LOG_2PI)


@partial(subroutine, forceinline=True)
def density(gas: float, mean: float, variance: float, cv: float) -> float:
    """Density of a reading, as `log_density`; it takes less time than exp of that."""
    log_ratio, square, factor, correction = _parts(gas, mean, variance, cv)
    return float(exp(log_ratio + 0.5 * square + correction - HALF_LOG_2PI) * math.sqrt(factor))


@subroutine
def exceeding(gas: float, mean: float, variance: float, cv: float) -> float:
    """P(Z > gas) of a reading, as by `distribution`; small ones keep their digits."""
    x = cv * (CV_CELLS / GREATEST_CV)
    row = min(int(x), CV_CELLS - 1)
    x -= row
    inverse, total = math.sqrt(0.5 / variance), 0.0
    low, high = CONCENTRATIONS[row], CONCENTRATIONS[row + 1]
    for cell in range(BODY + TAIL):
        total += SHARES[cell] * erfc((gas - mean * (low[cell] + x * (high[cell] - low[cell]))) * inverse)
    return 0.5 * total


@subroutine
def distribution(gas: float, mean: float, variance: float, cv: float, tails: Array) -> float:
    """P(Z ≤ gas) of a reading, as in `log_density`; right to about 0.01.

    tails: (BODY + TAIL,) to compute in.
    """
    x = cv * (CV_CELLS / GREATEST_CV)
    row = min(int(x), CV_CELLS - 1)
    x -= row
    inverse = math.sqrt(0.5 / variance)
    low, high = CONCENTRATIONS[row], CONCENTRATIONS[row + 1]
    for cell in range(BODY + TAIL):
        tails[cell] = SHARES[cell] * erfc((mean * (low[cell] + x * (high[cell] - low[cell])) - gas) * inverse)
    total = 0.0
    for cell in range(BODY + TAIL):
        total += tails[cell]
    return 0.5 * total
