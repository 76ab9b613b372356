"""Posteriors of many missions at once, by the same kernel as for one.

Mission i is bit-identical to mission i run alone.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np

from estimator.belief import evidence, fit, locates, may_claim, share_outside, sure_enough
from estimator.filter import Config, Posterior, prior
from estimator.kernels.densities import Model
from estimator.kernels.update import RESAMPLE_BELOW, WeightedSample, update_missions
from estimator.kernels.weights import moments_of_missions
from plume.elementary import Array, Indices

# Most missions that a thread takes at once; small portions balance the load, since missions differ much in
# cost.
MISSIONS_PER_TASK = 8


class Batch:
    """Missions side by side, each at its own step; changed in place.

    All have the same number of particles and the same unknowns.
    """

    def __init__(self, configs: Sequence[Config], threads: int = 1) -> None:
        """Begin with the priors.

        Raises ValueError if missions differ in their number of particles or their unknowns.
        """
        first, count = configs[0], len(configs)
        rows, particles = len(first.unknown_indices), first.particles
        self.means = np.empty((count, rows))
        self.covariances = np.empty((count, rows, rows))
        self.counts = np.zeros(count, np.int64)  # of the readings that each mission has assimilated
        self._samples = WeightedSample(np.empty((count, rows, particles)), *np.empty((3, count, particles)))
        # (B, D, N) and (B, N), of which the greatest of each mission is 1.
        self.particles, self.weights = self._samples.particles, self._samples.weights
        self.unknowns = first.unknowns  # in the order of the particles' rows
        self._models = Model(
            first.unknown_indices,
            np.empty((count, *first.prior_rows.shape)),
            np.empty((count, len(first.model.sensor))),
            np.empty((count, 1)),
            np.zeros((count, 0, 5)),
            np.zeros((count, 1)),
        )
        self._seeds = np.empty(count, np.uint64)
        self._readings, self._ranks = np.empty((count, 64, first.columns)), np.empty((count, 64))
        self._configs = list(configs)
        self._threads = threads
        for mission, config in enumerate(configs):
            self.begin(mission, config)

    def begin(self, mission: int, config: Config) -> None:
        """Replace a mission by a new one.

        Raises ValueError if its number of particles or its unknowns differ.
        """
        if (config.particles, config.unknowns) != (self.particles.shape[2], self.unknowns):
            raise ValueError(
                "all missions of a batch must have the same number of particles and the same unknowns"
            )
        for stacked, array in zip(self._samples, prior(config).sample, strict=True):
            stacked[mission] = array
        self._make_room(len(config.walls), len(config.densities))
        for stacked, array in zip(self._models[1:], config.model[1:], strict=True):
            stacked[mission] = 0.0  # a side from a place to itself encloses nothing
            stacked[mission, : len(array)] = array
        self.counts[mission], self._seeds[mission], self._configs[mission] = 0, config.seed, config

    def _make_room(self, sides: int, densities: int) -> None:
        """Let the models have at least so many sides of polygons, and densities in them."""
        models = self._models
        if (more := sides - models.walls.shape[1]) > 0:
            models = models._replace(walls=np.pad(models.walls, ((0, 0), (0, more), (0, 0))))
        if (more := densities - models.densities.shape[1]) > 0:
            models = models._replace(densities=np.pad(models.densities, ((0, 0), (0, more))))
        self._models = models

    def assimilate(self, readings: Array, missions: Indices | None = None) -> None:
        """Assimilate one reading for each of these missions (M,), by default all.

        readings: (M, 7), rows as of `Config.row`.
        """
        missions = np.arange(len(self.counts)) if missions is None else missions
        if self.counts[missions].max() == self._readings.shape[1]:
            self._readings = np.concatenate([self._readings, np.empty_like(self._readings)], axis=1)
            self._ranks = np.concatenate([self._ranks, np.empty_like(self._ranks)], axis=1)
        self._readings[missions, self.counts[missions]] = readings
        self.counts[missions] += 1

        def update(portion: Indices) -> None:
            update_missions(
                self._samples,
                self._readings,
                self._ranks,
                self.counts,
                self._models,
                self._seeds,
                self._configs[0].sweeps,
                RESAMPLE_BELOW,
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

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._threads)

    def __getstate__(self) -> dict[str, object]:
        """Return what a copy is made of: it starts threads of its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_pool"}

    def may_claim(self, mission: int) -> bool:
        """True if the mission may claim a find, as by `estimator.belief.may_claim`."""
        said, config = self.posterior(mission), self._configs[mission]
        return may_claim(fit(said, config), evidence(said, config), len(said.readings))

    def has_ceased(self, mission: int) -> bool:
        """Whether the mission's belief has ceased, as by `estimator.belief.belief`."""
        config, covariance = self._configs[mission], self.covariances[mission]
        spread = math.sqrt(covariance[0, 0] + covariance[1, 1])
        located = locates(self.posterior(mission), spread, self.means[mission], config)
        stds = dict(zip(config.unknowns, np.sqrt(covariance.diagonal()).tolist(), strict=True))
        outside = self.share_outside(mission)
        return sure_enough(located, outside, stds, config) and self.may_claim(mission)

    def share_outside(self, mission: int) -> float:
        """Return the share of the mission's belief outside the area."""
        return share_outside(self.posterior(mission), self._configs[mission])

    def posterior(self, mission: int) -> Posterior:
        """Return one mission's posterior, which changes with the batch."""
        count, sample = self.counts[mission], WeightedSample(*(stacked[mission] for stacked in self._samples))
        return Posterior(*sample, self._readings[mission, :count], self._ranks[mission, :count])
