"""Protects the bracket of the information floor: its lower bound, the paths found, and the flown paths."""

import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent.trials.floor import floors_m
from benchmarks import floor
from plume.scenario import Scenario, draw

pytestmark = pytest.mark.full

ROOT = Path(__file__).parents[2]
CALM = Scenario(source=(15.0, 15.0), q=300.0, u=0.0, phi=0.0, d=4.5, tau=10.0, start=(12.0, 15.0))
WINDY = Scenario(source=(15.0, 15.0), q=300.0, u=2.0, phi=2.5, d=3.0, tau=10.0, start=(13.0, 13.5))
SHORT = [
    CALM,
    WINDY,
    Scenario(source=(14.0, 12.0), q=120.0, u=3.5, phi=5.0, d=1.5, tau=10.0, start=(13.0, 14.0)),
]


def test_the_floor_bends_where_straight_would_not_do() -> None:
    s = Scenario(source=(20.0, 15.0), q=300.0, u=2.0, phi=0.0, d=4.5, tau=10.0, start=(10.0, 15.0))
    found = floor.brackets(s, [0.5])[0.5]
    assert found.found_m <= 11  # the source is 10 m away
    assert floor.spread_m(s, found.headings) < 0.5
    assert len(found.headings) == found.found_m


@pytest.mark.parametrize("s", SHORT)
def test_the_lower_bracket_is_below_what_brute_force_finds(s: Scenario) -> None:
    headings = np.linspace(0, 2 * math.pi, 24, endpoint=False)
    for steps in (1, 2, 3):
        brute = min(floor.spread_m(s, path) for path in itertools.product(headings, repeat=steps))
        assert floor.lower_m(s, brute * 1.0001) <= steps


def test_nothing_is_excluded_that_a_wandering_oracle_reaches() -> None:
    rng = np.random.default_rng(3)
    for seed in range(1_000_000, 1_000_008):
        s = draw(seed)
        (x, y), (source_x, source_y) = s.start, s.source
        steps = round(math.dist(s.start, s.source))
        straight = math.atan2(source_y - y, source_x - x)
        spread = min(floor.spread_m(s, straight + rng.normal(0, 0.1, steps).cumsum()) for _ in range(200))
        assert floor.lower_m(s, spread * 1.0001) <= steps


def test_the_lower_bracket_is_not_above_the_floor_and_both_fall_as_the_threshold_grows() -> None:
    for seed in range(1_000_000, 1_000_008):
        brackets = [
            floor.brackets(draw(seed), [0.9, 0.2, 0.5])[threshold_m] for threshold_m in (0.2, 0.5, 0.9)
        ]
        assert all(bracket.lower_m <= bracket.found_m for bracket in brackets)
        assert sorted((b.found_m for b in brackets), reverse=True) == [b.found_m for b in brackets]
        assert sorted((b.lower_m for b in brackets), reverse=True) == [b.lower_m for b in brackets]


def test_the_floor_at_one_threshold_does_not_depend_on_which_others_are_asked_for() -> None:
    s = draw(1_000_003)
    alone, among = floor.brackets(s, [0.3])[0.3], floor.brackets(s, [0.1, 0.3, 0.9])[0.3]
    assert alone == among


def test_a_floor_beyond_the_budget_is_infinite() -> None:
    bracket = floor.brackets(draw(1_000_000), [0.5], budget=3)[0.5]
    assert (bracket.found_m, bracket.lower_m) == (math.inf, math.inf)


@pytest.mark.parametrize("seed", range(1_000_000, 1_000_010))
def test_the_quick_search_finds_what_the_thorough_one_does(seed: int) -> None:
    # The quick search starts from other paths and refines fewer; one step more is allowed.
    thresholds_m = [0.9, 0.2, 0.5]
    brackets = floor.brackets(draw(seed), thresholds_m)
    for threshold_m, found_m in floors_m(draw(seed), thresholds_m).items():
        assert brackets[threshold_m].lower_m <= found_m <= brackets[threshold_m].found_m + 1


def test_the_flown_spread_comes_below_a_threshold_near_the_floor() -> None:
    # Over ten missions, the filter's spread is compared with its expectation; a mean difference of 2 m is
    # allowed.
    differences = []
    for seed in range(1_000_000, 1_000_010):
        found = floor.brackets(draw(seed), [0.5])[0.5]
        differences.append(floor.fly(seed, found.headings, 0.5) - found.found_m)
    assert abs(np.mean(differences)) < 2.0


def test_the_command_prints_one_json_object_as_its_last_line() -> None:
    command = [
        sys.executable,
        "benchmarks/floor.py",
        "--missions",
        "3",
        "--threshold",
        "0.5",
        "0.9",
        "--json",
    ]
    done = subprocess.run(
        command, cwd=ROOT, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True
    )
    rows = json.loads(done.stdout.splitlines()[-1])
    assert rows["0.5"]["missions"] == 3
    assert rows["0.9"]["lower_bracket_m"] <= rows["0.9"]["floor_m"] <= rows["0.5"]["floor_m"]
    assert "| ζ, m |" in done.stderr
