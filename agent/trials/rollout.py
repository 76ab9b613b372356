"""A mission flown in-process, without the network, with bit-identical results."""

import time
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from agent.planning.moves import Reach
from agent.policies import choose, reach
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading
from link.bus.messages import Belief, Particles
from plume.outcome import Outcome, TracePoint, outcome
from plume.randomness import derived_seed
from plume.scenario import BUDGET_STEPS, Scenario, draw
from plume.world import World

ALTITUDE_M = 5.0
USUAL: Mapping[str, float] = MappingProxyType({})
"""The planner's own moves."""


class Step(NamedTuple):
    """One reading of a mission and the belief after it."""

    belief: Belief
    particles: Particles
    update_s: float
    """Compute time of the estimator for this reading."""
    decision_s: float
    """Compute time of the agent for the move to here; 0 at the start."""


class Mission(NamedTuple):
    """A mission ready to fly."""

    scenario: Scenario
    """The truth, for judging only."""
    config: Config
    """What the estimator knows."""
    steps: Iterator[Step]
    """Computed when asked for, until the search ceases or the budget is spent."""


def mission(
    seed: int, policy: str, particles: int, threshold_m: float, budget: int, moves: Mapping[str, float] = USUAL, **knowledge: Any
) -> Mission:
    """Prepare the mission of a seed with a policy. `moves`: fields of `Reach`. `knowledge`: other fields of `Config`, like the sensor."""
    scenario = draw(seed)
    config = Config(particles, threshold_m, derived_seed(seed, "estimator"), scenario.q, scenario.d, scenario.tau, **knowledge)
    world = World(scenario, seed, config.sensor)
    return Mission(scenario, config, _steps(world, config, policy, derived_seed(seed, "agent"), budget, reach(policy, moves)))


def _steps(world: World, config: Config, policy: str, agent_seed: int, budget: int, within: Reach) -> Iterator[Step]:
    posterior, position, decision_s = prior(config), world.start, 0.0
    for step in range(budget + 1):
        reading = Reading(step, position, ALTITUDE_M, world.wind, world.gas(position, step))
        began = time.perf_counter()
        posterior = assimilate(posterior, reading, config)
        summary, cloud = belief(posterior, reading, config)
        yield Step(summary, cloud, time.perf_counter() - began, decision_s)
        if summary.ceased or step == budget:
            return
        began = time.perf_counter()
        position = choose(policy, summary, cloud, agent_seed, within)
        decision_s = time.perf_counter() - began


def rollout(
    seed: int, policy: str, particles: int = 1000, threshold_m: float = 0.5, budget: int = BUDGET_STEPS,
    moves: Mapping[str, float] = USUAL, **knowledge: Any,
) -> tuple[Outcome, list[TracePoint]]:  # fmt: skip
    """Fly the mission of a seed with a policy; returns its outcome and trace. `moves` and `knowledge` are those of `mission`."""
    flown = mission(seed, policy, particles, threshold_m, budget, moves, **knowledge)
    trace: list[TracePoint] = []
    search_time_s = 0.0
    for said, _, update_s, decision_s in flown.steps:
        trace.append(TracePoint(said.position, said.gas, said.mean, said.spread))
        search_time_s += update_s + decision_s
    return outcome(seed, policy, flown.scenario, trace, said.ceased, search_time_s), trace
