"""Protects the gymnasium environments: what the checkers ask, how episodes end and pay, and that many at
once are the same as one.
"""

import math
import re
import subprocess
import sys
import warnings
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import agent.together
import agent.trials.rollout
import plumeward  # noqa: F401  registers the environments
from agent.bundle import load
from agent.learn.env import TRAINING_SEEDS, SourceSearch, SourceSearchVector
from agent.learn.problems import anywhere
from agent.observation import SCHEMAS
from agent.planning.moves import Headings
from agent.scale_free import BOUND
from agent.trials.rollout import rollout
from link.bus.messages import Belief, Particles
from plume.problem import AREA, Area, Problem
from plume.scenario import AREA_M, draw
from plume.worlds.names import OURS
from plume.worlds.world import World
from tests.agent.test_bundle import a_bundle

DISCRETE, CONTINUOUS = IDS = ("plumeward/SourceSearch-v0", "plumeward/SourceSearchContinuous-v0")
DOCUMENT = Path(__file__).parents[3] / "docs" / "environment.md"
QUICK = {"particles": 100, "threshold_m": 1.5}
"""Missions that stop early."""


def make(name: str = DISCRETE, **settings: Any) -> Any:
    return gymnasium.make(name, **(QUICK | settings)).unwrapped


def flown(env: SourceSearch, seed: int, action: Any = 0) -> list[tuple[float, bool, bool, dict[str, Any]]]:
    """Fly the mission of a seed with one and the same action, towards the estimate by default; what each
    step said.
    """
    env.reset(seed=seed)
    said = []
    while not said or not (said[-1][1] or said[-1][2]):
        said.append(env.step(action)[1:])
    return said


@pytest.mark.parametrize("observation", SCHEMAS)
@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_checker_finds_nothing(name: str, observation: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(name, observation=observation), skip_render_check=True)


@pytest.mark.one_in(3)
@pytest.mark.slow
@pytest.mark.parametrize("observation", SCHEMAS)
@pytest.mark.parametrize("name", IDS)
def test_stable_baselines_checker_finds_nothing(name: str, observation: str) -> None:
    from stable_baselines3.common import env_checker

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_checker.check_env(make(name, observation=observation), skip_render_check=True)


@pytest.mark.parametrize("name", IDS)
def test_gymnasiums_wrappers_find_nothing_in_whole_missions(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(name, **QUICK, budget=20)
        env.action_space.seed(1)
        for _ in range(3):
            env.reset()
            over = False
            while not over:
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                over = terminated or truncated


@pytest.mark.parametrize(("observation", "size"), [("paper", 5), ("polar", 184), ("polar-2", 210)])
def test_spaces_are_what_the_settings_say(observation: str, size: int) -> None:
    env, several = (
        make(observation=observation),
        gymnasium.make_vec(DISCRETE, 3, observation=observation, headings=8),
    )
    seen = spaces.Box(-BOUND, BOUND, (size,), np.float32)
    assert (env.observation_space, env.action_space) == (seen, spaces.Discrete(16))
    assert (several.single_observation_space, several.single_action_space) == (seen, spaces.Discrete(8))
    assert several.observation_space == spaces.Box(-BOUND, BOUND, (3, size), np.float32)
    assert several.action_space == spaces.MultiDiscrete([8, 8, 8])
    assert make(CONTINUOUS).action_space == spaces.Box(-1, 1, (2,), np.float32)
    assert gymnasium.make_vec(CONTINUOUS, 3).action_space == spaces.Box(-1, 1, (3, 2), np.float32)


def test_many_at_once_come_as_a_native_vector_env() -> None:
    several = gymnasium.make_vec(CONTINUOUS, 3, threads=2, **QUICK)
    assert type(several) is SourceSearchVector
    assert several.settings.continuous
    assert several.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP


@pytest.mark.slow
def test_the_names_are_found_without_an_import() -> None:
    code = f"import gymnasium; print(gymnasium.make('plumeward:{DISCRETE}').reset(seed=1)[1]['seed'])"
    said = subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        timeout=300,
        capture_output=True,
        text=True,
        cwd=DOCUMENT.parents[1],
    )
    assert said.stdout == "1\n"


@pytest.mark.parametrize(("reward", "each", "last"), [("paper", 0.0, 1.0), ("cost", -0.01, 0.99)])
def test_a_stop_pays_and_a_step_may_cost(reward: str, each: float, last: float) -> None:
    said = flown(make(reward=reward), 0)
    assert len(said) > 5
    assert [step[0] for step in said] == pytest.approx([each] * (len(said) - 1) + [last])
    assert said[-1][1]


def test_a_short_move_costs_less_by_its_way() -> None:
    for step_m, cost in ((1.0, 0.01), (0.25, 0.0025)):
        env = make(reward="way", observation="polar-2", problem={"step_m": step_m}, budget=3)
        env.reset(seed=0)
        assert [env.step(0)[1] for _ in range(3)] == pytest.approx([-cost] * 3)
    env.reset(seed=0)
    for _ in range(
        100
    ):  # an edge that cuts a move off makes it no cheaper: there is nothing to be had by waiting
        assert env.step(8)[1] == pytest.approx(-0.0025)


def test_moves_that_fit_are_as_short_as_the_belief_is_narrow_and_cost_by_their_way() -> None:
    env = make(particles=500, threshold_m=0.05, budget=80, fits=True, reward="way")
    _, told = env.reset(seed=1)
    ratios = set()
    for _ in range(80):  # to the estimate, which is not at an edge
        before, spread_m = told["distance_m"], told["spread_m"]
        _, paid, ended, _, told = env.step(0)
        if ended:
            break
        # Table 1's area has a side of 30 m, so half a metre is a sixtieth of it.
        expected_m = min(1.0, max(spread_m / 4, min(max(4 * spread_m, 0.1), 0.5)))
        assert told["distance_m"] - before == pytest.approx(expected_m, abs=1e-5)
        assert paid == pytest.approx(-0.01 * expected_m)
        ratios.add(round(expected_m, 3))
    assert {0.5, 1.0} < ratios


@pytest.mark.parametrize("observation", SCHEMAS)
@pytest.mark.parametrize("scale", [0.5, 1, 4])
def test_a_step_costs_the_same_share_of_an_area_of_any_size(observation: str, scale: float) -> None:
    side_m = 30 * scale
    problem = {"area": {"low": [0, 0], "high": [side_m, side_m]}, "step_m": scale}
    env = make(reward="way", observation=observation, problem=problem, threshold_m=0.01)
    env.reset(seed=0)
    assert env.step(0)[1] == pytest.approx(-0.01)


def test_a_set_of_problems_has_another_one_for_each_seed() -> None:
    settings: dict[str, Any] = {**QUICK, "observation": "polar-2", "problem": "anywhere"}
    several = SourceSearchVector(3, **settings)
    several.reset(seed=5)
    assert several.missions is not None
    assert several.missions.problems == [anywhere(seed) for seed in (5, 6, 7)]
    env = make(observation="polar-2")
    env.reset(seed=6, options={"problem": "anywhere"})
    assert env.missions.problems == [anywhere(6)]
    env.reset(seed=6)
    assert env.missions.problems == [Problem()]


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({}, "problem 'anywhere' is not allowed with the observation 'polar'; wanted polar-2"),
        ({"observation": "polar-2", "budget": 5}, "budget is not allowed with problem 'anywhere'"),
        ({"observation": "polar-2", "world": "puffs"}, "world is not allowed with problem 'anywhere'"),
    ],
)
def test_what_a_set_of_problems_does_not_allow_is_said(settings: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        SourceSearch(problem="anywhere", **settings)


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("fits", [False, True])
def test_a_policy_flies_a_drawn_problem_as_it_does_on_a_vehicle(
    tmp_path: Path, seed: int, fits: bool
) -> None:
    a_bundle(tmp_path / "a.zip", "polar-2", Headings(16, fits=fits), seed=seed)
    problem, bundle = anywhere(seed), load(tmp_path / "a.zip")
    _, trace = rollout(
        seed, str(tmp_path / "a.zip"), particles=60, budget=15, assume="field", problem=problem
    )
    settings = {"observation": "polar-2", "problem": "anywhere", "assume": "field", "fits": fits}
    env = make(particles=60, threshold_m=0.5, **settings)
    seen, told = env.reset(seed=seed)
    places = [tuple(told["position"].tolist())]
    for _ in range(15):
        seen, _, _, _, told = env.step(int(bundle.page.move.action(bundle.said(seen))[0]))
        places.append(tuple(told["position"].tolist()))
    assert places == [point.position for point in trace]


@pytest.mark.parametrize(("reward", "each"), [("paper", 0.0), ("cost", -0.01)])
def test_a_spent_budget_pays_nothing(reward: str, each: float) -> None:
    said = flown(make(reward=reward, budget=4), 0)
    assert [step[:3] for step in said] == [(each, False, False)] * 3 + [(each, False, True)]


def test_a_stop_terminates_right_or_wrong() -> None:
    env, located = make(threshold_m=3.0, observation="polar"), set()
    for seed in count():
        *before, (reward, terminated, truncated, told) = flown(env, seed)
        assert (terminated, truncated) == (True, False)
        assert reward == pytest.approx(0.99)  # a wrong stop pays as well: the env does not tell the policy
        assert told["spread_m"] < 3.0
        assert not any(step[3]["located"] for step in before)  # of those that ceased
        error_m = np.linalg.norm(told["estimate"] - np.array(draw(seed).source))
        assert told["located"] == (error_m <= 1.0)
        located.add(bool(told["located"]))
        if located == {False, True}:
            break


def test_a_stop_at_the_last_step_of_the_budget_terminates_and_does_not_truncate() -> None:
    steps = len(flown(make(), 0))
    for budget, expected in ((steps + 1, (True, False)), (steps, (True, False)), (steps - 1, (False, True))):
        said = flown(make(budget=budget), 0)
        assert said[-1][1:3] == expected
        assert len(said) == min(steps, budget)


def test_the_budget_is_300_moves_and_zeta_half_a_metre_as_elsewhere() -> None:
    settings = SourceSearch().settings
    assert (settings.searched.budget, settings.particles) == (300, 500)
    assert (settings.assume, settings.criterion.text) == ("paper", "spread:0.5")
    assert SourceSearch(stop="within:2,0.9").settings.criterion.text == "within:2,0.9"


def test_a_threshold_comes_before_the_stop_of_a_problem() -> None:
    field = {"stop": "spread:9"}
    assert SourceSearch(problem=field).settings.criterion.text == "spread:9"
    assert SourceSearch(problem=field, threshold_m=0.5).settings.criterion.text == "spread:0.5"
    assert SourceSearch(problem=field, stop="spread:0.5").settings.criterion.text == "spread:0.5"


def test_infos_tell_of_the_mission() -> None:
    env = make(CONTINUOUS, observation="paper")
    seen, told = env.reset(seed=7)
    assert set(told) == {"seed", "position", "estimate", "spread_m", "distance_m", "located"}
    assert (told["seed"], told["distance_m"], bool(told["located"])) == (7, 0, False)
    assert told["position"] == pytest.approx(draw(7).start, abs=1e-6)
    for step in (1, 2):
        before = told["position"]
        seen, _, _, _, told = env.step(np.array([0.25, 0.0], np.float32))  # half a metre to the north-east
        assert told["position"] - before == pytest.approx([0.5**1.5, 0.5**1.5], abs=1e-5)
        assert told["distance_m"] == pytest.approx(0.5 * step, abs=1e-5)
        assert AREA_M * seen[:2] == pytest.approx(told["position"], abs=1e-5)
        assert AREA_M * seen[3:] == pytest.approx(told["estimate"], abs=1e-5)


def plain(values: Any, where: Any = slice(None)) -> Any:
    """Infos of a vector env without its masks, as lists: those that differ in kind only are equal."""
    if isinstance(values, dict):
        return {name: plain(value, where) for name, value in values.items() if not name.startswith("_")}
    return [
        item.tolist() if isinstance(item, np.ndarray) else item for item in np.asarray(values)[where].tolist()
    ]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("observation", SCHEMAS)
@pytest.mark.parametrize("name", IDS)
def test_many_at_once_are_what_gymnasium_makes_of_single_ones(
    name: str, observation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also through the missions that follow each seed, those that stop and those whose budget is spent."""
    monkeypatch.setattr(
        "estimator.belief.CLEAR", -math.inf
    )  # so short a flight without aim sees hardly any gas
    settings: dict[str, Any] = {"observation": observation, "particles": 50, "threshold_m": 7.0, "budget": 18}
    ours = gymnasium.make_vec(name, 8, threads=2, **settings)
    peer = gymnasium.make_vec(
        name,
        8,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        **settings,
    )
    assert isinstance(peer, SyncVectorEnv)
    ended = {"terminated": 0, "truncated": 0}
    (seen, told), (expected, truth) = ours.reset(seed=11), peer.reset(seed=11)
    ours.action_space.seed(3)
    for step in range(120):
        assert seen.tobytes() == expected.tobytes()
        assert plain(told) == plain(truth)
        if step == 60:  # resets without a seed go on
            (seen, told), (expected, truth) = ours.reset(), peer.reset()
            continue
        actions = ours.action_space.sample()
        actions[:5] = 0 if name == DISCRETE else (0.0, 1.0)  # these fly to their estimates, in `polar`
        seen, rewards, terminated, truncated, told = ours.step(actions)
        expected, other_rewards, other_terminated, other_truncated, truth = peer.step(actions)
        assert (rewards.tolist(), terminated.tolist(), truncated.tolist()) == (
            other_rewards.tolist(),
            other_terminated.tolist(),
            other_truncated.tolist(),
        )
        assert not (terminated & truncated).any()
        over = terminated | truncated
        assert ("final_obs" in told) == over.any() == ("final_obs" in truth)
        if over.any():
            final, other_final = (infos.pop("final_info") for infos in (told, truth))
            last, other_last = (infos.pop("final_obs") for infos in (told, truth))
            assert (told["_final_obs"] == over).all()
            assert (told["_final_info"] == over).all()
            assert plain(final, over) == plain(other_final, over)
            for i in range(8):
                assert (last[i] is None) == (other_last[i] is None) == (not over[i])
                assert not over[i] or last[i].tobytes() == other_last[i].tobytes()
        ended["terminated"] += int(terminated.sum())
        ended["truncated"] += int(truncated.sum())
    assert min(ended.values()) > 2


MOVING = "puffs:meander=20,gusts=0.2+readings-lost"


@pytest.mark.parametrize(
    ("name", "world", "assume"),
    [
        *((name, "as-modelled", assume) for name in IDS for assume in ("paper", "field")),
        *((DISCRETE, world, "paper") for world in ("wind-30", "cv-1-correlated", "all-at-once", MOVING)),
    ],
)
def test_a_reset_with_a_seed_begins_the_mission_that_a_rollout_flies(
    name: str, world: str, assume: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it, where the actions are the same: here they alternate between two."""
    env = make(name, world=world, assume=assume)
    first, second = (
        np.array([0, 3]) if name == DISCRETE else np.array([[0.0, 1.0], [0.3, -0.2]], np.float32)
    ).copy()

    def choose(_policy: str, said: Belief, particles: Particles, *_: Any) -> tuple[float, float]:
        _, frame = SCHEMAS["polar"].see(said, particles)
        action = second if said.step % 3 == 2 else first
        x, y = env.settings.move.waypoints(np.array([said.position]), frame[None], action[None], AREA)[
            0
        ].tolist()
        return x, y

    monkeypatch.setattr(agent.together, "choose", choose)
    for seed in (0, 1_000_002):
        flown = agent.trials.rollout.mission(
            seed, "random", QUICK["particles"], QUICK["threshold_m"], 150, world=world, assume=assume
        )
        steps = list(flown.steps)
        assert steps[-1].belief.ceased or world != "as-modelled"
        seen, told = env.reset(seed=seed)
        over = False
        for k, (said, particles, *_) in enumerate(steps):
            assert seen.tobytes() == SCHEMAS["polar"].see(said, particles)[0].tobytes()
            assert (tuple(told["position"]), tuple(told["estimate"]), told["spread_m"]) == (
                said.position,
                said.mean,
                said.spread,
            )
            assert over == said.ceased
            seen, _, over, _, told = env.step(second if k % 3 == 2 else first)


@pytest.mark.parametrize("world", ["all-at-once", "source-outside", "stuck-noisy", MOVING])
def test_many_missions_in_a_world_are_the_single_ones_there_and_so_are_those_that_follow(world: str) -> None:
    many = SourceSearchVector(4, world=world, **QUICK)
    many.reset(seed=40)
    singles = [SourceSearch(world=world, **QUICK) for _ in range(4)]
    for i, single in enumerate(singles):
        single.reset(seed=40 + i)
    begun_anew = 0
    for _ in range(60):
        seen, rewards, terminated, truncated, infos = many.step(np.zeros(4, int))
        for i, single in enumerate(singles):
            alone, reward, over, cut, told = single.step(0)
            assert (reward, over, cut) == (rewards[i], terminated[i], truncated[i])
            if over or cut:
                begun_anew += 1
                error_m = float(
                    np.linalg.norm(
                        told["estimate"]
                        - np.array(World(draw(told["seed"]), told["seed"], name=world).truth.source)
                    )
                )
                assert told["located"] == infos["final_info"]["located"][i] == (over and error_m <= 1.0)
                alone, _ = single.reset(seed=int(infos["seed"][i]))
            assert alone.tobytes() == seen[i].tobytes()
    assert begun_anew > 0 or world == "stuck-noisy"


def test_a_reset_of_many_begins_a_seed_and_those_after_it_or_those_that_are_named() -> None:
    several = SourceSearchVector(3, **QUICK)
    assert several.reset(seed=20)[1]["seed"].tolist() == [20, 21, 22]
    assert several.reset(seed=[5, 3, 1_000_000])[1]["seed"].tolist() == [5, 3, 1_000_000]
    following = several.reset()[1]["seed"].tolist()
    for seed, expected in zip((5, 3, 1_000_000), following, strict=True):
        env = make()
        env.reset(seed=seed)
        assert env.reset()[1]["seed"] == expected
    for seeds in ([1], [1, 2], [1, 2, 3, 4]):
        with pytest.raises(ValueError, match=f"{len(seeds)} seeds for 3 missions"):
            several.reset(seed=seeds)
    with pytest.raises(ValueError, match=r"^seed array\(5\) is not allowed; wanted a whole number from 0"):
        several.reset(seed=np.array(5))


def test_a_reset_has_no_option_but_a_problem_and_says_so() -> None:
    for env in (make(), SourceSearchVector(3, **QUICK)):
        for none in (None, {}):
            env.reset(seed=1, options=none)
        with pytest.raises(
            ValueError, match=r"^options \{'start': \(1.0, 2.0\)\} are not allowed; wanted none, or "
        ):
            env.reset(seed=1, options={"start": (1.0, 2.0)})
        with pytest.raises(ValueError, match=r"step_m: 20.0 is not allowed; wanted above 0 up to 10 m"):
            env.reset(seed=1, options={"problem": {"step_m": 20}})


FIELD = Problem(area=Area((-20, 0), (80, 50)), step_m=2, prior=Area((30, 0), (80, 50)), budget=9)


def test_a_reset_with_a_problem_flies_it_until_the_next_reset() -> None:
    """To the last bit as an environment that was made for it, and as rollout."""
    actions = [3, 5, 9, 0]
    made, reset, several = make(problem=FIELD), make(), SourceSearchVector(2, **QUICK)
    options = {"problem": FIELD}
    seen = [made.reset(seed=3)[0], reset.reset(seed=3, options=options)[0]]
    assert seen[0].tobytes() == seen[1].tobytes() == several.reset(seed=3, options=options)[0][0].tobytes()
    first = next(agent.trials.rollout.mission(3, "random", QUICK["particles"], 0.5, problem=FIELD).steps)
    place = np.array(first.belief.position)
    for action in actions:
        (one, *_, told), (other, *_) = made.step(action), reset.step(action)
        both, *_ = several.step(np.array([action, action]))
        assert one.tobytes() == other.tobytes() == both[0].tobytes()
        assert np.linalg.norm(told["position"] - place) == pytest.approx(2.0, abs=1e-5)
        place = told["position"]
        assert FIELD.area.holds(place)
    usual = make().reset(seed=3)[0].tobytes()
    assert reset.reset(seed=3)[0].tobytes() == usual == several.reset(seed=3)[0][0].tobytes()


@pytest.mark.parametrize("changes", [{"stop": "spread:14", "budget": 20}, {"world": "puffs+readings-lost"}])
def test_many_and_one_fly_the_stop_and_the_world_of_a_resets_problem(changes: dict[str, Any]) -> None:
    one, many = SourceSearch(particles=60), SourceSearchVector(particles=60)
    for options in (None, {"problem": changes}, None):  # there, and back again
        alone, several = one.reset(seed=5, options=options), many.reset(seed=5, options=options)
        assert alone[0].tobytes() == several[0][0].tobytes()
        over = False
        for _ in range(20):
            alone_seen, *alone_said, _ = one.step(0)
            seen, rewards, terminated, truncated, _ = many.step(np.zeros(1, int))
            assert alone_said == [rewards[0], terminated[0], truncated[0]]
            if over := alone_said[1] or alone_said[2]:
                break
            assert alone_seen.tobytes() == seen[0].tobytes()
        assert over or options is None or "stop" not in changes  # which is reached within the steps


def test_a_refused_reset_changes_nothing() -> None:
    one, many = SourceSearch(**QUICK), SourceSearchVector(**QUICK)
    for env in (one, many):
        env.reset(seed=5)
        with pytest.raises(ValueError, match="seed -1"):
            env.reset(seed=-1, options={"problem": {"budget": 1, "step_m": 0.1}})
    (_, _, over, cut, told), (_, _, overs, cuts, infos) = one.step(0), many.step(np.zeros(1, int))
    assert [over, cut, overs[0], cuts[0]] == [False] * 4
    assert told["distance_m"] == infos["distance_m"][0] == pytest.approx(1.0, abs=1e-5)


def test_the_budget_is_the_problems() -> None:
    env = make(problem=FIELD)
    env.reset(seed=3)
    ended = [env.step(0)[3] for _ in range(9)]
    assert ended == [False] * 8 + [True]


class Highest:
    """A generator that draws the greatest number it may."""

    def integers(self, high: int, size: int | None = None) -> Any:
        return np.full(size, high - 1) if size else np.int64(high - 1)


def test_no_mission_is_one_to_choose_or_to_test_by_unless_asked_for() -> None:
    assert TRAINING_SEEDS == 900_000
    several, env = SourceSearchVector(8, particles=10, budget=1, observation="paper"), make(particles=10)
    several.np_random = env.np_random = Highest()  # type: ignore[assignment]
    assert several.reset()[1]["seed"].tolist() == [899_999] * 8
    assert env.reset()[1]["seed"] == 899_999
    several.reset(seed=1_000_000)
    drawn = [several.step(np.zeros(8, int))[4]["seed"] for _ in range(60)]  # each step ends all the missions
    assert 850_000 < np.max(drawn) < 900_000
    assert len(np.unique(drawn)) > 470


def test_what_was_returned_is_not_changed_by_the_next_step() -> None:
    several = SourceSearchVector(3, **QUICK, budget=3)
    kept: list[Any] = [several.reset(seed=0)]
    before = [plain(kept[0][1])]
    seen = [kept[0][0].tobytes()]
    for _ in range(5):
        kept.append(several.step(np.array([0, 1, 2])))
        seen.append(kept[-1][0].tobytes())
        before.append(plain({name: value for name, value in kept[-1][-1].items() if name != "final_obs"}))
    for said, infos, observation in zip(kept, before, seen, strict=True):
        assert said[0].tobytes() == observation
        assert plain({name: value for name, value in said[-1].items() if name != "final_obs"}) == infos


def test_gymnasiums_wrappers_of_many_count_missions_right() -> None:
    wrapped = DictInfoToList(RecordEpisodeStatistics(SourceSearchVector(3, **QUICK, budget=4)))
    wrapped.reset(seed=1)
    for _ in range(4):
        told = wrapped.step(np.zeros(3, int))[4]
    for i, info in enumerate(told):
        assert (info["episode"]["l"], info["episode"]["r"]) == (4, pytest.approx(-0.04))
        assert info["final_info"]["seed"] == 1 + i
        assert info["final_obs"].shape == (184,)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observation": "pixels"}, "observation 'pixels' is not allowed; wanted paper or polar or polar-2"),
        ({"reward": "more"}, "reward 'more' is not allowed; wanted paper or cost or way"),
        ({"world": "breeze"}, f"world: no world 'breeze'; wanted {', '.join(OURS)}"),
        ({"headings": 1}, "headings 1 is not allowed; wanted a whole number from 2"),
        ({"headings": 7.5}, "headings 7.5 is not allowed; wanted a whole number from 2"),
        ({"particles": 9}, "particles 9 is not allowed; wanted a whole number from 10 to 1000000"),
        ({"particles": "500"}, "particles '500' is not allowed; wanted a whole number from 10 to 1000000"),
        ({"budget": 0}, "budget 0 is not allowed; wanted a whole number from 1 to 1000000"),
        (
            {"particles": 1_000_001},
            "particles 1000001 is not allowed; wanted a whole number from 10 to 1000000",
        ),
        ({"threshold_m": 0.0}, "threshold_m 0.0 is not allowed; wanted a number above 0 up to 100"),
        ({"threshold_m": 100.5}, "threshold_m 100.5 is not allowed; wanted a number above 0 up to 100"),
        ({"threshold_m": float("nan")}, "threshold_m nan is not allowed; wanted a number above 0 up to 100"),
        ({"threshold_m": "0.5"}, "threshold_m '0.5' is not allowed; wanted a number above 0 up to 100"),
        ({"threshold_m": True}, "threshold_m True is not allowed; wanted a number above 0 up to 100"),
        ({"assume": "feild"}, "assume 'feild' is not allowed; wanted paper or field"),
        (
            {"stop": "within:1"},
            "stop 'within:1' is not allowed; wanted spread:Z, metres, or within:R,P, metres and a share",
        ),
        (
            {"stop": 0.5},
            "stop 0.5 is not allowed; wanted spread:Z, metres, or within:R,P, metres and a share",
        ),
        (
            {"stop": "spread:1", "threshold_m": 0.3},
            "stop 'spread:1' is not allowed with threshold_m 0.3; wanted one of them",
        ),
        (
            {"observation": ["polar"]},
            "observation ['polar'] is not allowed; wanted paper or polar or polar-2",
        ),
        ({"budget": True}, "budget True is not allowed; wanted a whole number from 1 to 1000000"),
        ({"continuous": "no"}, "continuous 'no' is not allowed; wanted True or False"),
    ],
)
def test_what_cannot_be_set_is_told_in_a_line(settings: dict[str, Any], message: str) -> None:
    for kind in (SourceSearch, SourceSearchVector):
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            kind(**settings)


@pytest.mark.parametrize("value", [0, 2.5, "3", True, None])
@pytest.mark.parametrize("name", ["num_envs", "threads"])
def test_there_is_no_batch_of_none_and_no_work_without_a_thread(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name} {value!r} is not allowed; wanted a whole number from 1$"):
        SourceSearchVector(**{name: value})


def test_an_argument_that_there_is_not_is_named_with_those_that_there_are() -> None:
    names = "continuous, headings, observation, reward, particles, threshold_m, budget, world, assume, stop"
    said = "argument foo='bar' is not allowed; wanted some of "
    for make_one in (SourceSearch, lambda **named: gymnasium.make(DISCRETE, **named)):
        with pytest.raises(TypeError, match=f"^{re.escape(f'{said}render_mode, {names}')}"):
            make_one(foo="bar", particles=50)
    for make_many in (SourceSearchVector, lambda **named: gymnasium.make_vec(DISCRETE, 2, **named)):
        with pytest.raises(TypeError, match=f"^{re.escape(said)}num_envs, threads, render_mode, {names}"):
            make_many(foo="bar", particles=50)


@pytest.mark.slow
def test_stable_baselines_makes_one_by_its_name_with_pictures() -> None:
    from stable_baselines3.common.env_util import make_vec_env

    with warnings.catch_warnings(action="error"):
        several = make_vec_env(DISCRETE, 2, env_kwargs={"observation": "paper", **QUICK})
    assert np.shape(several.reset()) == (2, 5)
    assert [image.shape for image in several.get_images()] == [(540, 960, 3)] * 2


ONE, PAIR = "a whole number from 0 to 15", "finite numbers in an array of shape (2,)"
THREE, PAIRS = (
    "whole numbers from 0 to 15 in an array of shape (3,)",
    "finite numbers in an array of shape (3, 2)",
)


@pytest.mark.parametrize(
    ("name", "action", "said", "wanted"),
    [
        (DISCRETE, 99, "99", ONE),
        (DISCRETE, 16, "16", ONE),
        (DISCRETE, np.int64(-1), "-1", ONE),
        (DISCRETE, 3.5, "3.5 (float64, shape ())", ONE),
        (DISCRETE, float("nan"), "nan (float64, shape ())", ONE),
        (DISCRETE, "left", "'left' (<U4, shape ())", ONE),
        (DISCRETE, None, "None (object, shape ())", ONE),
        (DISCRETE, [3], "[3] (int64, shape (1,))", ONE),
        (CONTINUOUS, [float("nan"), 1.0], "[nan, 1.0]", PAIR),
        (CONTINUOUS, np.array([0, np.inf], np.float32), "[0.0, inf]", PAIR),
        (CONTINUOUS, 3, "3 (int64, shape ())", PAIR),
        (CONTINUOUS, [0.1, 0.2, 0.3], "[0.1, 0.2, 0.3] (float64, shape (3,))", PAIR),
        (CONTINUOUS, [0.1, 1j], "[0.1, 1j] (complex128, shape (2,))", PAIR),
        (DISCRETE, [0, 99, 3], "99 of mission 1", THREE),
        (DISCRETE, np.array([0, 1, -2]), "-2 of mission 2", THREE),
        (DISCRETE, [0.0, 1.0, 2.0], "[0.0, 1.0, 2.0] (float64, shape (3,))", THREE),
        (DISCRETE, [0, 1], "[0, 1] (int64, shape (2,))", THREE),
        (DISCRETE, [[0], [1], [2]], "[[0], [1], [2]] (int64, shape (3, 1))", THREE),
        (DISCRETE, [0, [1], 2], "[0, [1], 2]", THREE),
        (DISCRETE, 5, "5 (int64, shape ())", THREE),
        (CONTINUOUS, [[0, 0], [0, 0], [0.5, float("nan")]], "[0.5, nan] of mission 2", PAIRS),
        (CONTINUOUS, [0.1, 0.2, 0.3], "[0.1, 0.2, 0.3] (float64, shape (3,))", PAIRS),
    ],
)
def test_an_action_that_is_none_is_named_and_moves_nothing(
    name: str, action: Any, said: str, wanted: str
) -> None:
    several = wanted in (THREE, PAIRS)
    env: Any = gymnasium.make_vec(name, 3, **QUICK) if several else make(name)
    env.reset(seed=4)
    for kind in (ValueError, gymnasium.error.InvalidAction):
        with pytest.raises(kind, match=f"^{re.escape(f'action {said} is not allowed; wanted {wanted}')}$"):
            env.step(action)
    good = np.zeros(env.action_space.shape, env.action_space.dtype)
    seen = env.step(good)[0]
    env.reset(seed=4)
    assert env.step(good)[0].tobytes() == seen.tobytes()


@pytest.mark.parametrize(
    "action", [15, np.uint8(15), np.array(15), np.int32(15)], ids=lambda action: type(action).__name__
)
def test_whole_numbers_of_any_kind_are_actions(action: Any) -> None:
    env = make()
    env.reset(seed=4)
    seen = env.step(action)[0]
    env.reset(seed=4)
    assert env.step(15)[0].tobytes() == seen.tobytes()


def test_a_long_array_of_actions_is_refused_in_a_line() -> None:
    several = SourceSearchVector(2, **QUICK)
    several.reset(seed=4)
    with pytest.raises(ValueError, match=r"shape \(500, 7\)\) is not allowed") as refused:
        several.step(np.zeros((500, 7), int))
    assert len(str(refused.value)) < 200
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("seed", [-1, 2**63, 2**70, 1.5, "7", True], ids=str)
def test_a_seed_that_is_none_is_named(seed: Any) -> None:
    line = f"^{re.escape(f'seed {seed!r} is not allowed; wanted a whole number from 0 to {2**63 - 1}')}$"
    several = SourceSearchVector(2, **QUICK)
    expected = several.reset(seed=[5, 6])[1]["seed"].tolist()
    for begin in (
        lambda: make().reset(seed=seed),
        lambda: several.reset(seed=seed),
        lambda: several.reset(seed=[1, seed]),
    ):
        with pytest.raises(ValueError, match=line):
            begin()
    assert several.missions is not None
    assert several.missions.seeds.tolist() == expected
    assert several.reset(seed=np.int64(8))[1]["seed"].tolist() == [8, 9]
    assert several.reset(seed=np.array([8, 3]))[1]["seed"].tolist() == [8, 3]


def test_a_step_wants_a_reset_first() -> None:
    for env, action in ((SourceSearch(), 0), (SourceSearchVector(2), np.zeros(2, int))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
            env.step(action)


@pytest.mark.slow
@pytest.mark.parametrize("example", re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL))
def test_the_documents_examples_run(example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # one of them saves a picture
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))  # another one's learner would leave a folder behind
    exec(compile(example, str(DOCUMENT), "exec"), {})


def test_the_document_says_what_each_number_of_an_observation_is() -> None:
    for name, schema in SCHEMAS.items():
        section = DOCUMENT.read_text().split(f"### `{name}`")[1].split("\n#")[0]
        rows = [
            (int(first), int(last or first))
            for first, last in re.findall(r"^\| (\d+)(?: to (\d+))? \|", section, re.MULTILINE)
        ]
        assert [i for first, last in rows for i in range(first, last + 1)] == list(range(schema.size))


@pytest.mark.slow
def test_an_install_makes_the_names_known_as_soon_as_gymnasium_is_imported(tmp_path: Path) -> None:
    code = (
        "import sys, importlib.util; assert 'numba' not in sys.modules\n"
        "assert importlib.util.find_spec('gymnasium')\n"  # others look for it before they import it
        "import gymnasium, plumeward; made = gymnasium.make('plumeward/SourceSearchContinuous-v0', "
        "particles=20)\n"
        "print(made.reset(seed=7)[0].shape, [type(finder).__name__ for finder in sys.meta_path])"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], check=True, timeout=300, capture_output=True, text=True, cwd=tmp_path
    ).stdout
    assert said.startswith("(184,)")
    assert "WhenImported" not in said  # it has gone out of the way
