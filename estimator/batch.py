"""Posteriors of many missions at once, by the same kernel as for one: mission i is bit-identical to
mission i run alone.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from estimator.belief import evidence, fit, locates, may_claim, sure_enough
from estimator.filter import Config, Posterior, prior
from estimator.kernels.update import update_missions
from estimator.kernels.weights import moments_of_missions

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MISSIONS_PER_TASK = 8
"""Most missions that a thread takes at once; small portions balance the load, since missions differ much
in cost.
"""


class Batch:
    """Missions side by side, each at its own step; changed in place. All have the same number of particles
    and the same unknowns.
    """

    def __init__(self, configs: Sequence[Config], threads: int = 1) -> None:
        """Begin with the priors. Raises ValueError if missions differ in their number of particles or
        their unknowns.
        """
        first, count = configs[0], len(configs)
        rows, particles = len(first.unknown_indices), first.particles
        self.particles = np.empty((count, rows, particles))
        self.weights = np.empty((count, particles))
        """(B, N); the greatest of each mission is 1."""
        self.means = np.empty((count, rows))
        self.covariances = np.empty((count, rows, rows))
        self.counts = np.zeros(count, np.int64)
        """(B,): number of readings that each mission has assimilated."""
        self._log_weights = np.empty((count, particles))
        self._log_targets = np.empty((count, particles))
        self._readings = np.empty((count, 64, 7))
        self._ranks = np.empty((count, 64))
        self._priors = np.empty((count, *first.prior_rows.shape))
        self._sensors = np.empty((count, len(first.sensor_row)))
        self._seeds = np.empty(count, np.uint64)
        self._unknowns = first.unknown_indices
        self._sweeps = first.sweeps
        self._configs = list(configs)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)
        for mission, config in enumerate(configs):
            self.begin(mission, config)

    def begin(self, mission: int, config: Config) -> None:
        """Replace a mission by a new one. Raises ValueError if its number of particles or its unknowns
        differ.
        """
        first = self._configs[0]
        if (config.particles, config.unknowns) != (first.particles, first.unknowns):
            raise ValueError(
                "all missions of a batch must have the same number of particles and the same unknowns"
            )
        posterior = prior(config)
        self.particles[mission] = posterior.particles
        self.weights[mission] = posterior.weights
        self.counts[mission] = 0
        self._log_weights[mission] = posterior.log_weights
        self._log_targets[mission] = posterior.log_targets
        self._priors[mission] = config.prior_rows
        self._sensors[mission] = config.sensor_row
        self._seeds[mission] = config.seed
        self._configs[mission] = config

    def assimilate(self, readings: Array, missions: Indices | None = None) -> None:
        """Assimilate one reading for each of these missions (M,), by default all. readings: (M, 7), rows
        as of `Config.row`.
        """
        missions = np.arange(len(self.counts)) if missions is None else missions
        if self.counts[missions].max() == self._readings.shape[1]:
            self._readings = np.concatenate([self._readings, np.empty_like(self._readings)], axis=1)
            self._ranks = np.concatenate([self._ranks, np.empty_like(self._ranks)], axis=1)
        self._readings[missions, self.counts[missions]] = readings
        self.counts[missions] += 1

        def update(portion: Indices) -> None:
            update_missions(
                self.particles,
                self._log_weights,
                self.weights,
                self._log_targets,
                self._readings,
                self._ranks,
                self.counts,
                self._unknowns,
                self._priors,
                self._sensors,
                self._seeds,
                self._sweeps,
                portion,
            )
            moments_of_missions(self.particles, self.weights, portion, self.means, self.covariances)

        self.share_out(update, missions)

    def share_out(self, task: Callable[[Indices], None], missions: Indices) -> None:
        """Run a task over these missions on the threads, in portions."""
        if self._threads == 1:
            task(missions)
            return
        portion = min(MISSIONS_PER_TASK, -(-len(missions) // self._threads))
        list(self._pool.map(task, np.split(missions, range(portion, len(missions), portion))))

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the particles' rows."""
        return self._configs[0].unknowns

    def may_claim(self, mission: int) -> bool:
        """True if the mission may claim a find, as by `estimator.belief.may_claim`."""
        count, config = self.counts[mission], self._configs[mission]
        readings = self._readings[mission, :count]
        p_value = fit(readings, self._ranks[mission, :count], config)
        better = evidence(
            self.particles[mission], self.weights[mission], self._log_targets[mission], readings, config
        )
        return may_claim(p_value, better, int(count))

    def has_ceased(self, mission: int) -> bool:
        """Whether the mission's belief has ceased, as by `estimator.belief.belief`."""
        config, covariance = self._configs[mission], self.covariances[mission]
        (xx, _), (_, yy) = covariance[:2, :2].tolist()
        spread, ranks = math.sqrt(xx + yy), self._ranks[mission, : self.counts[mission]]
        located = locates(
            spread, self.particles[mission], self.weights[mission], self.means[mission], ranks, config
        )
        stds = (
            dict(zip(config.unknowns, np.sqrt(covariance.diagonal()).tolist(), strict=True))
            if config.stop_limits
            else {}
        )
        return sure_enough(located, stds, config) and self.may_claim(mission)

    def posterior(self, mission: int) -> Posterior:
        """Return a copy of one mission's posterior."""
        count = self.counts[mission]
        return Posterior(
            self.particles[mission].copy(),
            self._log_weights[mission].copy(),
            self.weights[mission].copy(),
            self._log_targets[mission].copy(),
            self._readings[mission, :count].copy(),
            self._ranks[mission, :count].copy(),
        )
