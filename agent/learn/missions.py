"""Many missions flown in parallel in one process, each bit-identical to `rollout`."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agent import facts as of
from agent import observation
from agent.learn.problems import Draw
from estimator.batch import Batch
from estimator.criterion import Criterion, parse
from estimator.filter import Config
from plume.elementary import Array, Indices
from plume.flight import TRY_AGAIN_S, profile
from plume.problem import PAPER, Area, Problem
from plume.randomness import Keyed, derived_seed
from plume.scenario import SUCCESS_RADIUS_M, SURE_OUTSIDE, draw
from plume.worlds.world import World, readings_of
from scene.scene import Measurement, Scatter

# Facts that are means if they are unknown.
UNKNOWN_FACTS = {"q": of.RATE, "d": of.DIFFUSIVITY, "tau": of.LIFETIME}


class Grounds:
    """The areas of missions side by side: places are clipped, each to its own, as the wire carries it."""

    def __init__(self, count: int) -> None:
        self._lows, self._highs = np.empty((count, 2)), np.empty((count, 2))
        self.sides_m = np.empty(count)
        self.fenced: dict[int, Area] = {}  # missions that have something in the way, and their areas

    def put(self, mission: int, ground: Area) -> None:
        """Set a mission's area."""
        wire = ground.on_the_wire()
        self._lows[mission], self._highs[mission] = wire.low, wire.high
        self.sides_m[mission] = ground.side_m
        self.fenced.pop(mission, None)
        if ground.obstacles:
            self.fenced[mission] = ground

    def clipped(self, places: ArrayLike) -> Array:
        """Return the places inside that are nearest to these, (B, 2) m, one for each mission."""
        return np.clip(places, self._lows, self._highs)


class Missions:
    """Missions with a Gaussian sensor. All arrays have one row per mission."""

    def __init__(
        self,
        seeds: Sequence[int],
        schema: str,
        particles: int,
        criterion: Criterion | None,
        assume: str = "paper",
        threads: int = 1,
        problem: Problem | Draw = PAPER,
    ) -> None:
        """Begin the problem's mission of each seed and take its first reading.

        criterion: when AGDC stops; None: as each problem says.  problem: that of all missions, or a function
        that draws it by the seed.
        """
        count = len(seeds)
        self._schema = observation.SCHEMAS[schema]
        self._particles, self._criterion, self._assume = particles, criterion, assume
        self.seeds = np.array(seeds, np.int64)
        self.steps = np.zeros(count, np.int64)
        self.positions = np.empty((count, 2))
        self.distances_m = np.zeros(count)
        self.times_s = np.zeros(count)  # of each mission's own clock
        self.spreads_m = np.empty(count)
        self.outside = np.zeros(count)  # share of each belief outside the area
        self.ceased = np.zeros(count, np.bool_)
        self.frames = np.empty((count, 3))  # of the observations, in which actions are given
        self.observations = np.empty((count, self._schema.size), np.float32)
        self.facts = np.empty((count, len(of.FACTS)))  # what is known of each mission
        self._sources = np.empty((2, count, 2))  # the second is the first where there is none
        self._noise = Keyed()
        self._draws = problem
        self.problems = [self._problem(seed) for seed in self.seeds.tolist()]
        self.grounds = Grounds(count)
        self.sites = np.empty((count, of.SITE))
        self.budgets = np.empty(count, np.int64)
        self.criteria = [Criterion()] * count  # when each stops
        self._thresholds_m = np.empty(count)
        # For judging and showing only.
        self.worlds = [self._world(*pair) for pair in zip(self.seeds.tolist(), self.problems, strict=True)]
        self._loses = any(world.errors.lost for world in self.worlds)
        self._batch = Batch([self._told(mission) for mission in range(count)], threads)
        self._read(np.arange(count))

    def begin(self, missions: Indices, seeds: Sequence[int]) -> None:
        """Replace these missions by missions of other seeds."""
        self.seeds[missions] = seeds
        for mission, seed in zip(missions.tolist(), seeds, strict=True):
            self.problems[mission] = self._problem(seed)
            self.worlds[mission] = self._world(seed, self.problems[mission])
            self._batch.begin(mission, self._told(mission))
        self._read(missions)

    def _problem(self, seed: int) -> Problem:
        return self._draws if isinstance(self._draws, Problem) else self._draws(seed)

    def _world(self, seed: int, problem: Problem) -> World:
        return World(draw(seed, problem), seed, name=problem.world, problem=problem)

    def move(self, waypoints: Array) -> None:
        """Fly each mission to its waypoint and take a reading there.

        waypoints: (B, 2) m, float32 values within the area.
        """
        self.steps += 1
        lengths_m = np.sqrt(np.square(waypoints - self.positions).sum(axis=1))
        legs_s = profile(lengths_m).duration_s
        if self._loses:
            steps = self.steps.tolist()
            legs_s += [TRY_AGAIN_S * self.worlds[i].loses(step) for i, step in enumerate(steps)]
        self.times_s += legs_s
        self.distances_m += lengths_m
        self.positions[:] = waypoints
        self._read(np.arange(len(self.steps)))

    @property
    def estimates(self) -> Array:
        """(B, 2) m, which change with the batch."""
        return self._batch.means[:, :2]

    @property
    def located(self) -> NDArray[np.bool_]:
        """Whether the estimate is within the success radius, and not said to be outside; for judging only."""
        offsets = self.estimates - self._sources  # (2, B, 2)
        errors_m: Array = np.sqrt(np.square(offsets).sum(axis=2)).min(axis=0)
        return (errors_m <= SUCCESS_RADIUS_M) & (self.outside < SURE_OUTSIDE)

    def measurement(self, mission: int) -> Measurement:
        """Return a mission's newest reading and the belief after it.

        The time is the step: there is no clock.
        """
        step, (x, y) = int(self.steps[mission]), self.positions[mission].tolist()
        east, north = self.estimates[mission].tolist()
        (xx, xy), (_, yy) = self._batch.covariances[mission, :2, :2].tolist()
        gas, spread_m = float(self.facts[mission, of.GAS]), float(self.spreads_m[mission])
        return Measurement(
            step,
            float(step),
            (x, y),
            gas,
            spread_m,
            (east, north),
            (xx, xy, yy),
            bool(self.ceased[mission]),
        )

    def scatter(self, mission: int) -> Scatter:
        """Return a copy of a mission's particles in the plane."""
        weights = self._batch.weights[mission]
        return Scatter(
            self._batch.particles[mission, :2].T.astype(np.float32),
            (weights / weights.sum()).astype(np.float32),
        )

    def _told(self, mission: int) -> Config:
        """Set a mission to the start of its world; returns its estimator's configuration."""
        world, seed = self.worlds[mission], int(self.seeds[mission])
        scenario = world.scenario
        self.steps[mission], self.times_s[mission], self.distances_m[mission] = 0, 0.0, 0.0
        self.ceased[mission] = False
        self.positions[mission] = world.start
        self._sources[:, mission] = world.truth.source, world.truth.second or world.truth.source
        known = (scenario.q, scenario.d, scenario.tau)
        self.facts[mission, of.RATE : of.LIFETIME + 1] = known
        problem, its_seed = self.problems[mission], derived_seed(seed, "estimator")
        criterion = self._criterion or parse(problem.stop)
        self.criteria[mission], self._thresholds_m[mission] = criterion, criterion.threshold_m
        self.grounds.put(mission, problem.ground)
        self.sites[mission], self.budgets[mission] = of.site_of(problem), problem.budget
        return Config(
            self._particles,
            criterion.threshold_m,
            its_seed,
            *known,
            problem.ground,
            assume=self._assume,
            within=criterion.within,
            expected=problem.support,
        )

    def _read(self, missions: Indices) -> None:
        """Take a reading in each of these missions; update beliefs, observations and stops."""
        facts = self.facts
        facts[missions, : of.GAS] = self.positions[missions]
        gas, winds = readings_of(
            [self.worlds[mission] for mission in missions.tolist()],
            self.positions[missions],
            self.steps[missions].tolist(),
            self.times_s[missions],
            self._noise,
        )
        facts[missions, of.GAS] = gas
        facts[missions, of.WIND_X : of.RATE] = winds
        readings = np.zeros((len(missions), 7))
        readings[:, :2] = self.positions[missions]
        readings[:, 3:5] = facts[missions, of.WIND_X : of.RATE]
        readings[:, 5] = facts[missions, of.GAS]
        readings[:, 6] = 1.0
        self._batch.assimilate(readings, missions)
        covariances = self._batch.covariances[missions, :2, :2]
        facts[missions, of.MEAN_X : of.XX] = self._batch.means[missions, :2]
        for row, name in enumerate(self._batch.unknowns):
            if name in UNKNOWN_FACTS:
                facts[missions, UNKNOWN_FACTS[name]] = self._batch.means[missions, row]
        facts[missions, of.XX : of.WIND_X] = covariances.reshape(-1, 4)[:, [0, 1, 3]]
        self.spreads_m[missions] = np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1])
        self.ceased[missions] = False
        self.outside[missions] = [self._batch.share_outside(mission) for mission in missions.tolist()]
        narrow = self.spreads_m[missions] < self._thresholds_m[missions]
        near = narrow | (self.outside[missions] >= SURE_OUTSIDE)
        near |= [bool(self.criteria[mission].within) for mission in missions.tolist()]
        for mission in missions[near].tolist():
            self.ceased[mission] = self._batch.has_ceased(mission)
        totals, rows = self._batch.weights.sum(axis=1), observation.rows_of(self._batch.unknowns)

        def see(portion: Indices) -> None:
            self._schema.see_missions(
                self._batch.particles,
                self._batch.weights,
                totals,
                rows,
                facts,
                self.sites,
                portion,
                self.frames,
                self.observations,
            )

        self._batch.share_out(see, missions)
