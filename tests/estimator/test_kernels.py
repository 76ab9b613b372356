"""Protects the compiled kernels: each equals the readable formula, and the moves leave the posterior alone."""

import math

import numpy as np
import pytest

from estimator import kernels
from plume.dispersion import concentration
from plume.sensor import log_likelihood

MODEL = np.array([270.0, 4.2, 10.0, 30.0])
READING = np.array([14.0, 13.0, 1.9, 2.6, 3.75])


def test_the_fused_likelihood_equals_the_readable_one() -> None:
    particles = np.random.default_rng(1).uniform(0, 30, (5000, 2))
    mean = concentration(READING[:2], particles, READING[2:4], rate=270.0, diffusivity=4.2, lifetime=10.0)
    assert kernels.log_likelihoods(particles, READING, MODEL) == pytest.approx(log_likelihood(3.75, mean), rel=1e-12, abs=1e-12)


def test_the_fused_likelihood_clamps_the_distance_too() -> None:
    at_the_source = np.array([[14.0, 13.0], [14.0, 13.1]])
    mean = concentration(READING[:2], at_the_source, READING[2:4], rate=270.0, diffusivity=4.2, lifetime=10.0)
    assert kernels.log_likelihoods(at_the_source, READING, MODEL) == pytest.approx(log_likelihood(3.75, mean), rel=1e-12)


def test_effective_sample_size_counts_equal_weights_and_ignores_a_common_factor() -> None:
    assert kernels.effective_sample_size(np.full(8, -1000.0)) == pytest.approx(8.0)
    assert kernels.effective_sample_size(np.log([0.5, 0.5, 1e-300])) == pytest.approx(2.0)
    assert kernels.effective_sample_size(np.log([0.8, 0.2]) - 5000.0) == pytest.approx(1 / (0.64 + 0.04))


def test_moments_equal_the_hand_worked_values() -> None:
    particles = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 2.0]])
    weights = np.array([0.5, 0.25, 0.25])
    # mean (1, 0.5);  xx = 4 − 1, xy = 0 − 0.5, yy = 1 − 0.25
    assert kernels.moments(particles, weights) == pytest.approx((1.0, 0.5, 3.0, -0.5, 0.75))


def test_systematic_resampling_copies_each_particle_its_expected_number_of_times_rounded() -> None:
    weights = np.random.default_rng(2).dirichlet(np.full(50, 0.3))
    for offset in (0.0, 0.25, 0.999):
        copies = np.bincount(kernels.systematic(weights, offset), minlength=50)
        assert copies.sum() == 50
        assert np.all(np.abs(copies - 50 * weights) < 1)


def test_systematic_resampling_is_exact_at_its_edges() -> None:
    assert kernels.systematic(np.array([0.25, 0.25, 0.25, 0.25]), 0.0).tolist() == [0, 1, 2, 3]
    assert kernels.systematic(np.array([0.0, 0.0, 1.0]), 0.0).tolist() == [2, 2, 2]
    assert kernels.systematic(np.array([1.0, 0.0, 0.0]), 0.999).tolist() == [0, 0, 0]


def grid_density(readings: np.ndarray, exponent: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Cell centres and probabilities of the exact posterior, from the readable formulas."""
    axis = (np.arange(cells) + 0.5) * 30.0 / cells
    places = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    log_density = np.zeros(len(places))
    for t, row in enumerate(readings):
        mean = concentration(row[:2], places, row[2:4], rate=270.0, diffusivity=4.2, lifetime=10.0)
        log_density += (exponent if t == len(readings) - 1 else 1.0) * log_likelihood(row[4], mean)
    density = np.exp(log_density - log_density.max())
    return places, density / density.sum()


@pytest.mark.parametrize("exponent", [1.0, 0.4])
def test_moves_leave_the_posterior_given_all_readings_invariant(exponent: float) -> None:
    readings = np.array([[8.0, 8.0, 1.9, 2.6, 0.9], [12.0, 9.0, 1.9, 2.6, 2.5], [11.0, 12.0, 1.9, 2.6, 1.1]])
    places, probability = grid_density(readings, exponent, 600)
    rng = np.random.default_rng(3)
    count = 20_000
    start = places[rng.choice(len(places), count, p=probability)] + rng.uniform(-0.025, 0.025, (count, 2))  # exact draws
    targets = sum((exponent if t == 2 else 1.0) * kernels.log_likelihoods(start, row, MODEL) for t, row in enumerate(readings))
    moved = start.copy()
    steps = np.ascontiguousarray(rng.normal(0.0, 2.0, (20, count, 2)))
    rate = kernels.metropolis(moved, targets, readings, exponent, MODEL, steps, np.log(rng.random((20, count))))
    assert 0.05 < rate < 0.95
    assert moved.min() >= 0.0
    assert moved.max() <= 30.0
    mean, std = probability @ places, np.sqrt(probability @ places**2 - (probability @ places) ** 2)
    # 20,000 independent chains: 4 standard errors of the mean, and of the standard deviation (heavy tails: twice the Gaussian one).
    assert np.all(np.abs(moved.mean(axis=0) - mean) < 4 * std / math.sqrt(count))
    assert np.all(np.abs(moved.std(axis=0) - std) < 4 * std * 2 / math.sqrt(2 * count))


def test_early_rejection_changes_no_decision() -> None:
    """A plain Metropolis step, written out, accepts the same proposals."""
    readings = np.array([[8.0, 8.0, 1.9, 2.6, 0.9], [12.0, 9.0, 1.9, 2.6, 2.5], [11.0, 12.0, 1.9, 2.6, 1.1]])
    rng = np.random.default_rng(4)
    start = rng.uniform(0, 30, (2000, 2))
    steps, log_uniforms = np.ascontiguousarray(rng.normal(0, 4, (1, 2000, 2))), np.log(rng.random((1, 2000)))

    def target(places: np.ndarray) -> np.ndarray:
        return np.sum([kernels.log_likelihoods(np.ascontiguousarray(places), row, MODEL) for row in readings], axis=0)

    proposals = start + steps[0]
    inside = ((proposals >= 0) & (proposals <= 30)).all(axis=1)
    accepted = inside & (target(proposals) >= target(start) + log_uniforms[0])
    moved = start.copy()
    kernels.metropolis(moved, target(start), readings, 1.0, MODEL, steps, log_uniforms)
    assert np.array_equal(moved, np.where(accepted[:, None], proposals, start))
