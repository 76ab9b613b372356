"""Protects missions flown in-process, and the honesty of the stop over many of them."""

import math
import subprocess
import sys
from itertools import pairwise

import pytest

from agent.trials.rollout import rollout


def test_a_rollout_is_a_function_of_its_seed() -> None:
    first, trace = rollout(3, "infotaxis", particles=300)
    second, again = rollout(3, "infotaxis", particles=300)
    assert trace == again
    assert (first.estimate, first.steps) == (second.estimate, second.steps)
    assert rollout(4, "infotaxis", particles=300)[1] != trace


def test_the_budget_counts_moves() -> None:
    result, trace = rollout(1, "random", particles=100, budget=7)
    assert not result.ceased
    assert (result.steps, len(trace)) == (7, 8)


def test_every_move_is_a_metre_inside_the_area() -> None:
    _, trace = rollout(5, "random", particles=100)
    for a, b in pairwise(trace):
        assert math.dist(a.position, b.position) == pytest.approx(1.0, abs=1e-5)
        assert min(b.position) >= 0
        assert max(b.position) <= 30


def test_infotaxis_finds_the_source_and_its_stop_can_be_believed() -> None:
    results = [rollout(seed, "infotaxis", particles=1000)[0] for seed in range(1_000_000, 1_000_060)]
    assert all(result.ceased for result in results)
    # An honest stop is located in about 98% of missions; fewer than 54 of 60 would come by chance once in 2,000 such tests.
    assert sum(result.located for result in results) >= 54
    assert sum(result.distance_m for result in results) / 60 < 70


@pytest.mark.parametrize(
    "module",
    ["agent.trials.rollout", "agent.service", "estimator.service", "sitl.uav.uav", "sitl.launch.launcher", "agent.planners.infotaxis"],
)
def test_flying_needs_no_torch(module: str) -> None:
    code = f"import sys; sys.modules['torch'] = None; import {module}; assert 'gymnasium' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
