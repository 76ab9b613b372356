"""Protects the missions as stable-baselines3 sees them: what it is told of the end of each, and that its
learners learn from them.
"""

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.learn.env import SourceSearch, SourceSearchVector

pytestmark = [pytest.mark.slow, pytest.mark.full]

QUICK: dict[str, Any] = {"particles": 50, "threshold_m": 7.0, "budget": 18}
"""Missions of which some stop and some spend their budget."""
COUNT = 6


def adapted(**settings: Any) -> Any:
    from agent.learn.sb3 import StableBaselinesEnv  # which loads torch

    return StableBaselinesEnv(SourceSearchVector(COUNT, **(QUICK | settings)))


@pytest.mark.parametrize("continuous", [False, True])
def test_the_end_of_a_mission_is_told_in_stable_baselines_words(continuous: bool) -> None:
    env = adapted(continuous=continuous)
    alone = [SourceSearch(continuous=continuous, **QUICK) for _ in range(COUNT)]
    env.seed(5)
    seen = env.reset()
    for i, single in enumerate(alone):
        assert single.reset(seed=5 + i)[0].tobytes() == seen[i].tobytes()
    rng, stopped, spent = np.random.default_rng(0), 0, 0
    for _ in range(100):
        actions = (
            rng.uniform(-1, 1, (COUNT, 2)).astype(np.float32) if continuous else rng.integers(16, size=COUNT)
        )
        actions[:2] = (0.0, 1.0) if continuous else 0  # these fly to their estimates
        seen, rewards, dones, infos = env.step(actions)
        assert (rewards.dtype, dones.dtype, len(infos)) == (np.float32, np.bool_, COUNT)
        for i, single in enumerate(alone):
            last, reward, terminated, truncated, told = single.step(actions[i])
            assert (dones[i], rewards[i]) == (terminated or truncated, np.float32(reward))
            if not dones[i]:
                assert infos[i] == {}
                assert seen[i].tobytes() == last.tobytes()
                continue
            assert infos[i]["terminal_observation"].tobytes() == last.tobytes()
            assert infos[i]["TimeLimit.truncated"] is truncated
            assert infos[i]["ceased"] is terminated
            for name in ("seed", "located", "distance_m", "spread_m"):
                assert infos[i][name] == told[name]
            assert seen[i].tobytes() == single.reset()[0].tobytes()  # the next mission has begun
            stopped, spent = stopped + terminated, spent + truncated
    assert min(stopped, spent) > 2


def test_a_seed_is_for_one_reset() -> None:
    env = adapted()
    assert env.seed(3) == list(range(3, 3 + COUNT))
    first = env.reset()
    following = env.reset()
    assert (first != following).any()
    env.seed(3)
    assert env.reset().tobytes() == first.tobytes()
    assert env.reset().tobytes() == following.tobytes()


def test_options_of_a_reset_are_refused_here_too() -> None:
    env = adapted()
    env.set_options({"start": (1.0, 2.0)})
    with pytest.raises(ValueError, match=r"^options \{'start': \(1.0, 2.0\)\} are not allowed"):
        env.reset()


def test_what_is_one_for_all_cannot_be_set_for_one() -> None:
    from stable_baselines3.common.vec_env import VecMonitor

    env = adapted()
    assert env.get_attr("num_envs", indices=[0, 2]) == [COUNT, COUNT]
    assert env.render_mode is None
    assert env.has_attr("settings")
    assert not env.has_attr("pixels")
    assert env.env_is_wrapped(VecMonitor, indices=1) == [False]
    with pytest.raises(NotImplementedError, match="share their settings"):
        env.set_attr("settings", None)
    with pytest.raises(NotImplementedError, match="share their methods"):
        env.env_method("reset")


SMALL: dict[str, Any] = {
    "policy": "MlpPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "device": "cpu",
    "seed": 1,
}
OFF_POLICY: dict[str, Any] = {"buffer_size": 400, "learning_starts": 50, "batch_size": 32}


@pytest.mark.parametrize(
    ("kind", "settings", "continuous"),
    [
        ("PPO", {"n_steps": 32, "batch_size": 64}, False),
        ("PPO", {"n_steps": 32, "batch_size": 64}, True),
        ("DQN", OFF_POLICY, False),
        ("DDPG", OFF_POLICY, True),
    ],
    ids=["ppo, headings", "ppo, heading and step", "dqn", "ddpg"],
)
def test_stable_baselines_learns(
    kind: str, settings: dict[str, Any], continuous: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import stable_baselines3
    from stable_baselines3.common.vec_env import VecMonitor

    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))  # else it leaves a folder behind
    env = VecMonitor(adapted(continuous=continuous))
    model = getattr(stable_baselines3, kind)(env=env, **SMALL, **settings)
    before = [value.clone() for value in model.policy.parameters()]
    model.learn(256)
    assert model.num_timesteps >= 256
    assert any((value != old).any() for value, old in zip(model.policy.parameters(), before, strict=True))
    ended: deque[dict[str, Any]] = model.ep_info_buffer
    assert len(ended) > 10
    assert all(1 <= episode["l"] <= 18 for episode in ended)
    action, _ = model.predict(env.reset(), deterministic=True)
    assert action.shape == ((COUNT, 2) if continuous else (COUNT,))
