"""Protects the environments in other problems: the checkers of Gymnasium and of stable-baselines3."""

import warnings
from typing import Any

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

import plumeward  # noqa: F401  registers the environments
from plume.problem import Area, Problem

IDS = ("plumeward/SourceSearch-v0", "plumeward/SourceSearchContinuous-v0")
PROBLEMS = {
    "another rectangle": Problem(area=Area((-20.0, 0.0), (80.0, 50.0)), step_m=2.0),
    "a prior": Problem(area=Area((0.0, 0.0), (60.0, 40.0)), prior=Area((30.0, 0.0), (60.0, 40.0))),
    "a large field": Problem(area=Area((0.0, 0.0), (400.0, 400.0)), step_m=10.0, d=(20.0, 80.0)),
    "buildings": Problem(keep_out=(((12.0, 12.0), (18.0, 12.0), (18.0, 18.0), (12.0, 18.0)),)),
    "gas in puffs": Problem(world="puffs:share=0.3", q=(100.0, 200.0), u=(1.0, 2.0), budget=50),
}


def make(name: str, problem: Problem) -> Any:
    made = gymnasium.make(name, problem=problem, particles=100, threshold_m=1.5, assume="field")
    return made.unwrapped


@pytest.mark.parametrize("problem", PROBLEMS.values(), ids=list(PROBLEMS))
@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_checker_finds_nothing(name: str, problem: Problem) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(name, problem), skip_render_check=True)


@pytest.mark.full
@pytest.mark.slow
@pytest.mark.parametrize("problem", PROBLEMS.values(), ids=list(PROBLEMS))
@pytest.mark.parametrize("name", IDS)
def test_stable_baselines_checker_finds_nothing(name: str, problem: Problem) -> None:
    from stable_baselines3.common import env_checker

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_checker.check_env(make(name, problem), skip_render_check=True)
