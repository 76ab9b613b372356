"""The gymnasium environments: the mission without the network (docs/environment.md).

`gymnasium.make("plumeward/SourceSearch-v0")` has discrete headings;
`gymnasium.make("plumeward/SourceSearchContinuous-v0")` has a heading and a step of up to 1 m.
`gymnasium.make_vec` makes many at once.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from agent.learn.missions import Missions
from agent.learn.problems import SETS, Draw
from agent.learn.render import RENDERING, Onlooker, Pixels
from agent.observation import SCHEMAS, Observation
from agent.planning.moves import HeadingAndStep, Headings, Move, Reach, longest_m, steps_of, units_m
from agent.scale_free import BOUND
from estimator.assumptions import ASSUMPTIONS
from estimator.criterion import Criterion, chosen
from link.cli import PARTICLES
from plume.elementary import Array
from plume.problem import MOST_STEPS, Problem
from plume.problems import names
from plume.problems.values import short, whole
from plume.randomness import MAX_SEED
from plume.sensors.names import GAUSSIAN

# Training draws seeds below it. Seeds from it to a million are for validation, above for testing.
TRAINING_SEEDS = 900_000
# By name: reward of each step and of the stop.
REWARDS: Mapping[str, tuple[float, float]] = {"paper": (0.0, 1.0), "cost": (-0.01, 1.0), "way": (-0.01, 1.0)}
WAY = 1 / 30  # of `way`, a step as a part of the area's side: a shorter one costs less

Flags = NDArray[np.bool_]


class ActionError(gymnasium.error.InvalidAction, ValueError):
    """An action that is not in the action space. No mission has moved."""


@dataclass(frozen=True)
class Settings:
    """The arguments of `SourceSearch`, which says what they mean.

    Raises ValueError that says what is allowed.
    """

    continuous: bool = False
    headings: int = 16
    observation: str = "polar"
    reward: str = "cost"
    particles: int = 500
    threshold_m: float | None = None
    budget: int | None = None  # None, and of the next one: the problem's
    world: str | None = None
    assume: str = "paper"  # the shipped policies learned with it
    stop: str | None = None  # None, with a `threshold_m` of None: the problem's
    problem: str | os.PathLike[str] | Problem | Mapping[str, Any] = "paper"
    fits: bool = False

    def __post_init__(self) -> None:
        for name in ("continuous", "fits"):
            if not isinstance(value := getattr(self, name), bool | np.bool_):
                raise ValueError(f"{name} {value!r} is not allowed; wanted True or False")
        for name, allowed in (
            ("observation", SCHEMAS),
            ("reward", REWARDS),
            ("assume", ASSUMPTIONS),
        ):
            value = getattr(self, name)
            if not isinstance(value, str) or value not in allowed:
                raise ValueError(f"{name} {value!r} is not allowed; wanted {' or '.join(allowed)}")
        if not isinstance(self.world, str | None):
            raise ValueError(f"world {self.world!r} is not allowed; wanted its name")
        whole("headings", self.headings, 2)
        whole("particles", self.particles, *PARTICLES)
        if self.budget is not None:
            whole("budget", self.budget, 1, MOST_STEPS)
        if self.draws:
            if not SCHEMAS[self.observation].anywhere:
                raise ValueError(
                    f"problem {self.problem!r} is not allowed with the observation {self.observation!r}; "
                    f"wanted {' or '.join(name for name, schema in SCHEMAS.items() if schema.anywhere)}"
                )
            if self.budget is not None or self.world is not None:
                name = "budget" if self.budget is not None else "world"
                raise ValueError(f"{name} is not allowed with problem {self.problem!r}, which draws its own")
            _ = self.criterion
            return
        try:
            problem = names.named(self.problem)
        except ValueError as error:
            raise ValueError(f"problem: {error}") from None
        if names.sensor_of(problem) != GAUSSIAN:
            raise ValueError(
                f"problem: sensor {names.sensor_text(problem)!r} is not allowed here; wanted gaussian"
            )
        _ = self.searched, self.criterion  # what is wrong with them is said now

    @classmethod
    def of(cls, given: Mapping[str, Any], *others: str) -> "Settings":
        """Return the settings `given`; `others` names other known arguments.

        Raises TypeError on an unknown one, or ValueError.
        """
        names = [field.name for field in fields(cls)]
        for name, value in given.items():
            if name not in names:
                raise TypeError(
                    f"argument {name}={value!r} is not allowed; wanted some of {', '.join((*others, *names))}"
                )
        return cls(**given)

    @property
    def draws(self) -> Draw | None:
        """What draws a problem for each mission; None where all missions are of one."""
        return SETS.get(self.problem) if isinstance(self.problem, str) else None

    @cached_property
    def searched(self) -> Problem:
        """The problem, with the budget and the world that override its own.

        Raises ValueError if it is a set of problems.
        """
        if self.draws:
            raise ValueError(f"problem {self.problem!r} is a set of problems; wanted one")
        return names.with_arguments(self.problem, budget=self.budget, world=self.world)

    @cached_property
    def criterion(self) -> Criterion:
        """When AGDC stops; of a set of problems, unless each problem says so."""
        return chosen(self.threshold_m, self.stop, Criterion().text if self.draws else self.searched.stop)

    @property
    def move(self) -> Move:
        """The meaning of actions. An observation for any problem has a move as the unit of its frame."""
        step_m = 1.0 if SCHEMAS[self.observation].anywhere else float(self.searched.step_m)
        if self.continuous:
            return HeadingAndStep(step_m, self.fits)
        return Headings(self.headings, step_m, self.fits)

    def spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Observation space and action space."""
        seen = spaces.Box(-BOUND, BOUND, (SCHEMAS[self.observation].size,), np.float32)
        return seen, spaces.Box(-1.0, 1.0, (2,), np.float32) if self.continuous else spaces.Discrete(
            self.headings
        )

    def begin(self, seeds: Sequence[int], threads: int = 1) -> Missions:
        """Return new missions of these seeds."""
        each = self.draws and self.threshold_m is None and self.stop is None
        return Missions(
            seeds,
            self.observation,
            self.particles,
            None if each else self.criterion,
            self.assume,
            threads,
            self.draws or self.searched,
        )

    def onlooker(self, render_mode: str | None) -> Onlooker | None:
        """Return who draws missions; None where nothing is to be drawn.

        Raises ValueError on another mode than `rgb_array`.
        """
        if render_mode not in (None, *RENDERING["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r} is not allowed; wanted None or 'rgb_array'")
        return Onlooker(self.assume) if render_mode else None

    def actions(self, given: Any, *count: int) -> NDArray[Any]:
        """Return `count` actions as an array, (B,) or (B, 2); without a count a single one, () or (2,).

        Raises ActionError.
        """
        shape = (*count, 2) if self.continuous else count
        kinds, wanted = (
            ("iuf", "finite numbers")
            if self.continuous
            else ("iu", f"whole numbers from 0 to {self.headings - 1}")
        )
        wanted = (
            f"wanted {wanted} in an array of shape {shape}"
            if shape
            else f"wanted a whole number from 0 to {self.headings - 1}"
        )
        try:
            actions = np.asarray(given)
        except ValueError:  # rows of different lengths
            raise ActionError(f"action {short(given)} is not allowed; {wanted}") from None
        if actions.dtype.kind not in kinds or actions.shape != shape:
            raise ActionError(
                f"action {short(given)} ({actions.dtype}, shape {actions.shape}) is not allowed; {wanted}"
            )
        good = np.isfinite(actions) if self.continuous else (actions >= 0) & (actions < self.headings)
        if not good.all():
            first = int(np.argwhere(~good)[0, 0]) if count else None
            value, of = (actions, "") if first is None else (actions[first], f" of mission {first}")
            raise ActionError(f"action {value.tolist()}{of} is not allowed; {wanted}")
        return actions

    def fly(self, missions: Missions, actions: NDArray[Any]) -> tuple[Array, Flags, Flags]:
        """Fly each mission to the waypoint of its action.

        Returns rewards, terminated and truncated, (B,) each.
        """
        longest = longest_m(missions.spreads_m, missions.grounds.sides_m)
        waypoints = self.move.waypoints(
            missions.positions, missions.frames, actions, missions.grounds, longest
        )
        for mission, ground in missions.grounds.fenced.items():
            (x, y), (east, north) = missions.positions[mission].tolist(), waypoints[mission].tolist()
            waypoints[mission] = Reach(area=ground).freed((x, y), (east, north))
        steps = self.pay(missions.frames, missions.problems, longest)
        missions.move(waypoints)
        terminated: Flags = missions.ceased.copy()
        truncated: Flags = ~terminated & (missions.steps >= missions.budgets)
        return np.where(terminated, steps + REWARDS[self.reward][1], steps), terminated, truncated

    def pay(self, frames: Array, problems: Sequence[Problem], longest: ArrayLike) -> Array:
        """Return the reward of a move in each of these frames (B, 3), without that of a stop: (B,).

        A move counts as a whole step, in the frame's unit and no longer than `longest`, m, if moves fit,
        whether or not its action is shorter or an edge cuts it off.
        """
        step, _ = REWARDS[self.reward]
        if self.reward != "way":
            return np.full(len(frames), step)
        lengths_m = steps_of(self.move, frames, longest) * units_m(frames)
        sides_m = np.array([problem.area.side_m for problem in problems])
        return np.asarray(step * (lengths_m / (WAY * sides_m)))


def checked_seed(value: Any) -> int:
    """Return the seed that a reset is given. Raises ValueError."""
    return whole("seed", value, 0, MAX_SEED)


def with_options(settings: Settings, options: Any) -> Settings:
    """Return the settings with the problem of a reset's options. Raises ValueError on other options."""
    if not options:
        return settings
    if not isinstance(options, Mapping) or options.keys() != {"problem"}:
        raise ValueError(f"options {short(options)} are not allowed; wanted none, or {{'problem': …}}")
    return replace(settings, problem=options["problem"])


def _begun(missions: Missions | None, call: str) -> Missions:
    if missions is None:
        raise gymnasium.error.ResetNeeded(f"call reset before {call}")
    return missions


def _told(missions: Missions) -> dict[str, Any]:
    """The infos of each mission; the policy does not see them.

    `located` is False where the mission has not ceased.
    """
    return {
        "seed": missions.seeds.copy(),
        "position": missions.positions.copy(),
        "estimate": missions.estimates.copy(),
        "spread_m": missions.spreads_m.copy(),
        "distance_m": missions.distances_m.copy(),
        "located": missions.ceased & missions.located,
    }


def _first(infos: Mapping[str, Any]) -> dict[str, Any]:
    return {name: values[0] for name, values in infos.items()}


class SourceSearch(gymnasium.Env[Observation, Any]):
    """A drone searches for a gas source; one mission is one episode.

    Each step flies to a waypoint and takes a gas reading there. A particle filter turns the readings into a
    belief about the source. AGDC decides when the belief is sure enough to stop.

    ## Action Space

    | environment | action | meaning |
    |---|---|---|
    | `SourceSearch-v0` | `Discrete(16)`: k | 1 m in the direction 2π k / 16 |
    | `SourceSearchContinuous-v0` | `Box(-1, 1, (2,), float32)`: a[0] | the direction π a[0] |
    | | a[1] | the step (a[1] + 1) / 2 m |

    Directions are relative to the observation's frame. A waypoint outside the area moves to its edge.

    ## Observation Space

    `Box(-10, 10, (184,), float32)`, the schema `polar`: the belief as seen from the vehicle. The frame's x
    axis points to the estimate; it is mirrored if the wind would otherwise come from the right.

    | index | number |
    |---|---|
    | 0 to 127 | 2 √mass of the belief in 8 rings of 16 sectors |
    | 128 to 159 | information gain of a reading 2 m, then 5 m ahead, in 16 headings, nats |
    | 160 to 183 | estimate, spread, covariance, wind, plume, and the place in the area |

    With `observation="paper"` it is `Box(-10, 10, (5,), float32)`, in the world's frame: position (x, y),
    gas and estimate (x, y).

    With `observation="polar-2"` it is `Box(-10, 10, (210,), float32)`: the belief without units and without
    a prior of its own, for any problem.

    ## Rewards

    | `reward` | each step | at the stop, added |
    |---|---|---|
    | `"cost"`, the default | −0.01 | 1 |
    | `"paper"` | 0 | 1 |
    | `"way"` | −0.01 for a thirtieth of the area's side that a whole step is long | 1 |

    A stop is rewarded whether it is right or wrong.

    ## Starting State

    `reset(seed=s)` begins mission s, the same that `plumeward rollout --seed s --assume paper` flies: the
    seed draws source, wind, gas and start, uniform over [0, 5]² m. A reset without a seed draws the next
    mission from those of training, below 900,000. The first reading is taken at the start.

    ## Episode End

    | flag | when |
    |---|---|
    | `terminated` | AGDC stops: the spread of the belief is below `threshold_m`, or `stop` is met |
    | `truncated` | `budget` steps are spent |

    ## Information

    `seed`, `position`, `estimate`, `spread_m`, `distance_m` and `located`, whether the stop was right.

    ## Arguments

    `render_mode`: None or `"rgb_array"`. The others are the fields of `Settings`.

    | argument | default | meaning |
    |---|---|---|
    | `problem` | `"paper"` | a `plumeward.Problem`, its fields, `"paper"`, a YAML file or `"anywhere"` |
    | `continuous` | False | an action is a heading and a step |
    | `headings` | 16 | number of headings of discrete actions |
    | `observation` | `"polar"` | `"polar-2"` or `"paper"` |
    | `reward` | `"cost"` | `"way"` or `"paper"` |
    | `particles` | 500 | particles of the filter |
    | `threshold_m` | None | ζ, m: short for the stop `"spread:ζ"` |
    | `budget` | None | most steps; None, also of the next one: the problem's |
    | `world` | None | how gas moves and the truth differs: a name, as `--world` takes it |
    | `assume` | `"paper"` | or `"field"`: what the estimator takes to be known |
    | `stop` | None | instead of `threshold_m`: `"within:1,0.99"`; without both the problem's |
    | `fits` | False | where the belief is narrow, moves are as short as those of `homing` |

    Examples:
        >>> import gymnasium, plumeward
        >>> env = gymnasium.make("plumeward/SourceSearch-v0", particles=500)
        >>> observation, info = env.reset(seed=1)
        >>> observation, reward, terminated, truncated, info = env.step(0)
        >>> observation.shape, reward, terminated
        ((184,), -0.01, False)
    """

    metadata = RENDERING

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        """Raises ValueError, or TypeError on an unknown argument; the message says what is allowed."""
        self.settings = Settings.of(settings, "render_mode")
        self.render_mode = render_mode
        self.onlooker = self.settings.onlooker(render_mode)
        self.searching = self.settings  # with the problem of the last reset
        self.observation_space, self.action_space = self.settings.spaces()
        self.missions: Missions | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin a mission and take its first reading. Raises ValueError on a bad seed, and on bad options.

        `options={"problem": …}` is another problem, until the next reset.
        """
        searching = with_options(self.settings, options)
        seed = None if seed is None else checked_seed(seed)
        super().reset(seed=seed)
        self.missions = searching.begin(
            [int(self.np_random.integers(TRAINING_SEEDS)) if seed is None else seed]
        )
        self.searching = searching
        if self.onlooker:
            self.onlooker.look(self.missions)
        return self.missions.observations[0].copy(), _first(_told(self.missions))

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Fly to the waypoint of the action and take a reading there.

        Raises ActionError on one outside the action space.
        """
        missions = _begun(self.missions, "step")
        rewards, terminated, truncated = self.searching.fly(missions, self.settings.actions(action)[None])
        if self.onlooker:
            self.onlooker.look(missions)
        return (
            missions.observations[0].copy(),
            float(rewards[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            _first(_told(missions)),
        )

    def render(self) -> Pixels | None:
        """Return the picture of the mission, (540, 960, 3), with the true plume and source.

        None without a `render_mode`.
        """
        return self.onlooker.frame(_begun(self.missions, "render"), 0) if self.onlooker else None


class SourceSearchVector(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """Missions in parallel in this process, each bit-identical to `SourceSearch`.

    They share the filter's batch kernels. When a mission ends, the next one begins in the same step;
    `final_obs` and `final_info` are those of the mission that ended.

    Examples:
        >>> envs = plumeward.SourceSearchVector(num_envs=3)
        >>> observations, infos = envs.reset(seed=1)
        >>> observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
        >>> observations.shape, terminations.shape
        ((3, 184), (3,))
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, **RENDERING}  # noqa: RUF012

    def __init__(
        self, num_envs: int = 1, threads: int = 1, render_mode: str | None = None, **settings: Any
    ) -> None:
        """Make `num_envs` missions; `threads` share the compiled part of the work.

        Raises like `SourceSearch`.
        """
        for name, value in (("num_envs", num_envs), ("threads", threads)):
            whole(name, value, 1)
        self.num_envs = num_envs
        self.settings = Settings.of(settings, "num_envs", "threads", "render_mode")
        self.render_mode = render_mode
        self.onlooker = self.settings.onlooker(render_mode)
        self.searching = self.settings  # with the problem of the last reset
        self.single_observation_space, self.single_action_space = self.settings.spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.threads = threads
        self._draws: list[np.random.Generator] = []
        self.missions: Missions | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin missions: of seed, seed + 1 and so on, or of each seed of a sequence.

        Without a seed, the next ones are drawn. `options={"problem": …}` is the problem of all of them and of
        those that follow, until the next reset. Raises like `SourceSearch.reset`.
        """
        searching = with_options(self.settings, options)
        if seed is None and self._draws:
            seeds = [self._next(i) for i in range(self.num_envs)]
        else:
            if seed is None:
                seed = self.np_random.integers(TRAINING_SEEDS, size=self.num_envs).tolist()
            several = (
                seed
                if isinstance(seed, Sequence) or (isinstance(seed, np.ndarray) and seed.ndim)
                else [checked_seed(seed) + i for i in range(self.num_envs)]
            )
            seeds = [checked_seed(each) for each in several]
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds for {self.num_envs} missions")
            self._draws = [np.random.default_rng(each) for each in seeds]
        self.missions = searching.begin(seeds, self.threads)
        self.searching = searching
        if self.onlooker:
            self.onlooker.look(self.missions)
        return self.missions.observations.copy(), _told(self.missions)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Fly each mission to the waypoint of its action and take a reading there.

        On a wrong action raises ActionError and moves none.
        """
        missions = _begun(self.missions, "step")
        rewards, terminated, truncated = self.searching.fly(
            missions, self.settings.actions(actions, self.num_envs)
        )
        infos: dict[str, Any] = {}
        over = terminated | truncated
        if over.any():
            ended = np.flatnonzero(over)
            final = np.full(self.num_envs, None, object)
            for i in ended:
                final[i] = missions.observations[i].copy()
            infos = {
                "final_obs": final,
                "_final_obs": over,
                "final_info": _told(missions),
                "_final_info": over,
            }
            missions.begin(ended, [self._next(i) for i in ended.tolist()])
        if self.onlooker:
            self.onlooker.look(missions)
        return missions.observations.copy(), rewards, terminated, truncated, infos | _told(missions)

    def render(self) -> tuple[Pixels, ...] | None:
        """Return the pictures of all missions, as `SourceSearch.render` does of one."""
        if self.onlooker is None:
            return None
        missions = _begun(self.missions, "render")
        return tuple(self.onlooker.frame(missions, i) for i in range(self.num_envs))

    def _next(self, i: int) -> int:
        return int(self._draws[i].integers(TRAINING_SEEDS))
