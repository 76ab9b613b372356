"""The training loop around stable-baselines3: progress, TensorBoard, checkpoints.

A run consists of legs from checkpoint to checkpoint. Each leg begins with new missions and new random
generators, keyed by the seed and the moves so far. A leg is therefore a function of the checkpoint before
it, and a resumed run yields the identical policy.
"""

import random
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from stable_baselines3 import DDPG, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from agent.bundle import CurvePoint
from agent.learn.env import TRAINING_SEEDS, SourceSearchVector
from agent.learn.sb3 import StableBaselinesEnv
from agent.learn.train.folder import checkpoints
from agent.learn.train.recipes import Recipe
from link.cli import BadInput
from plume.randomness import derived_seed

POINTS = 100  # approximate number of points of a curve

Tell = Callable[[CurvePoint, float], None]  # of each point of the curve, and of the moves per second


class SlowActorDDPG(DDPG):
    """DDPG whose actor may have another learning rate than its critic."""

    def __init__(self, *args: Any, actor_learning_rate_share: float = 1.0, **settings: Any) -> None:
        """actor_learning_rate_share: the actor's learning rate as a share of the critic's."""
        self.actor_learning_rate_share = actor_learning_rate_share
        super().__init__(*args, **settings)

    def _update_learning_rate(self, optimizers: list[torch.optim.Optimizer] | torch.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        for group in self.actor.optimizer.param_groups:
            group["lr"] *= self.actor_learning_rate_share


class EndedMission(msgspec.Struct, frozen=True):
    """The result of a training mission."""

    ceased: bool
    located: bool
    distance_m: float


class RunState(msgspec.Struct):
    """The state of a run besides the learner."""

    steps: int = 0
    curve: list[CurvePoint] = []
    ended: list[EndedMission] = []  # missions that ended since the last point of the curve


def learner(recipe: Recipe, env: StableBaselinesEnv, seed: int) -> BaseAlgorithm:
    """Return the untrained learner of a recipe."""
    low, high = recipe.final_learning_rate, recipe.learning_rate
    common: dict[str, Any] = dict(
        policy="MlpPolicy",
        env=env,
        seed=seed,
        device="cpu",
        learning_rate=lambda left: low + (high - low) * left,
        policy_kwargs={"net_arch": list(recipe.layers), "activation_fn": nn.ReLU},
        **recipe.settings,
    )
    match recipe.algorithm:
        case "ppo":
            return PPO(**common)
        case "dqn":
            return DQN(**common)
        case _:
            noise = NormalActionNoise(np.zeros(2), np.full(2, recipe.action_noise))
            return SlowActorDDPG(
                **common, action_noise=noise, actor_learning_rate_share=recipe.actor_learning_rate_share
            )


def layers_of(model: BaseAlgorithm) -> list[nn.Module]:
    """Return the layers from the observation to the scores of the headings, or to the action."""
    policy: Any = model.policy
    if isinstance(model, PPO):
        return [*policy.mlp_extractor.policy_net, policy.action_net]
    return list(policy.q_net.q_net if isinstance(model, DQN) else policy.actor.mu)


class Legs(BaseCallback):
    """Divides a run into legs, and reports progress."""

    def __init__(self, recipe: Recipe, seed: int, folder: Path, state: RunState, tell: Tell) -> None:
        super().__init__()
        self._recipe, self._seed, self._folder, self._state, self._tell = recipe, seed, folder, state, tell
        self._begun = False
        self._every = max(recipe.steps // POINTS, 1)
        self._writer = SummaryWriter(folder / "tensorboard", purge_step=state.steps + 1)
        self._since, self._at = time.monotonic(), state.steps

    def _on_rollout_start(self) -> None:
        every = self._recipe.checkpoint_steps
        if not self._begun:  # at the start, or at the checkpoint that the run resumes from
            self._begun = True
            self._begin_leg()
        elif self.num_timesteps // every > self._state.steps // every:
            self._state.steps = self.num_timesteps
            self._writer.flush()
            save(self.model, self._state, self._folder)
            self._begin_leg()

    def _begin_leg(self) -> None:
        key = derived_seed(self._seed, f"train/{self.num_timesteps}")
        random.seed(key)
        np.random.seed(key % 2**32)  # noqa: NPY002  # stable-baselines3 draws from it
        torch.manual_seed(key)
        model = self.model
        model.action_space.seed(key % 2**32)
        assert isinstance(model.env, StableBaselinesEnv)
        model.env.fly(self._recipe.env_at(self.num_timesteps))
        model.env.seed(key % (TRAINING_SEEDS - model.n_envs))
        model._last_obs = model.env.reset()
        model._last_episode_starts = np.ones(model.n_envs, dtype=bool)
        if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None and model.num_timesteps:
            # Returns over several moves must not continue from the missions that the checkpoint broke off
            # into the new ones.
            last = model.replay_buffer.pos - 1
            model.replay_buffer.timeouts[last] = 1.0 - model.replay_buffer.dones[last]

    def _on_step(self) -> bool:
        for i in np.flatnonzero(self.locals["dones"]):
            info = self.locals["infos"][i]
            self._state.ended.append(
                EndedMission(bool(info["ceased"]), bool(info["located"]), float(info["distance_m"]))
            )
        if self.num_timesteps // self._every > (self.num_timesteps - self.model.n_envs) // self._every:
            self._point()
        return True

    def _point(self) -> None:
        now = time.monotonic()
        speed = (self.num_timesteps - self._at) / max(now - self._since, 1e-9)
        self._since, self._at = now, self.num_timesteps
        point = point_of(self.num_timesteps, self._state.ended)
        self._state.curve.append(point)
        self._state.ended.clear()
        for name in ("ceased", "located", "mtd_m"):
            if (value := getattr(point, name)) is not None:
                self._writer.add_scalar(f"missions/{name}", value, self.num_timesteps)
        self._writer.add_scalar("time/steps_per_second", speed, self.num_timesteps)
        for name, value in self.model.logger.name_to_value.items():
            if name.startswith("train/"):
                self._writer.add_scalar(name, value, self.num_timesteps)
        self._tell(point, speed)

    def _on_training_end(self) -> None:
        self._writer.close()


def point_of(steps: int, ended: list[EndedMission]) -> CurvePoint:
    """Return the point of the curve for missions that ended."""
    distances = [mission.distance_m for mission in ended if mission.ceased]
    count = max(len(ended), 1)
    return CurvePoint(
        steps,
        sum(mission.ceased for mission in ended) / count,
        sum(mission.located for mission in ended) / count,
        sum(distances) / len(distances) if distances else None,
    )


def save(model: BaseAlgorithm, state: RunState, folder: Path) -> None:
    """Write a checkpoint, completely or not at all, then delete those before it."""
    partial = folder / "checkpoint.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    model.save(partial / "learner.zip")
    if isinstance(model, OffPolicyAlgorithm):
        model.save_replay_buffer(partial / "replay.pkl")
    (partial / "state.json").write_bytes(msgspec.json.encode(state))
    partial.rename(folder / f"checkpoint-{state.steps:012d}")
    for older in checkpoints(folder)[:-1]:
        shutil.rmtree(older)


def _resumed(model: BaseAlgorithm, env: StableBaselinesEnv, path: Path) -> tuple[BaseAlgorithm, RunState]:
    """Return the learner and the state of a checkpoint. Raises BadInput if it is broken."""
    try:
        # That the loaded replay buffer has returns over several moves.
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            model = type(model).load(path / "learner.zip", env=env, device="cpu")
        if isinstance(model, OffPolicyAlgorithm):
            model.load_replay_buffer(path / "replay.pkl")
        return model, msgspec.json.decode((path / "state.json").read_bytes(), type=RunState)
    except Exception as error:  # what zipfile, torch and pickle raise on a broken file has no common base
        said = " ".join(str(error).split())[:200]
        raise BadInput(
            f"--out: {str(path)!r} cannot be read: {said or type(error).__name__}; delete it to begin anew"
        ) from error


def train(
    recipe: Recipe, seed: int, folder: Path, threads: int, tell: Tell
) -> tuple[BaseAlgorithm, list[CurvePoint]]:
    """Train by a recipe, from the last checkpoint in the folder if there is one.

    Returns the learner and its curve. Raises BadInput if that checkpoint is broken.
    """
    # More threads would change the last bits, and idle ones would take cores from the missions.
    torch.set_num_threads(1)
    env = StableBaselinesEnv(SourceSearchVector(recipe.missions, threads, **recipe.env_at(0)))
    model, state = learner(recipe, env, seed % 2**32), RunState()
    if kept := checkpoints(folder):
        model, state = _resumed(model, env, kept[-1])
    model.set_logger(Logger(None, []))
    legs = Legs(recipe, seed, folder, state, tell)
    model.learn(recipe.steps - state.steps, legs, log_interval=None, reset_num_timesteps=not state.steps)  # type: ignore[arg-type]
    return model, state.curve
