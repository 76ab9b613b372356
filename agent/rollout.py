"""A mission flown in-process: the networked stack without the network, to the same bits."""

import time
from typing import Any

from agent.service import choose
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.mavlink import Reading
from plume.outcome import Outcome, TracePoint, outcome
from plume.randomness import derived_seed
from plume.scenario import BUDGET_STEPS, draw
from plume.world import World

ALTITUDE_M = 5.0


def rollout(
    seed: int, policy: str, particles: int = 1000, threshold_m: float = 0.5, budget: int = BUDGET_STEPS, **knowledge: Any
) -> tuple[Outcome, list[TracePoint]]:
    """Fly the mission of a seed with a policy; returns its outcome and trace. `knowledge`: more fields of `Config`, the sensor say."""
    scenario = draw(seed)
    config = Config(particles, threshold_m, derived_seed(seed, "estimator"), scenario.q, scenario.d, scenario.tau, **knowledge)
    world = World(scenario, seed, config.sensor)
    agent_seed = derived_seed(seed, "agent")
    posterior = prior(config)
    position = world.start
    trace: list[TracePoint] = []
    search_time_s = 0.0
    while True:
        step = len(trace)
        reading = Reading(step, position, ALTITUDE_M, world.wind, world.gas(position, step))
        began = time.perf_counter()
        posterior = assimilate(posterior, reading, config)
        summary, cloud = belief(posterior, reading, config)
        search_time_s += time.perf_counter() - began
        trace.append(TracePoint(position, reading.gas, summary.mean, summary.spread))
        if summary.ceased or step == budget:
            return outcome(seed, policy, scenario, trace, summary.ceased, search_time_s), trace
        began = time.perf_counter()
        position = choose(policy, summary, cloud, agent_seed)
        search_time_s += time.perf_counter() - began
