"""Protects the PettingZoo environment of a fleet: its interface, its parity with rollouts, its separation."""

import math
import re
from itertools import combinations
from typing import Any

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


WAYS = {"reward": "way", "observation": "polar-2", "particles": 50}
FINE = {"problem": {"step_m": 0.25, "budget": 6, "stop": "within:9,0.5"}}


@pytest.mark.parametrize(
    ("settings", "options"),
    [(SMALL, None), (WAYS | {"problem": {"step_m": 0.25, "budget": 6}}, None), (WAYS, FINE)],
)
def test_one_vehicle_sees_gets_and_ends_as_the_single_environment(
    settings: dict[str, Any], options: dict[str, Any] | None
) -> None:
    fleet, alone = SourceSearchParallel(vehicles=1, **settings), SourceSearch(**settings)
    fleet.reset(seed=3)
    seen, told = fleet.reset(seed=4, options=options)
    seen_alone, told_alone = alone.reset(seed=4, options=options)
    for action in (0, 3, 8, 15, 2, 2):
        assert (seen["uav_1"] == seen_alone).all()
        assert told["uav_1"]["spread_m"] == told_alone["spread_m"]
        seen, *ended, told = fleet.step({"uav_1": action})
        seen_alone, *ended_alone, told_alone = alone.step(action)
        assert [said["uav_1"] for said in ended] == ended_alone
        assert ended[0]["uav_1"] == pytest.approx(-0.0025 if "reward" in settings else -0.01)
    assert ended_alone[-1]
    assert fleet.agents == []


def test_a_reset_without_options_is_of_the_usual_problem_again() -> None:
    env, usual = SourceSearchParallel(**SMALL), SourceSearchParallel(**SMALL)
    env.reset(seed=4, options={"problem": {"area": {"low": [-9, -9], "high": [60, 60]}}})
    assert (env.reset(seed=4)[0]["uav_2"] == usual.reset(seed=4)[0]["uav_2"]).all()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"problem": {"step_m": 20}}, "problem: step_m: 20.0 is not allowed"),
        ({"problem": 3}, "problem: problem 3 is not allowed"),
        ("x", "options 'x' are not allowed; wanted none, or {'problem': …}"),
        ({"problem": "anywhere"}, "problem 'anywhere' is "),
        (
            {"problem": {"area": {"low": [0, 0], "high": [3, 3]}}},
            "separation_m 3 is not allowed; 2 vehicles",
        ),
    ],
)
def test_a_reset_refuses_options_in_a_line_and_goes_on_as_it_was(options: Any, said: str) -> None:
    env, other = SourceSearchParallel(**SMALL), SourceSearchParallel(**SMALL)
    env.reset(seed=4)
    other.reset(seed=4)
    with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
        env.reset(seed=5, options=options)
    actions = dict.fromkeys(env.agents, 3)
    assert env.step(actions)[-1]["uav_2"]["seed"] == other.step(actions)[-1]["uav_2"]["seed"] == 4


def test_its_seeds_are_those_of_the_single_environment() -> None:
    env = SourceSearchParallel(**SMALL)
    for seed in (True, -1, 1.5, "7", 2**63, 2**70):
        line = f"seed {seed!r} is not allowed; wanted a whole number from 0 to {2**63 - 1}"
        with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
            env.reset(seed=seed)  # type: ignore[arg-type]
    for seed in (np.int64(8), np.uint8(8), 2**63 - 1):
        assert env.reset(seed=seed)[1]["uav_1"]["seed"] == seed  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        *(
            ({"vehicles": value}, f"vehicles {value!r} is not allowed; wanted a whole number from 1 to 8")
            for value in (2.5, "2", True, 0, None)
        ),
        *(
            (
                {"separation_m": value},
                f"separation_m {value!r} is not allowed; wanted a number from 0 up to 100",
            )
            for value in ("3", True, -1, math.nan, math.inf, None)
        ),
        ({"formation": 3}, "formation 3 is not allowed; wanted point, edge, corners"),
        ({"formation": ["point"]}, "formation ['point'] is not allowed; wanted point, edge, corners"),
    ],
)
def test_a_fleet_that_is_none_is_refused_in_a_line(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
        SourceSearchParallel(**settings)


def test_a_learned_policy_flies_in_it_as_in_a_rollout() -> None:
    said = {"vehicles": 2, "formation": "corners"}
    _, trace = rollout(4, "ppo", 50, budget=5, assume="paper", **said)
    policy = load(SHIPPED["ppo"])
    env = SourceSearchParallel(particles=50, budget=5, fits=policy.page.move.fits, **said)
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
    with pytest.raises(ValueError, match=r"^vehicles 9"):
        SourceSearchParallel(vehicles=9)
    with pytest.raises(TypeError, match="vehicles, formation, separation_m, "):
        SourceSearchParallel(colour="red")
    env = SourceSearchParallel(**SMALL)
    _, before = env.reset(seed=4)
    with pytest.raises(ActionError, match="whole number from 0 to 15"):
        env.step({"uav_1": 3, "uav_2": 16})
    for actions, said in (
        ({"uav_1": 3}, r"\['uav_1'\]"),
        ({}, r"\[\]"),
        ({"uav_1": 3, "uav_2": 3, "uav_3": 3}, r"\['uav_1', 'uav_2', 'uav_3'\]"),
        ([3, 3], r"\[3, 3\]"),
    ):
        wanted = f"^actions of {said} are not allowed; wanted one of each of uav_1, uav_2$"
        with pytest.raises(ActionError, match=wanted):
            env.step(actions)  # type: ignore[arg-type]
    *_, after = env.step({"uav_1": 0, "uav_2": 0})
    assert math.dist(before["uav_1"]["position"], after["uav_1"]["position"]) <= 1.001
