"""The PettingZoo environment of a fleet that searches together (docs/environment.md)."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import Space
from gymnasium.error import ResetNeeded
from gymnasium.utils.seeding import np_random
from pettingzoo import ParallelEnv

from agent.learn.env import REWARDS, TRAINING_SEEDS, ActionError, Settings, checked_seed, with_options
from agent.observation import SCHEMAS, Frame, Observation
from agent.planning.apart import Shared
from agent.planning.moves import Reach
from agent.together import in_turn, seen_by
from agent.trials.rollout import prepared
from agent.trials.rounds import Round, Rounds
from plume.outcome import verdict
from plume.problems.fleet import Fleet, Place
from plume.problems.values import short

OF_FLEET = ("vehicles", "formation", "separation_m")


class SourceSearchParallel(ParallelEnv):  # type: ignore[misc]  # PettingZoo has no types
    """Vehicles that search together for a gas source; one mission is one episode.

    The agents are `uav_1`, `uav_2`, … Each has the observations, actions and rewards of `SourceSearch`, where
    it is. They share one belief, which takes all readings, and one stop, so all end together; each is
    rewarded for it. All move at once: a way that comes nearer than `separation_m` to one of an agent before
    is turned aside, or the vehicle stays where it is.

    Arguments: `vehicles` (2), `formation` ("point") and `separation_m` (3), as `plumeward.rollout` takes
    them; the others are those of `SourceSearch`, and so is a reset's option `problem`. Nothing is drawn.

    Examples:
        >>> env = plumeward.SourceSearchParallel(vehicles=3)
        >>> observations, infos = env.reset(seed=1)
        >>> actions = {agent: env.action_space(agent).sample() for agent in env.agents}
        >>> observations, rewards, terminations, truncations, infos = env.step(actions)
        >>> rewards
        {'uav_1': -0.01, 'uav_2': -0.01, 'uav_3': -0.01}
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "plumeward/SourceSearchParallel-v0", "render_modes": []}

    def __init__(
        self, vehicles: int = 2, formation: str = "point", separation_m: float = 3.0, **settings: Any
    ) -> None:
        """Raises ValueError, or TypeError on an unknown argument; the message says what is allowed."""
        self.settings = Settings.of(settings, *OF_FLEET)
        self.fleet = Fleet(vehicles, formation, separation_m).within(self.settings.searched)
        self.searching = self.settings  # with the problem of the last reset
        self.render_mode = None
        self.possible_agents = [f"uav_{number}" for number in range(1, self.fleet.vehicles + 1)]
        self.agents: list[str] = []
        self.observation_spaces = {agent: self.settings.spaces()[0] for agent in self.possible_agents}
        self.action_spaces = {agent: self.settings.spaces()[1] for agent in self.possible_agents}
        self._rng, _ = np_random()
        self._rounds: Rounds | None = None

    def observation_space(self, agent: str) -> Space[Any]:
        """Return the observation space of an agent, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space[Any]:
        """Return the action space of an agent, always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin the mission of a seed, by default one of those of training; takes its first readings.

        Seeds and the option `problem` are those of `SourceSearch.reset`, which says what it raises. Other
        options have no effect: PettingZoo's own test gives one.
        """
        if isinstance(options, Mapping):
            options = {name: value for name, value in options.items() if name == "problem"}
        searching = with_options(self.settings, options)
        fleet = self.fleet.within(searching.searched)
        if seed is not None:
            seed = checked_seed(seed)
            self._rng, _ = np_random(seed)
        self._seed = int(self._rng.integers(TRAINING_SEEDS)) if seed is None else seed
        criterion = searching.criterion
        world, config = prepared(
            self._seed,
            searching.searched,
            searching.particles,
            criterion.threshold_m,
            assume=searching.assume,
            within=criterion.within,
        )
        starts = fleet.starts(world.start, self._seed, config.area)
        self.searching, self._truth = searching, world.truth
        self._rounds = Rounds(world, config, starts)
        self.agents = list(self.possible_agents)
        self._distances_m = [0.0] * len(self.agents)
        self._look(self._rounds.fly(self._rounds.places))
        return self._observations, self._told()

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Fly each vehicle to the waypoint of its action and take the readings there.

        Raises ActionError on an action outside its space, or if one is missing or of nobody; then nobody
        moves.
        """
        if self._rounds is None or not self.agents:
            raise ResetNeeded("call reset before step")
        if not isinstance(actions, Mapping) or actions.keys() != {*self.agents}:
            given = short([*actions] if isinstance(actions, Mapping) else actions)
            wanted = f"wanted one of each of {', '.join(self.agents)}"
            raise ActionError(f"actions of {given} are not allowed; {wanted}")
        checked = [self.settings.actions(actions[agent])[None] for agent in self.agents]
        places, area = self._rounds.places, self.searching.searched.ground
        longest = Shared(area=area).longest_m(self._round.belief.spread)

        def waypoint(vehicle: int, _reach: Shared) -> Place:
            here, frame = np.array([places[vehicle]]), self._frames[vehicle][None]
            x, y = self.searching.move.waypoints(here, frame, checked[vehicle], area, longest)[0].tolist()
            return x, y

        stands = [each.place for each in self._round.belief.stands or ()]
        chosen = in_turn(Reach(area=area), places, self.fleet.separation_m, waypoint, stands=stands)
        for vehicle, (start, end) in enumerate(zip(places, chosen, strict=True)):
            self._distances_m[vehicle] += math.dist(start, end)
        problem = self.searching.searched
        paid = self.searching.pay(np.array(self._frames), [problem] * len(places), longest).tolist()
        self._look(self._rounds.fly(chosen))
        ceased = self._round.belief.ceased
        spent = not ceased and self._rounds.number > problem.budget
        observations, told = self._observations, self._told()
        stop = REWARDS[self.settings.reward][1] if ceased else 0.0
        rewards = {agent: pay + stop for agent, pay in zip(self.agents, paid, strict=True)}
        ends, cuts = dict.fromkeys(self.agents, ceased), dict.fromkeys(self.agents, spent)
        if ceased or spent:
            self.agents = []
        return observations, rewards, ends, cuts, told

    def _look(self, flown: Round) -> None:
        """Take a round as the newest; fills the observations and the frames in which actions are meant."""
        self._round = flown
        self._observations: dict[str, Observation] = {}
        self._frames: list[Frame] = []
        schema = SCHEMAS[self.settings.observation]
        for agent, reading in zip(self.agents, flown.readings, strict=True):
            seen = seen_by(flown.belief, reading.position, reading.gas, reading.vehicle)
            self._observations[agent], frame = schema.see(seen, flown.particles, self.searching.searched)
            self._frames.append(frame)

    def _told(self) -> dict[str, dict[str, Any]]:
        """Return the infos; policies do not see them. They are those of `SourceSearch`."""
        said, source = self._round.belief, self._truth.nearest(self._round.belief.mean)
        located = (
            verdict(said.ceased, said.mean, source, said.outside, self.searching.searched.area) == "located"
        )
        return {
            agent: {
                "seed": self._seed,
                "position": np.array(reading.position),
                "estimate": np.array(said.mean),
                "spread_m": said.spread,
                "distance_m": distance_m,
                "located": located,
            }
            for agent, reading, distance_m in zip(
                self.agents, self._round.readings, self._distances_m, strict=True
            )
        }
