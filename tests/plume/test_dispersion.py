"""Protects the plume: hand-worked concentrations, the sign of the wind, the clamp at the source."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plume.dispersion import concentration

SOURCE = (15.0, 15.0)
ILLUSTRATION = {
    "rate": 5.0,
    "diffusivity": 2.0,
    "lifetime": 10.0,
}  # the paper's: q 5, u 2, phi 45 degrees, d 2, tau 10
WIND_FROM_45_DEGREES = (math.sqrt(2.0), math.sqrt(2.0))  # u (cos φ, sin φ), u = 2


def test_downwind_concentration_equals_the_hand_worked_value() -> None:
    # λ = sqrt(2·10 / (1 + 4·10/8)) = sqrt(20/6) = 1.8257419;  2 m downwind: ψ = −(−2·2)/(2·2) = +1;
    # m = 5/(4π·2·2) · exp(−2/1.8257419 + 1) = 0.0994718 · exp(−0.0954451) = 0.0904168
    position = (15.0 - math.sqrt(2.0), 15.0 - math.sqrt(2.0))
    assert concentration(position, SOURCE, WIND_FROM_45_DEGREES, **ILLUSTRATION) == pytest.approx(
        0.0904168, rel=1e-5
    )


def test_upwind_concentration_equals_the_hand_worked_value() -> None:
    # 2 m upwind: ψ = −1;  m = 0.0994718 · exp(−1.0954451 − 1) = 0.0122366
    position = (15.0 + math.sqrt(2.0), 15.0 + math.sqrt(2.0))
    assert concentration(position, SOURCE, WIND_FROM_45_DEGREES, **ILLUSTRATION) == pytest.approx(
        0.0122366, rel=1e-5
    )


def test_crosswind_concentration_equals_the_hand_worked_value() -> None:
    # 2 m across the wind: ψ = 0;  m = 0.0994718 · exp(−1.0954451) = 0.0332625
    position = (15.0 - math.sqrt(2.0), 15.0 + math.sqrt(2.0))
    assert concentration(position, SOURCE, WIND_FROM_45_DEGREES, **ILLUSTRATION) == pytest.approx(
        0.0332625, rel=1e-5
    )


def test_gas_lies_downwind_of_the_source() -> None:
    wind_from_the_east = (3.0, 0.0)
    west = concentration((10.0, 15.0), SOURCE, wind_from_the_east, **ILLUSTRATION)
    east = concentration((20.0, 15.0), SOURCE, wind_from_the_east, **ILLUSTRATION)
    assert west / east == pytest.approx(math.exp(2 * 5 * 3 / (2 * 2.0)))


def test_without_wind_the_plume_is_round() -> None:
    around = [(15.0 + 3 * math.cos(a), 15.0 + 3 * math.sin(a)) for a in np.linspace(0, 6, 7)]
    # λ = sqrt(2·10) = 4.4721360;  m = 5/(4π·2·3) · exp(−3/4.4721360) = 0.0663146 · 0.5112889 = 0.0339059
    assert concentration(around, SOURCE, (0.0, 0.0), **ILLUSTRATION) == pytest.approx(
        np.full(7, 0.0339059), rel=1e-5
    )


def test_nearer_than_the_source_radius_counts_as_the_radius() -> None:
    # r = 0.1, no wind: m = 5/(4π·2·0.1) · exp(−0.1/4.4721360) = 1.9894368 · 0.9778877
    for distance in (0.0, 0.05, 0.1):
        assert concentration((15.0 + distance, 15.0), SOURCE, (0.0, 0.0), **ILLUSTRATION) == pytest.approx(
            1.9454457, rel=1e-6
        )


@given(
    st.tuples(*[st.floats(0, 30)] * 2),
    st.tuples(*[st.floats(-40, 40)] * 2),
    st.floats(1e-3, 1e4),
    st.floats(0.05, 100),
    st.floats(0.01, 1e4),
)
def test_no_weather_makes_it_infinite_or_negative(
    position: tuple[float, float], wind: tuple[float, float], rate: float, diffusivity: float, lifetime: float
) -> None:
    value = concentration(position, SOURCE, wind, rate=rate, diffusivity=diffusivity, lifetime=lifetime)
    assert (
        0.0
        <= value
        <= rate
        / (4 * math.pi * diffusivity * 0.1)
        * 1.0001
        * math.exp(math.hypot(*wind) * 0.1 / (2 * diffusivity))
    )
