"""Posteriors of many missions at once, by the very kernel that serves one: mission i is bit-identical to mission i alone."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from estimator import kernels
from estimator.filter import Config, Posterior, prior

Array = NDArray[np.float64]

MISSIONS_PER_TASK = 8
"""Missions cost very different times, so threads take them in portions no greater than this."""


class Batch:
    """Missions that take their readings in step; changed in place. All have the same number of particles and the same unknowns."""

    def __init__(self, configs: Sequence[Config], threads: int = 1) -> None:
        """Begin with the priors. Raises ValueError where missions differ in their particles or unknowns."""
        first = configs[0]
        if any((c.particles, c.unknowns) != (first.particles, first.unknowns) for c in configs):
            raise ValueError("all missions of a batch have the same number of particles and the same unknowns")
        posteriors = [prior(config) for config in configs]
        self._particles = np.stack([p.particles for p in posteriors])
        self._log_weights = np.stack([p.log_weights for p in posteriors])
        self._weights = np.stack([p.weights for p in posteriors])
        self._log_targets = np.stack([p.log_targets for p in posteriors])
        self._readings = np.empty((len(configs), 64, 7))
        self._ranks = np.empty((len(configs), 64))
        self._count = 0
        self._unknowns = first.unknown_indices
        self._priors = np.stack([c.prior_rows for c in configs])
        self._sensors = np.stack([c.sensor_row for c in configs])
        self._seeds = np.array([c.seed for c in configs], np.uint64)
        self._sweeps = first.sweeps
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)

    def assimilate(self, readings: Array) -> None:
        """Take one reading for each mission: (B, 7) rows as of `Config.row`."""
        if self._count == self._readings.shape[1]:
            self._readings = np.concatenate([self._readings, np.empty_like(self._readings)], axis=1)
            self._ranks = np.concatenate([self._ranks, np.empty_like(self._ranks)], axis=1)
        self._readings[:, self._count] = readings
        self._count += 1

        def update(begin: int) -> None:
            kernels.update_missions(
                self._particles, self._log_weights, self._weights, self._log_targets, self._readings, self._ranks, self._count,
                self._unknowns, self._priors, self._sensors, self._seeds, self._sweeps, begin, min(begin + portion, len(readings)),
            )  # fmt: skip

        if self._threads == 1:
            portion = len(readings)
            update(0)
        else:
            portion = min(MISSIONS_PER_TASK, -(-len(readings) // self._threads))
            list(self._pool.map(update, range(0, len(readings), portion)))

    def moments(self) -> tuple[Array, Array]:
        """Weighted means (B, D) and covariances (B, D, D)."""
        each = [kernels.moments(*pair) for pair in zip(self._particles, self._weights, strict=True)]
        return np.array([mean for mean, _ in each]), np.array([covariance for _, covariance in each])

    def posterior(self, mission: int) -> Posterior:
        """Return a copy of one mission's posterior."""
        return Posterior(
            self._particles[mission].copy(),
            self._log_weights[mission].copy(),
            self._weights[mission].copy(),
            self._log_targets[mission].copy(),
            self._readings[mission, : self._count].copy(),
            self._ranks[mission, : self._count].copy(),
        )
