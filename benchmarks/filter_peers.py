"""Three peer filters for the benchmark: Stone Soup's, IBIS of the package `particles`, and plain NumPy.

Each has the same knowledge as our filter (wind with each reading; q, d, τ beforehand), as many particles
and the same uniform prior.
The libraries are imported when a peer is created: importing this module needs neither.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plume.dispersion import SOURCE_RADIUS_M

Array = NDArray[np.float64]

SENSOR_NOISE = 0.3
"""α of the Gaussian sensor: σ² = (α m)² + β²."""
ENVIRONMENT_NOISE = 0.2
"""β, g/m³."""
RESAMPLE_BELOW = 0.5
"""Resample when the effective sample size falls below this share of N; also Stone Soup's default."""
SWEEPS = 3
"""Metropolis sweeps after each resampling; Stone Soup's regulariser always makes one."""


@dataclass
class Peer(ABC):
    """A particle filter over the source's position."""

    count: int
    seed: int
    rate: float
    """q, g/s."""
    diffusivity: float
    """d, m²/s."""
    lifetime: float
    """τ, s."""
    area_m: float
    moves: bool = True
    """False: reweight only, without resampling or moves."""

    @abstractmethod
    def update(self, row: Array) -> None:
        """Assimilate one reading (x, y, wind_x, wind_y, gas): m, m, m/s, m/s, g/m³."""

    def log_likelihood(self, x: Array, y: Array, row: Array) -> Array:
        """Log-density of one reading for sources at (x, y): the plume model of `plume/dispersion.py` and
        the Gaussian sensor.
        """
        sensor_x, sensor_y, wind_x, wind_y, gas = row
        d, tau = self.diffusivity, self.lifetime
        decay_length = math.sqrt(d * tau / (1 + (wind_x**2 + wind_y**2) * tau / (4 * d)))
        dx, dy = sensor_x - x, sensor_y - y
        distance = np.maximum(np.sqrt(dx * dx + dy * dy), SOURCE_RADIUS_M)
        exponent = -distance / decay_length - (dx * wind_x + dy * wind_y) / (2 * d)
        mean = self.rate / (4 * math.pi * d) / distance * np.exp(exponent)
        variance = (SENSOR_NOISE * mean) ** 2 + ENVIRONMENT_NOISE**2
        log_density: Array = -0.5 * ((gas - mean) ** 2 / variance + np.log(2 * math.pi * variance))
        return log_density


@dataclass
class StoneSoup(Peer):
    """Stone Soup's `ParticleUpdater`, gas model, `ESSResampler` and `MCMCRegulariser`, combined as in its
    own gas example.

    Differences from our filter:
    - σ is α m + β: the noises are added, not combined in quadrature. This σ is up to 1.4 times ours. The
      sensing threshold is set below
      all readings.
    - The regulariser makes one sweep. Its target is the newest reading's likelihood times a Gaussian
      around
      the particle's previous
      position, not the posterior given all readings. The result is close to that posterior, but not equal.
    - Likelihoods are exponentiated before the log is taken: if every particle is 38 σ or more from the
      reading, all weights become NaN.

    The state is (x, y). With the model's own eight dimensions, six of them known, reweighting takes
    equally long, and the regulariser raises, because it needs a regular covariance. The example's
    predictor is omitted: it does not change a source that stays.
    """

    def __post_init__(self) -> None:
        """Set up the updater and the prior."""
        from stonesoup.base import Property
        from stonesoup.models.measurement.gas import IsotropicPlume
        from stonesoup.regulariser.particle import MCMCRegulariser
        from stonesoup.resampler.particle import ESSResampler
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.prediction import Prediction
        from stonesoup.types.state import ParticleState, State, StateVector, StateVectors
        from stonesoup.updater.particle import ParticleUpdater

        class PlumeOfKnownRelease(IsotropicPlume):  # type: ignore[misc]
            """Stone Soup's plume for a state in which only x and y are unknown."""

            known: Any = Property(
                doc="The other six of its eight dimensions, (6, 1): z, Q, u, φ, ζ₁ (d), ζ₂ (τ)"
            )

            def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
                known = np.broadcast_to(self.known, (6, state.state_vector.shape[1]))
                return super().function(
                    State(StateVectors(np.vstack([state.state_vector, known]))), noise, **kwargs
                )

        def hypothesis(state: Any, row: Array) -> Any:
            x, y, wind_x, wind_y, gas = row
            model = PlumeOfKnownRelease(
                known=np.array(
                    [
                        [
                            0,
                            self.rate,
                            math.hypot(wind_x, wind_y),
                            math.atan2(wind_y, wind_x),
                            self.diffusivity,
                            self.lifetime,
                        ]
                    ]
                ).T,
                translation_offset=StateVector([x, y, 0]),
                standard_deviation_percentage=SENSOR_NOISE,
                min_noise=ENVIRONMENT_NOISE,
                sensing_threshold=-np.inf,
                missed_detection_probability=0,
            )
            return SingleHypothesis(
                Prediction.from_state(state, parent=state),
                Detection(StateVector([gas]), measurement_model=model),
            )

        def outside(state: Any) -> Any:
            return ((state.state_vector < 0) | (state.state_vector > self.area_m)).any(axis=0)

        np.random.seed(self.seed)  # noqa: NPY002  Stone Soup draws from NumPy's global state
        particles = np.random.default_rng(self.seed).uniform(0, self.area_m, (2, self.count))
        self._state: Any = ParticleState(
            StateVectors(particles), log_weight=np.full(self.count, -math.log(self.count))
        )
        resampling = {"resampler": ESSResampler(), "regulariser": MCMCRegulariser(constraint_func=outside)}
        self._updater = ParticleUpdater(None, **resampling if self.moves else {})
        self._hypothesis = hypothesis

    def update(self, row: Array) -> None:
        """Assimilate one reading."""
        self._state = self._updater.update(self._hypothesis(self._state, row))


@dataclass
class Particles(Peer):
    """IBIS (Chopin 2002) of the package `particles`, its method for a static parameter: one reading per
    step, random-walk Metropolis.

    The model is ours. Differences: it resamples and moves at the start of the step after the weights
    degenerated; it has no tempering; if a reading leaves one particle with all the weight, it raises (the
    proposal's covariance is singular).
    """

    waste_free: bool = False
    """The library's default is True (Dau & Chopin 2022): move count/(1 + SWEEPS) particles, keep every
    state of their chains.
    """

    def __post_init__(self) -> None:
        """Set up the sampler."""
        from particles import SMC
        from particles.distributions import StructDist, Uniform
        from particles.smc_samplers import IBIS, StaticModel

        log_likelihood = self.log_likelihood

        class Plume(StaticModel):  # type: ignore[misc]
            """The readings so far, and the density of each."""

            def logpyt(self, theta: Any, t: int) -> Array:
                return log_likelihood(theta["x"], theta["y"], self.data[t])

        np.random.seed(self.seed)  # noqa: NPY002  particles draws from NumPy's global state
        self._readings: list[Array] = []
        prior = StructDist({"x": Uniform(0, self.area_m), "y": Uniform(0, self.area_m)})
        chain = 1 + SWEEPS
        self._smc = SMC(
            fk=IBIS(Plume(data=self._readings, prior=prior), wastefree=self.waste_free, len_chain=chain),
            N=self.count // chain if self.waste_free else self.count,
            ESSrmin=RESAMPLE_BELOW if self.moves else 0.0,
            collect="off",
        )

    def update(self, row: Array) -> None:
        """Assimilate one reading."""
        self._readings.append(row)
        next(self._smc)


@dataclass
class PlainNumpy(Peer):
    """Vectorised NumPy: our filter without compiled loops, tempering or early rejection, with a Gaussian
    random-walk proposal.
    """

    def __post_init__(self) -> None:
        """Draw the prior."""
        self._rng = np.random.default_rng(self.seed)
        self._particles = self._rng.uniform(0, self.area_m, (2, self.count))
        self._log_weights = np.zeros(self.count)
        self._log_posterior = np.zeros(self.count)
        self._readings: list[Array] = []

    def update(self, row: Array) -> None:
        """Assimilate one reading: reweight; resample and move if the weights degenerate."""
        self._readings.append(row)
        log_likelihood = self.log_likelihood(self._particles[0], self._particles[1], row)
        self._log_weights = self._log_weights + log_likelihood
        self._log_posterior = self._log_posterior + log_likelihood
        if self.moves:
            weights = np.exp(self._log_weights - self._log_weights.max())
            weights /= weights.sum()
            if 1 / (weights @ weights) < RESAMPLE_BELOW * self.count:
                covariance = np.cov(self._particles, aweights=weights, ddof=0)
                self._resample(weights)
                self._move(covariance)

    def _resample(self, weights: Array) -> None:
        """Systematic resampling."""
        cumulative = np.cumsum(weights)
        points = (np.arange(self.count) + self._rng.random()) / self.count
        ancestors = np.searchsorted(cumulative / cumulative[-1], points)
        self._particles = self._particles[:, ancestors]
        self._log_posterior = self._log_posterior[ancestors]
        self._log_weights = np.zeros(self.count)

    def _move(self, covariance: Array) -> None:
        """Metropolis sweeps that leave the posterior given all readings invariant."""
        scale = 2.38 / math.sqrt(2) * np.linalg.cholesky(covariance + 1e-9 * np.eye(2))
        for _ in range(SWEEPS):
            proposals = self._particles + scale @ self._rng.standard_normal((2, self.count))
            log_posterior = np.sum(
                [self.log_likelihood(proposals[0], proposals[1], row) for row in self._readings], axis=0
            )
            inside = ((proposals >= 0) & (proposals <= self.area_m)).all(axis=0)
            accepted = inside & (
                log_posterior - self._log_posterior > -self._rng.standard_exponential(self.count)
            )
            self._particles = np.where(accepted, proposals, self._particles)
            self._log_posterior = np.where(accepted, log_posterior, self._log_posterior)
