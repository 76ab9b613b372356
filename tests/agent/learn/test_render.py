"""Protects what the environments render: gymnasium's checker is content, the picture is of this mission,
and looking changes nothing.
"""

import math
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import plumeward  # noqa: F401  registers the environments
from agent.learn.env import SourceSearch, SourceSearchVector
from agent.learn.problems import anywhere
from agent.learn.render import Onlooker
from estimator.criterion import parse
from plume.scenario import draw
from plume.worlds.world import World
from scene.scene import Scene

pytestmark = pytest.mark.slow

IDS = ("plumeward/SourceSearch-v0", "plumeward/SourceSearchContinuous-v0")
QUICK: dict[str, Any] = {"particles": 100, "threshold_m": 1.5}


@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_checker_finds_nothing_where_it_also_renders(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(name, render_mode="rgb_array", **QUICK)
        check_env(env.unwrapped)
        assert env.unwrapped.metadata["render_modes"] == ["rgb_array"]


def test_looking_changes_nothing() -> None:
    looked, plain = SourceSearch("rgb_array", **QUICK), SourceSearch(**QUICK)
    assert looked.reset(seed=4)[0].tobytes() == plain.reset(seed=4)[0].tobytes()
    over = False
    while not over:
        looked.render()
        one, other = looked.step(0), plain.step(0)
        assert one[0].tobytes() == other[0].tobytes()
        assert one[1:4] == other[1:4]
        assert {name: np.array(value).tobytes() for name, value in one[4].items()} == {
            name: np.array(value).tobytes() for name, value in other[4].items()
        }
        over = one[2] or one[3]
    assert looked.render() is not None
    assert plain.render() is None


def test_a_scene_is_of_this_mission_its_truth_and_its_belief() -> None:
    env = SourceSearch("rgb_array", world="wind-30", **QUICK)
    env.reset(seed=11)
    told = [env.step(0)[4] for _ in range(3)][-1]
    assert isinstance(env.onlooker, Onlooker)
    assert env.missions is not None
    scene = env.onlooker.scene(env.missions, 0)
    world = World(draw(11), 11, name="wind-30")
    assert scene.backdrop.release is not None
    assert scene.backdrop.release.source == world.truth.source
    assert scene.backdrop.release.wind == world.truth.wind  # as it is
    assert scene.wind == world.wind  # as it is measured
    last = scene.measurements[-1]
    assert [it.step for it in scene.measurements] == [0, 1, 2, 3]
    assert (last.position, last.estimate, last.spread_m) == (
        tuple(told["position"]),
        tuple(told["estimate"]),
        told["spread_m"],
    )
    assert [it.gas for it in scene.measurements] == [
        world.gas(it.position, it.step) for it in scene.measurements
    ]
    assert scene.scatter is not None
    assert scene.scatter.weights.sum() == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(scene.scatter.weights @ scene.scatter.places, last.estimate, atol=1e-4)
    assert last.spread_m == pytest.approx(math.sqrt(last.covariance[0] + last.covariance[2]))
    (x0, y0), (x1, y1) = (it.position for it in scene.measurements[-2:])
    assert scene.craft is not None
    assert scene.craft.heading == pytest.approx(math.atan2(y1 - y0, x1 - x0), abs=1e-5)


def test_the_end_of_a_mission_is_judged() -> None:
    env = SourceSearch("rgb_array", **QUICK)
    seen = set()
    for seed in range(8):
        env.reset(seed=seed)
        over = False
        while not over:
            _, _, over, cut, told = env.step(0)
            over = over or cut
        scene = env.onlooker.scene(env.missions, 0)  # type: ignore[union-attr, arg-type]
        assert scene.ending is not None
        seen.add(scene.ending.verdict)
        assert (scene.ending.verdict == "located") == told["located"]
    assert "located" in seen
    short = SourceSearch("rgb_array", budget=2, particles=10)
    short.reset(seed=1)
    short.step(3)
    assert short.onlooker.scene(short.missions, 0).ending is None  # type: ignore[union-attr, arg-type]
    short.step(3)
    assert short.onlooker.scene(short.missions, 0).ending.verdict == "not ceased"  # type: ignore[union-attr, arg-type]


def test_a_scene_has_the_stop_and_the_budget_of_the_resets_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    from scene.drawing import Drawing

    rooms = []

    def drawing(scene: Scene, steps: int) -> Drawing:
        rooms.append(steps)
        return Drawing(scene, steps=steps)

    monkeypatch.setattr("scene.drawing.Drawing", drawing)
    one, many = (
        SourceSearch("rgb_array", particles=60),
        SourceSearchVector(render_mode="rgb_array", particles=60),
    )
    problem = {"stop": "within:2,0.9", "budget": 3}
    for env in (one, many):
        env.reset(seed=5)
        env.reset(seed=5, options={"problem": problem})
        assert env.onlooker.scene(env.missions, 0).stop == "within:2,0.9"  # type: ignore[union-attr, arg-type]
        env.render()
        env.reset(seed=5)
        assert env.onlooker.scene(env.missions, 0).stop == "spread:0.5"  # type: ignore[union-attr, arg-type]
    assert rooms == [3, 3]


def test_a_set_of_problems_is_drawn_each_as_it_is() -> None:
    env = SourceSearch("rgb_array", problem="anywhere", observation="polar-2", particles=60)
    for seed in (1, 2):
        env.reset(seed=seed)
        scene = env.onlooker.scene(env.missions, 0)  # type: ignore[union-attr, arg-type]
        assert scene.backdrop.area == anywhere(seed).area
        assert parse(scene.stop) == parse(anywhere(seed).stop)
        assert env.render() is not None


def test_frames_differ_as_the_vehicle_moves_and_the_next_mission_has_a_picture_of_its_own() -> None:
    env = SourceSearch("rgb_array", **QUICK)
    env.reset(seed=1)
    first = env.render()
    env.step(0)
    second = env.render()
    for frame in (first, second):
        assert frame is not None
        assert (frame.shape, frame.dtype) == ((540, 960, 3), np.uint8)
    assert (first != second).any()
    env.reset(seed=2)
    other = SourceSearch("rgb_array", **QUICK)
    other.reset(seed=2)
    np.testing.assert_array_equal(env.render(), other.render())


def test_a_vector_environment_shows_each_mission_as_it_is_shown_alone() -> None:
    several = gymnasium.make_vec(IDS[0], 2, render_mode="rgb_array", particles=100, budget=2)
    several.reset(seed=5)
    for _ in range(3):  # beyond the budget: the second missions have begun
        several.step(np.zeros(2, int))
    frames = several.render()
    assert isinstance(frames, tuple)
    assert len(frames) == 2
    alone = SourceSearch("rgb_array", particles=100, budget=2)
    for i, frame in enumerate(frames):
        alone.reset(seed=int(several.unwrapped.missions.seeds[i]))  # type: ignore[attr-defined]
        alone.step(0)
        np.testing.assert_array_equal(frame, alone.render())


def test_what_cannot_be_rendered_is_told_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for make in (SourceSearch, SourceSearchVector):
        with pytest.raises(
            ValueError, match=r"^render_mode 'ansi' is not allowed; wanted None or 'rgb_array'$"
        ):
            make(render_mode="ansi")
        env = make(render_mode="rgb_array", particles=10)
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.render()
        env.reset(seed=1)
        with monkeypatch.context() as without:
            without.delitem(sys.modules, "scene.drawing", raising=False)
            without.setitem(sys.modules, "matplotlib", None)
            with pytest.raises(
                gymnasium.error.DependencyNotInstalled, match=r"pip install 'plumeward\[view\]'"
            ):
                env.render()
        assert make(particles=10).render() is None
