"""Protects the background of a gas sensor: gas only adds, so a plume on the way moves it hardly."""

import numpy as np
import pytest

from ground.tlog.background import clean_air


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
def test_gas_in_a_third_of_the_values_moves_the_background_by_less_than_half_the_noise(share: float) -> None:
    draws = np.random.default_rng(3)
    values = 2.0 + 0.1 * draws.normal(size=3000)
    values[: round(3000 * share)] += draws.exponential(3.0, round(3000 * share))
    clean = clean_air(values)
    assert clean.background == pytest.approx(2.0, abs=0.05)
    assert clean.noise == pytest.approx(0.1, rel=0.4)
    assert clean.share == pytest.approx(0.97 * (1 - share), abs=0.06)


def test_whole_numbers_have_the_noise_of_rounding() -> None:
    clean = clean_air(np.array([57.0] * 90 + [58.0, 200.0]))
    assert (clean.background, clean.noise) == (57.0, pytest.approx(1 / np.sqrt(12)))


def test_a_smooth_plume_without_noise_leaves_a_fifth_as_clean_air() -> None:
    values = 1.95 + np.exp(-np.linspace(0.0, 12.0, 1000))
    clean = clean_air(values)
    assert clean.share >= 0.2
    assert clean.background == pytest.approx(1.95, abs=2e-3)
    assert clean.noise >= 0.9e-3


@pytest.mark.parametrize("values", [[3.0], [0.0], [-2.0, -2.0], [1.0, 5.0]])
def test_few_values_have_a_noise_above_zero(values: list[float]) -> None:
    clean = clean_air(np.array(values))
    assert clean.background in values or clean.background == np.mean(values)
    assert clean.noise > 0
