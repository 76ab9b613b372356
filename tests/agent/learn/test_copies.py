"""Protects copies of environments: a tree search tries moves on copies, and a study keeps them in files."""

import pickle
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.learn.env import SourceSearch, SourceSearchVector
from agent.learn.parallel import SourceSearchParallel
from tests.plume.recorded.writers import npy


def alone(**settings: Any) -> Any:
    return SourceSearch(particles=100, **settings)


def side_by_side(**settings: Any) -> Any:
    """Ten missions on two threads."""
    return SourceSearchVector(num_envs=10, threads=2, particles=100, **settings)


def together(**settings: Any) -> Any:
    return SourceSearchParallel(particles=100, **settings)


def moved(env: Any, headings: range) -> list[str]:
    """Fly these headings, the same for all; what each step said, to the last bit."""
    said = []
    for heading in headings:
        if isinstance(env, SourceSearchParallel):
            action: Any = dict.fromkeys(env.agents, heading)
        else:
            action = np.full(10, heading) if isinstance(env, SourceSearchVector) else heading
        with np.printoptions(precision=17, threshold=10_000):
            said.append(repr(env.step(action)))
    return said


def through_a_file(env: Any) -> Any:
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("copied", [deepcopy, through_a_file])
@pytest.mark.parametrize(
    ("make", "settings"),
    [
        (alone, {}),
        (alone, {"world": "puffs+wind-noisy"}),
        (alone, {"problem": "anywhere", "observation": "polar-2"}),
        (side_by_side, {}),
        (together, {}),
    ],
)
def test_a_copy_in_mid_mission_flies_on_as_the_mission_would_have(
    make: Callable[..., Any], settings: dict[str, Any], copied: Callable[[Any], Any]
) -> None:
    never_copied = make(**settings)
    never_copied.reset(seed=4)
    moved(never_copied, range(3))
    wanted = moved(never_copied, range(3, 9))
    env = make(**settings)
    env.reset(seed=4)
    moved(env, range(3))
    copy = copied(env)
    moved(copied(env), range(9, 12))  # tries something else
    assert moved(copy, range(3, 9)) == wanted
    assert moved(env, range(3, 9)) == wanted, "what a copy does leaves the mission as it was"
    assert repr(copy.reset()) == repr(never_copied.reset()), "and the next missions are the same"


@pytest.mark.parametrize("copied", [deepcopy, through_a_file])
def test_a_copy_in_a_recorded_plume_flies_on_as_well(copied: Callable[[Any], Any], tmp_path: Path) -> None:
    movie = npy(tmp_path / "m.npy", np.random.default_rng(1).random((5, 40, 40)))
    env = alone(world=f"recorded:file={movie},fps=2,source_x=20,source_y=20,wind=180")
    env.reset(seed=4)
    moved(env, range(3))
    assert moved(copied(env), range(3, 9)) == moved(env, range(3, 9))


def test_a_copy_of_an_environment_that_has_drawn_a_picture_draws_the_same_one() -> None:
    env = alone(render_mode="rgb_array")
    env.reset(seed=4)
    before = env.render()
    copy = through_a_file(deepcopy(env))
    assert np.array_equal(copy.render(), before)
    copy.step(0)
    assert not np.array_equal(copy.render(), before)
    assert np.array_equal(env.render(), before)
