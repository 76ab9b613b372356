"""The particle filter: a posterior over the source's position, one reading at a time (design: reweight, resample, move)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator import kernels
from link.mavlink import Reading
from plume.randomness import keyed
from plume.scenario import AREA_M, LIFETIME_S

Array = NDArray[np.float64]

RESAMPLE_BELOW = 0.5
"""Share of N that the effective sample size must keep."""
STAGE_FLOOR = 0.1
"""Where one reading would crush the effective sample size below this share of N, it is taken in tempered stages."""
PLASTIC_LATTICE = np.array([0.7548776662466927, 0.5698402909980532])
"""The powers of the inverse plastic number: the R2 sequence (Roberts 2018)."""
MAX_STAGES = 12
"""After so many stages the rest of a reading is taken at once: no reading, however absurd, may keep the filter busy for long."""
SWEEPS = 3
"""Metropolis sweeps after each resampling."""


@dataclass(frozen=True)
class Config:
    """What the estimator knows beforehand: all of the plume but the place of its source."""

    particles: int = 1000
    threshold_m: float = 0.5
    """ζ: AGDC stops when the spread is below it."""
    seed: int = 0
    rate: float = 300.0
    """q, g/s; the defaults of rate and diffusivity are the middle of Table 1."""
    diffusivity: float = 4.5
    """d, m²/s."""
    lifetime: float = LIFETIME_S
    """τ, s."""
    area_m: float = AREA_M

    def model(self) -> Array:
        """Return the constants in the order that the kernels take them."""
        return np.array([self.rate, self.diffusivity, self.lifetime, self.area_m])


@dataclass(frozen=True)
class Posterior:
    """Weighted particles and the readings behind them; never changed, only replaced."""

    particles: Array
    """(N, 2) m."""
    log_weights: Array
    """(N,) up to a constant."""
    log_targets: Array
    """(N,) log-likelihood of all readings so far at each particle."""
    readings: Array
    """(T, 5): x, y, wind_x, wind_y, gas."""


def prior(config: Config) -> Posterior:
    """Uniform over the area, as a low-discrepancy lattice with a random shift: each particle is uniform, together they leave no gaps."""
    lattice = np.arange(config.particles)[:, None] * PLASTIC_LATTICE
    shift = keyed(config.seed, "prior").random(2)
    particles = np.ascontiguousarray((lattice + shift) % 1.0 * config.area_m)
    zeros = np.zeros(config.particles)
    return Posterior(particles, zeros, zeros, np.empty((0, 5)))


def assimilate(posterior: Posterior, reading: Reading, config: Config) -> Posterior:
    """One reading: reweight, and where the weights degenerate, resample and move (Gordon 1993; Chopin 2002; tempering: Del Moral 2006)."""
    count = len(posterior.particles)
    model = config.model()
    row = np.array([*reading.position, *reading.wind, reading.gas])
    history = np.vstack([posterior.readings, row])
    posterior = replace(posterior, readings=history)
    exponent = 0.0
    stage = 0
    while True:
        log_likelihood = kernels.log_likelihoods(posterior.particles, row, model)
        left = 1.0 - exponent
        share = left if stage == MAX_STAGES else _tempered_share(posterior.log_weights, log_likelihood, left)
        exponent = 1.0 if share >= left else exponent + share
        posterior = replace(
            posterior,
            log_weights=posterior.log_weights + share * log_likelihood,
            log_targets=posterior.log_targets + share * log_likelihood,
        )
        if kernels.effective_sample_size(posterior.log_weights) < RESAMPLE_BELOW * count:
            posterior = _resample_and_move(posterior, exponent, config, len(history) - 1, stage)
            stage += 1
        if exponent == 1.0:
            return posterior


def _tempered_share(log_weights: Array, log_likelihood: Array, left: float) -> float:
    """Return the greatest exponent, at most `left`, at which the likelihood leaves STAGE_FLOOR · N effective particles."""
    floor = STAGE_FLOOR * len(log_weights)
    if kernels.effective_sample_size(log_weights + left * log_likelihood) >= floor:
        return left
    low, high = 0.0, left
    for _ in range(30):
        middle = 0.5 * (low + high)
        if kernels.effective_sample_size(log_weights + middle * log_likelihood) >= floor:
            low = middle
        else:
            high = middle
    return high


def _resample_and_move(posterior: Posterior, exponent: float, config: Config, step: int, stage: int) -> Posterior:
    """Resample in proportion to the weights, then let the copies move apart without changing the posterior they stand for."""
    rng = keyed(config.seed, f"move {stage}", step)
    count = len(posterior.particles)
    weights = kernels.normalised(posterior.log_weights)
    ancestors = kernels.systematic(weights, rng.random())
    particles = posterior.particles[ancestors]
    log_targets = posterior.log_targets[ancestors]
    steps = _proposal_steps(particles, rng)
    log_uniforms = np.log1p(-rng.random((SWEEPS, count)))
    kernels.metropolis(particles, log_targets, posterior.readings, exponent, config.model(), steps, log_uniforms)
    return replace(posterior, particles=particles, log_weights=np.zeros(count), log_targets=log_targets)


def _proposal_steps(particles: Array, rng: np.random.Generator) -> Array:
    """Symmetric steps (sweeps, N, 2): scaled differences of other particles (ter Braak 2006), which follow curved and split posteriors."""
    count = len(particles)
    one, other = rng.integers(count, size=(2, SWEEPS, count))
    scale = rng.choice([1.19, 0.6, 0.2], size=(SWEEPS, count, 1))  # 2.38/√(2·2), and finer ones for thin ridges
    _, _, xx, _, yy = kernels.moments(particles, np.full(count, 1 / count))
    jitter = 0.05 * np.sqrt([xx, yy]) * rng.standard_normal((SWEEPS, count, 2))
    return np.ascontiguousarray(scale * (particles[one] - particles[other]) + jitter)
