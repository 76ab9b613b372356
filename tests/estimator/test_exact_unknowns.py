"""Protects the filter with a third unknown: 50 missions each with the wind's direction, the gain or the
intermittency of the gas.
"""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from estimator.filter import Config, assimilate, prior
from estimator.kernels.weights import moments
from estimator.priors import LogNormal, Normal, Prior
from link.bus.mavlink import Reading
from plume.dispersion import concentration
from plume.scenario import Scenario, draw
from plume.sensors.sensor import Gaussian
from tests.estimator.exact_cells import (
    CellPosterior,
    Likelihood,
    plume_mean,
    with_cv,
    with_log_gain,
    with_wind_direction,
)

MISSIONS, STEPS, WANDERING, PARTICLES = 50, 26, 8, 2000
COMPARED = (9, 17, 21, 25)
NARROW_M = 5.0
"""As in test_exact.py: above this spread a posterior is close to the prior."""

CASES: dict[str, tuple[Prior, Likelihood, tuple]] = {
    "wind-direction": (Normal(0.0, 20.0), with_wind_direction, (-100.0, 100.0, 20.0, (40, 40, 25))),
    "gain": (LogNormal(1.0, 0.5), with_log_gain, (-3.0, 3.0, 0.5, (40, 40, 24))),
    # The density of cv ends abruptly at 0 and 3; a quarter of the cells gives the same moments to 0.01
    # standard deviations.
    "cv": (Normal(0.0, 1.2), with_cv, (0.0, 3.0, 1.2, (40, 40, 12), 0.2)),
}
"""Prior, likelihood and grid of each; the gain's coordinate is its logarithm."""


def flight(s: Scenario, seed: int, unknown: str) -> Iterator[Reading]:
    """A flight that no belief has chosen: towards the source, at first not at all straight. The third
    unknown is drawn from its prior.

    Where the wind's direction is measured with an error, the wind turns and changes its speed between
    readings; the error stays.
    """
    rng = np.random.default_rng(seed)
    standard = rng.standard_normal()
    off = math.radians(20 * standard) if unknown == "wind-direction" else 0.0
    gain = math.exp(0.5 * standard) if unknown == "gain" else 1.0
    sensor = Gaussian(cv=min(abs(1.2 * standard), 3.0) if unknown == "cv" else 0.0)
    changes = unknown == "wind-direction"
    place = np.array(s.start)
    for step in range(STEPS):
        u, phi = (
            (s.u * (1 + 0.3 * math.sin(step / 5)), s.phi + 0.6 * math.sin(step / 3))
            if changes
            else (s.u, s.phi)
        )
        true_wind, wind = ((u * math.cos(angle), u * math.sin(angle)) for angle in (phi, phi - off))
        mean = gain * concentration(place, s.source, true_wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)
        yield Reading(step, (float(place[0]), float(place[1])), 5.0, wind, float(sensor.measure(mean, rng)))
        heading = math.atan2(s.source[1] - place[1], s.source[0] - place[0]) + rng.normal(
            0, 0.9 if step < WANDERING else 0.5
        )
        place = np.clip(place + np.array([math.cos(heading), math.sin(heading)]), 0, 30)


@pytest.mark.full
@pytest.mark.parametrize("unknown", ["gain", "wind-direction", "cv"])
def test_every_belief_with_a_third_unknown_is_the_exact_posterior(unknown: str) -> None:
    about, likelihood, grid = CASES[unknown]
    rows = []
    for seed in range(1_000_000, 1_000_000 + MISSIONS):
        s = draw(seed)
        config = Config(
            PARTICLES, seed=seed, rate=s.q, diffusivity=s.d, lifetime=s.tau, priors={unknown: about}
        )
        exact, posterior = CellPosterior(likelihood, (s.q, s.d, s.tau), *grid), prior(config)
        for step, reading in enumerate(flight(s, seed, unknown)):
            exact.add((*reading.position, *reading.wind, reading.gas))
            posterior = assimilate(posterior, reading, config)
            if step not in COMPARED:
                continue
            particles = posterior.particles.copy()
            if unknown == "gain":
                particles[2] = np.log(particles[2])
            (mean, covariance), (wanted, wanted_covariance) = (
                moments(particles, posterior.weights),
                exact.moments(),
            )
            spread, std = math.sqrt(np.trace(wanted_covariance[:2, :2])), math.sqrt(wanted_covariance[2, 2])
            covariance_error = np.linalg.norm((covariance - wanted_covariance)[:2, :2]) / np.linalg.norm(
                wanted_covariance[:2, :2]
            )
            ratio = math.sqrt(np.trace(covariance[:2, :2])) / spread
            third = (mean[2] - wanted[2]) / std, math.sqrt(covariance[2, 2]) / std - 1
            rows.append((spread, math.dist(mean[:2], wanted[:2]) / spread, covariance_error, ratio, *third))
    spread, mean_error, covariance_error, ratio, third, third_std = np.array(rows).T
    narrow = spread < NARROW_M
    assert narrow.sum() > 50
    assert spread.min() < 0.2
    root = math.sqrt(PARTICLES)
    # The margins of test_exact.py: the particles are worth at least a tenth as many independent draws.
    assert np.median(mean_error[narrow]) < 2.6 / root
    assert np.median(covariance_error[narrow]) < 3.0 / root
    assert np.mean(np.abs(ratio[narrow] - 1) < 0.05 * math.sqrt(4000 / PARTICLES)) > 0.9
    assert abs(np.median(ratio[narrow]) - 1) < 0.01 * math.sqrt(4000 / PARTICLES)
    assert not ((ratio < 0.5) | (mean_error > 1)).any()
    # A tenth as many draws miss the third unknown's mean by √10/√n of its standard deviation, and that by
    # √(10/2)/√n.
    assert math.sqrt(np.mean(third**2)) < math.sqrt(10) / root
    assert math.sqrt(np.mean(third_std**2)) < 3.2 / root  # a posterior with heavy tails errs by √2 more
    # Errors of 50 missions cancel: what is left of independent draws is a seventh; 4 standard errors.
    assert abs(third.mean()) < 4 * math.sqrt(10) / root / math.sqrt(MISSIONS)


def test_the_cells_know_the_priors_alone_before_any_reading() -> None:
    for likelihood, grid, mean, std in (
        (with_wind_direction, CASES["wind-direction"][2], 0.0, 20.0),
        (with_log_gain, CASES["gain"][2], 0.0, 0.5),
        # Half-normal to 2.5 standard deviations: mean 0.92690, E x² = 1.44 (1 − 2.5 φ(2.5)/(Φ(2.5) − ½)) =
        # 1.31220: std 0.6731
        (with_cv, CASES["cv"][2], 0.9269, 0.6731),
    ):
        exact = CellPosterior(likelihood, (300.0, 4.0, 10.0), *grid)
        exact.settle()
        said, covariance = exact.moments()
        assert said == pytest.approx([15.0, 15.0, mean], abs=0.01)
        assert np.sqrt(np.diag(covariance)) == pytest.approx(
            [30 / math.sqrt(12), 30 / math.sqrt(12), std], rel=0.01
        )


def test_the_cells_likelihoods_equal_hand_worked_values() -> None:
    from scipy import integrate, stats

    # d = 1, wind 3 from the east, τ = 1/4, q = 4π: 1 m downwind m = exp(−1), upwind exp(−4) (test_exact.py).
    release = (4 * math.pi, 1.0, 0.25)
    x, y = np.array([11.0, 9.0]), np.array([10.0, 10.0])
    # A wind measured from the north that is off by −90° comes from the east; half the gain halves a doubled
    # plume.
    assert plume_mean(x, y, (10.0, 10.0), np.array(3.0), np.array(0.0), release) == pytest.approx(
        [math.exp(-1), math.exp(-4)]
    )
    expected = [
        -0.5 * ((0.5 - m) ** 2 / (0.09 * m**2 + 0.04) + math.log(0.09 * m**2 + 0.04))
        for m in (math.exp(-1), math.exp(-4))
    ]
    assert with_wind_direction(
        x, y, np.full(2, -90.0), (10.0, 10.0, 0.0, 3.0, 0.5), release
    ) == pytest.approx(expected)
    doubled = (8 * math.pi, 1.0, 0.25)
    assert with_log_gain(
        x, y, np.full(2, math.log(0.5)), (10.0, 10.0, 3.0, 0.0, 0.5), doubled
    ) == pytest.approx(expected)
    # cv = 1, m = e⁻¹: a fifth is blank. Other readings have gas of mean 1.25 m and of squared cv 0.7322609, and
    # normal noise of variance 0.0117391 (1.25 m)² + 0.04 (test_intermittency.py).
    m, there = math.exp(-1), 1.25 * math.exp(-1)
    std = math.sqrt(0.0117391 * there**2 + 0.04)
    law = stats.invgauss(0.7322609, scale=there / 0.7322609)
    loud = integrate.quad(lambda c: law.pdf(c) * stats.norm.pdf(0.5, c, std), 0, 8 * there, epsabs=1e-10)[0]
    silent = stats.norm.pdf(0.5, 0, math.sqrt(0.09 * m**2 + 0.04))
    # 2π is left out by the table, as everywhere here.
    log_density = math.log((0.2 * silent + 0.8 * loud) * math.sqrt(2 * math.pi))
    assert with_cv(x[:1], y[:1], np.ones(1), (10.0, 10.0, 3.0, 0.0, 0.5), release) == pytest.approx(
        [log_density], abs=1e-4
    )
