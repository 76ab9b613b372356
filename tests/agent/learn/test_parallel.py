"""Protects the PettingZoo environment of a fleet: its interface, its parity with rollouts, its separation."""

import math
from itertools import combinations

import numpy as np
import pytest

pytest.importorskip("pettingzoo")

from pettingzoo.test import parallel_api_test

from agent.bundle import load
from agent.learn.env import ActionError, SourceSearch
from agent.learn.parallel import SourceSearchParallel
from agent.policies import SHIPPED
from agent.trials.rollout import rollout

SMALL = {"particles": 50, "budget": 6}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("continuous", [False, True])
def test_it_passes_pettingzoos_own_test(continuous: bool) -> None:
    parallel_api_test(SourceSearchParallel(vehicles=3, continuous=continuous, **SMALL), num_cycles=20)


def test_one_vehicle_sees_gets_and_ends_as_the_single_environment() -> None:
    fleet, alone = SourceSearchParallel(vehicles=1, **SMALL), SourceSearch(**SMALL)
    (seen, told), (seen_alone, told_alone) = fleet.reset(seed=4), alone.reset(seed=4)
    for action in (0, 3, 8, 15, 2, 2):
        assert (seen["uav_1"] == seen_alone).all()
        assert told["uav_1"]["spread_m"] == told_alone["spread_m"]
        seen, *ended, told = fleet.step({"uav_1": action})
        seen_alone, *ended_alone, told_alone = alone.step(action)
        assert [said["uav_1"] for said in ended] == ended_alone
    assert ended_alone[-1]
    assert fleet.agents == []


def test_a_learned_policy_flies_in_it_as_in_a_rollout() -> None:
    said = {"vehicles": 2, "formation": "corners"}
    _, trace = rollout(4, "ppo", 50, budget=5, assume="paper", **said)
    env, policy = SourceSearchParallel(particles=50, budget=5, **said), load(SHIPPED["ppo"])
    seen, told = env.reset(seed=4)
    places = [tuple(told[agent]["position"]) for agent in env.agents]
    while env.agents:
        actions = {agent: int(policy.page.move.action(policy.said(seen[agent]))[0]) for agent in env.agents}
        seen, *_, told = env.step(actions)
        places += [tuple(said["position"]) for said in told.values()]
    assert places == [point.position for point in trace]


def test_vehicles_never_come_nearer_than_the_separation() -> None:
    env = SourceSearchParallel(vehicles=4, separation_m=4.0, particles=50, budget=15)
    env.reset(seed=7)
    rng = np.random.default_rng(0)
    while env.agents:
        *_, told = env.step({agent: int(rng.integers(16)) for agent in env.agents})
        places = [said["position"] for said in told.values()]
        assert min(math.dist(a, b) for a, b in combinations(places, 2)) >= 4


def test_wrong_actions_and_settings_are_refused_and_move_nobody() -> None:
    with pytest.raises(ValueError, match="--vehicles"):
        SourceSearchParallel(vehicles=9)
    with pytest.raises(TypeError, match="vehicles, formation, separation_m, "):
        SourceSearchParallel(colour="red")
    env = SourceSearchParallel(**SMALL)
    _, before = env.reset(seed=4)
    with pytest.raises(ActionError, match="whole number from 0 to 15"):
        env.step({"uav_1": 3, "uav_2": 16})
    with pytest.raises(KeyError):
        env.step({"uav_1": 3})
    *_, after = env.step({"uav_1": 0, "uav_2": 0})
    assert math.dist(before["uav_1"]["position"], after["uav_1"]["position"]) <= 1.001
