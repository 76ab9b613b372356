"""Protects one arithmetic for one and for many: a mission among others is, to the bit, the one that the
scalar pieces fly alone.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

import plume.worlds.air
from agent.facts import DIFFUSIVITY, FACTS, GAS, LIFETIME, RATE, X
from agent.learn.missions import Missions
from agent.learn.problems import anywhere
from agent.observation import SCHEMAS
from agent.planning.moves import Headings
from agent.trials.rollout import mission
from estimator.belief import belief
from estimator.criterion import Criterion, parse
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading
from plume.problem import ALTITUDE_M, AREA
from plume.randomness import derived_seed, keyed
from plume.scenario import SUCCESS_RADIUS_M, draw
from plume.sensors.sensor import Gaussian
from plume.worlds.world import World

PARTICLES, THRESHOLD_M = 200, 0.7
SEEDS, OTHERS = (0, 1, 2, 3, 11, 15, 1_000_003, 899_999, 149), (40, 41)
STEPS = 75
"""More than the 64 readings that there is room for at first."""
BEGUN_ANEW = 30
MOVE = Headings(16)


def action_of(seed: int, step: int) -> int:
    """Mostly along the frame's x axis, to the estimate in `polar`, so that missions stop; a function of
    the mission alone.
    """
    rng = keyed(seed, "test", step)
    return 0 if rng.random() < 0.7 else int(rng.integers(16))


class Alone:
    """The mission of a seed, from the scalar pieces."""

    def __init__(self, seed: int, schema: str, particles: int = PARTICLES, **changes: Any) -> None:
        self.seed, self.schema, self.step, self.distance_m = seed, SCHEMAS[schema], 0, 0.0
        self.scenario = draw(seed)
        known = self.scenario.q, self.scenario.d, self.scenario.tau
        self.config = Config(particles, THRESHOLD_M, derived_seed(seed, "estimator"), *known, **changes)
        self.world = World(self.scenario, seed)
        self.posterior, self.position = prior(self.config), self.world.start
        self.read()

    def read(self) -> None:
        reading = Reading(
            self.step, self.position, ALTITUDE_M, self.world.wind, self.world.gas(self.position, self.step)
        )
        self.posterior = assimilate(self.posterior, reading, self.config)
        self.belief, particles = belief(self.posterior, reading, self.config)
        self.observation, self.frame = self.schema.see(self.belief, particles)

    def move(self) -> None:
        action = np.array([action_of(self.seed, self.step)])
        place = MOVE.waypoints(np.array([self.position]), self.frame[None], action, AREA)[0]
        self.distance_m += float(np.linalg.norm(place - self.position))
        self.position = tuple(place.tolist())
        self.step += 1
        self.read()

    def told(self) -> list[bytes | bool | int]:
        said, error_m = self.belief, np.linalg.norm(np.subtract(self.belief.mean, self.scenario.source))
        return [
            *(
                np.array(value).tobytes()
                for value in (said.position, said.gas, said.wind, said.mean, said.covariance, said.spread)
            ),
            self.observation.tobytes(),
            self.frame.tobytes(),
            said.ceased,
            self.step,
            bool(error_m <= SUCCESS_RADIUS_M),
        ]


def told(missions: Missions, i: int) -> list[bytes | bool | int]:
    """What `Alone.told` says, of a mission among others."""
    facts = dict(zip(FACTS, missions.facts[i], strict=True))
    shown = (
        missions.positions[i],
        missions.facts[i, GAS],
        [facts[name] for name in ("wind_x", "wind_y")],
        missions.estimates[i],
        [facts[name] for name in ("xx", "xy", "yy")],
        missions.spreads_m[i],
        missions.observations[i],
        missions.frames[i],
    )
    assert missions.facts[i, X] == missions.positions[i, 0]
    return [
        *(np.array(value).tobytes() for value in shown),
        bool(missions.ceased[i]),
        int(missions.steps[i]),
        bool(missions.located[i]),
    ]


def fly(missions: Missions) -> None:
    """One move of each."""
    actions = [
        action_of(seed, step)
        for seed, step in zip(missions.seeds.tolist(), missions.steps.tolist(), strict=True)
    ]
    missions.move(MOVE.waypoints(missions.positions, missions.frames, np.array(actions), AREA))


def together(
    seeds: Sequence[int], schema: str, threads: int = 1
) -> dict[int, list[list[bytes | bool | int]]]:
    """What is told of each mission, step after step; `OTHERS` come in the first places after a while,
    where there are two.
    """
    missions = Missions(seeds, schema, PARTICLES, Criterion(THRESHOLD_M), threads=threads)
    trace: dict[int, list[list[bytes | bool | int]]] = {seed: [] for seed in (*seeds, *OTHERS)}
    for step in range(STEPS + 1):
        if step:
            fly(missions)
        if step == BEGUN_ANEW and len(seeds) > 1:
            missions.begin(np.array([0, 1]), OTHERS)
        for i, seed in enumerate(missions.seeds.tolist()):
            trace[seed].append(told(missions, i))
    return trace


@pytest.fixture(scope="module", params=list(SCHEMAS))
def alone(request: pytest.FixtureRequest) -> tuple[str, dict[int, list[list[bytes | bool | int]]]]:
    """What is told of each mission flown alone, by schema."""
    trace: dict[int, list[list[bytes | bool | int]]] = {}
    for seed in (*SEEDS, *OTHERS):
        mission = Alone(seed, request.param)
        trace[seed] = [mission.told()]
        for _ in range(STEPS):
            mission.move()
            trace[seed].append(mission.told())
    if request.param == "polar":
        ceased = [[said[-3] for said in steps] for steps in trace.values()]
        assert sum(map(any, ceased)) > 5  # the most come to a stop, and fly on
        assert any(
            steps[k] and not steps[k + 1] for steps in ceased for k in range(STEPS)
        )  # some are less sure again later
    return request.param, trace


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("seeds", "threads"),
    [(SEEDS, 1), (SEEDS, 2), (SEEDS, 3), (SEEDS[::-1], 1), (SEEDS[2:5], 2), (SEEDS[6:7], 1), (SEEDS[7:], 3)],
    ids=["all", "2 threads", "3 threads", "backwards", "three", "one", "two"],
)
def test_a_mission_among_others_is_the_mission_alone_to_the_bit(
    alone: tuple, seeds: Sequence[int], threads: int
) -> None:
    schema, expected = alone
    for seed, steps in together(seeds, schema, threads).items():
        assert steps == expected[seed][: len(steps)], f"mission {seed}"


@pytest.mark.parametrize("particles", [10, 77, 9001])
def test_with_few_and_many_particles_too(particles: int) -> None:
    missions = Missions(SEEDS[:3], "polar", particles, Criterion(THRESHOLD_M))
    singles = [Alone(seed, "polar", particles) for seed in SEEDS[:3]]
    for _ in range(12):
        assert [told(missions, i) for i in range(3)] == [single.told() for single in singles]
        fly(missions)
        for single in singles:
            single.move()


@pytest.mark.one_in(2)
@pytest.mark.parametrize("schema", SCHEMAS)
@pytest.mark.parametrize(
    ("assume", "within"), [("paper", (1.5, 0.9)), ("field", None), ("field", (4.0, 0.8))]
)
def test_with_another_assumption_or_criterion_too(
    schema: str, assume: str, within: tuple[float, float] | None
) -> None:
    missions = Missions(SEEDS[:4], schema, 120, Criterion(THRESHOLD_M, within), assume, threads=2)
    singles = [Alone(seed, schema, 120, assume=assume, within=within) for seed in SEEDS[:4]]
    ceased = set()
    for _ in range(40):
        assert [told(missions, i) for i in range(4)] == [single.told() for single in singles]
        ceased |= {bool(said) for said in missions.ceased}
        fly(missions)
        for single in singles:
            single.move()
    if within and schema == "polar":  # in its frame the actions lead to the estimate
        assert ceased == {True, False}
    for fact, name in ((RATE, "rate"), (LIFETIME, "lifetime"), (DIFFUSIVITY, "diffusivity")):
        assert missions.facts[:, fact].tolist() == [getattr(single.belief, name) for single in singles]


def test_missions_of_drawn_problems_are_each_as_alone() -> None:
    seeds = [3, 4, 5, 6]
    among = Missions(seeds, "polar-2", 60, None, "field", threads=2, problem=anywhere)
    singles = [
        Missions([seed], "polar-2", 60, parse(anywhere(seed).stop), "field", problem=anywhere(seed))
        for seed in seeds
    ]
    for missions in (among, *singles):
        for _ in range(10):
            actions = [action_of(*pair) for pair in zip(missions.seeds, missions.steps, strict=True)]
            missions.move(
                MOVE.waypoints(missions.positions, missions.frames, np.array(actions), missions.grounds)
            )
    for i, single in enumerate(singles):
        assert told(among, i) == told(single, 0)
        assert among.budgets[i] == anywhere(seeds[i]).budget


def test_the_way_flown_is_summed_and_begins_anew_with_another_mission() -> None:
    missions = Missions(SEEDS[:3], "paper", 50, Criterion(THRESHOLD_M))
    singles = [Alone(seed, "paper", 50) for seed in SEEDS[:3]]
    for _ in range(10):
        fly(missions)
        for single in singles:
            single.move()
    assert missions.distances_m == pytest.approx([single.distance_m for single in singles])
    missions.begin(np.array([1]), [77])
    assert missions.distances_m[1] == 0
    assert missions.distances_m[[0, 2]] == pytest.approx([singles[0].distance_m, singles[2].distance_m])
    assert missions.seeds.tolist() == [SEEDS[0], 77, SEEDS[2]]


def doubled(told_of: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """Another physics: twice as much."""
    return lambda *arguments, **named: 2 * told_of(*arguments, **named)


@pytest.mark.parametrize(
    ("owner", "name"), [(plume.worlds.air, "concentration"), (Gaussian, "measure"), (Gaussian, "noise_std")]
)
def test_who_changes_the_worlds_physics_changes_it_for_rollouts_and_training_alike(
    monkeypatch: pytest.MonkeyPatch, owner: object, name: str
) -> None:
    """In one place: there is no second copy that goes on as before."""

    def first_readings() -> tuple[list[float], list[float]]:
        missions = Missions(SEEDS, "paper", 50, Criterion(THRESHOLD_M))
        flown = [next(mission(seed, "random", 50, THRESHOLD_M, 1).steps).belief.gas for seed in SEEDS]
        return missions.facts[:, GAS].tolist(), flown

    before, also_before = first_readings()
    assert before == also_before
    monkeypatch.setattr(owner, name, doubled(getattr(owner, name)))
    after, also_after = first_readings()
    assert after == also_after
    assert all(value != old for value, old in zip(after, before, strict=True))
