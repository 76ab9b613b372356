"""Protects the functions that replace those of the C library and NumPy: right to the last bits, and made
of IEEE operations alone.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
from numba import njit

from plume import elementary, numerics

DRAWS = np.random.default_rng(30)


@njit
def compiled(function: int, values: np.ndarray) -> np.ndarray:
    result = np.empty(len(values))
    for i in range(len(values)):
        x = values[i]
        if function == 0:
            result[i] = numerics.log1p(x)
        elif function == 1:
            result[i] = numerics.log_gamma(x)
        elif function == 2:
            result[i] = numerics.cosine_and_sine(x)[0]
        elif function == 3:
            result[i] = numerics.cosine_and_sine(x)[1]
        else:
            result[i] = numerics.angle_of(math.cos(x), math.sin(x))
    return result


@pytest.mark.filterwarnings("error")
def test_exp_and_log_are_right_to_the_last_bits() -> None:
    x = np.concatenate([DRAWS.uniform(-700, 700, 2000), DRAWS.normal(0, 1, 2000), [0.0]])
    for exp in (elementary.exp, numerics.exp_each):
        assert exp(x) == pytest.approx(np.exp(x), rel=5e-16)
        assert exp([[0.0, -1000.0]]) == pytest.approx(np.array([[1.0, math.exp(-708)]]))
        assert np.isnan(exp([np.nan])).all()
    positive = np.concatenate(
        [np.exp(DRAWS.uniform(-300, 300, 2000)), 1 + DRAWS.uniform(-0.4, 0.4, 2000), [1.0]]
    )
    for log in (elementary.log, numerics.log_each):
        assert log(positive) == pytest.approx(np.log(positive), rel=5e-16, abs=1e-300)


def test_cosine_and_sine_of_turns_are_right_and_exact_at_the_quarters() -> None:
    turns = DRAWS.uniform(-3, 3, 4000)
    cosine, sine = elementary.direction(turns)
    assert cosine == pytest.approx(np.cos(2 * np.pi * turns), abs=6e-15)  # the angle itself is rounded
    assert sine == pytest.approx(np.sin(2 * np.pi * turns), abs=6e-15)
    cosine, sine = elementary.direction(np.arange(-4, 5) / 4)
    assert cosine.tolist() == [1, 0, -1, 0, 1, 0, -1, 0, 1]
    assert sine.tolist() == [0, 1, 0, -1, 0, 1, 0, -1, 0]


def test_the_functions_of_compiled_loops_are_right() -> None:
    small = np.concatenate([DRAWS.uniform(-0.99, 2, 1000), DRAWS.normal(0, 1e-9, 1000)])
    assert compiled(0, small) == pytest.approx(np.log1p(small), rel=1e-15, abs=1e-30)
    counts = np.concatenate([np.arange(1.0, 30.0), np.exp(DRAWS.uniform(0, 30, 1000))])
    assert compiled(1, counts) == pytest.approx(
        [math.lgamma(count) for count in counts.tolist()], rel=1e-14, abs=1e-14
    )
    angles = np.concatenate([DRAWS.uniform(-9, 9, 2000), [0.0, -1e-18, 1e-18]])
    assert compiled(2, angles) == pytest.approx(np.cos(angles), abs=4e-15)
    assert compiled(3, angles) == pytest.approx(np.sin(angles), abs=4e-15)
    within = DRAWS.uniform(-3.14, 3.14, 2000)
    assert compiled(4, within) == pytest.approx(within, abs=4e-15)


def test_erfc_is_right_far_into_its_tail() -> None:
    x = np.concatenate([DRAWS.uniform(-6, 26, 3000), [0.0, 30.0, -30.0]])
    wanted = np.array([math.erfc(value) for value in x.tolist()])
    assert np.abs(numerics.erfc_each(x) - wanted) == pytest.approx(0, abs=1e-300) or np.all(
        np.abs(numerics.erfc_each(x) - wanted) <= 1e-15 * (1 + x * x) * wanted + 1e-300
    )


def test_a_sum_is_added_in_its_own_order() -> None:
    """Eight interleaved sums: the value of each rounding is computed with fractions."""

    def rounded(numbers: list[float]) -> float:
        total = 0.0
        for number in numbers:
            total = float(Fraction(total) + Fraction(number))
        return total

    values = DRAWS.normal(0, 1, 40) * 10.0 ** DRAWS.uniform(-8, 8, 40)
    a, b, c, d, e, f, g, h = (rounded(values[k::8].tolist()) for k in range(8))
    assert njit(lambda x: numerics.total_of(x))(values) == ((a + b) + (c + d)) + ((e + f) + (g + h))
