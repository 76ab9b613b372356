"""Training recipes. A run is a function of its recipe and its seed."""

from collections.abc import Mapping
from typing import Any

import msgspec

TRAIN_FREQ = {"dqn": 4, "ddpg": 1}


class Recipe(msgspec.Struct, frozen=True, kw_only=True):
    """The settings of a training run, except its seed."""

    algorithm: str  # `ppo`, `dqn` or `ddpg` of stable-baselines3
    steps: int  # total number of moves of all missions
    missions: int  # number of missions flown in parallel
    env: dict[str, Any]  # settings of `agent.learn.env.Settings`
    layers: tuple[int, ...]  # widths of the hidden layers, the same for policy and value
    learning_rate: float
    final_learning_rate: float  # the learning rate falls linearly to this value
    settings: dict[str, Any]  # other arguments of stable-baselines3's class
    action_noise: float = 0.0  # DDPG's exploration noise: standard deviation, for actions in [−1, 1]
    actor_learning_rate_share: float = 1.0  # DDPG's actor learns at this share of the critic's rate
    checkpoint_steps: int = 100_000  # moves between two checkpoints; at each one all missions begin anew
    first: dict[str, Any] = {}  # settings of env that differ in the first part of the run
    first_share: float = 0.0  # the first part, as a share of the steps; it ends at a checkpoint
    flown: dict[str, Any] = {}  # settings of env that differ where the policy flies

    def env_at(self, steps: int) -> dict[str, Any]:
        """Return the settings of the environment after so many moves."""
        return self.env | (self.first if steps < self.first_share * self.steps else {})

    @property
    def moves_at_a_time(self) -> int:
        """Moves of all missions between two updates. The length of a run is a multiple of it."""
        # The defaults are those of stable-baselines3.
        each: int = (
            self.settings.get("n_steps", 2048)
            if self.algorithm == "ppo"
            else self.settings.get("train_freq", TRAIN_FREQ[self.algorithm])
        )
        return each * self.missions


PAPER_LAYERS = (128, 128, 128)
PAPER_ENV = {"observation": "paper", "reward": "paper", "headings": 4}
TUNED_ENV = {"observation": "polar", "reward": "cost", "headings": 16}
# Who has learned with whole steps flies less than who has learned with those (docs/learning.md).
TUNED_FLOWN = {"fits": True}
ANYWHERE_ENV = {
    "observation": "polar-2",
    "reward": "way",
    "headings": 16,
    "problem": "anywhere",
    "assume": "field",
    "particles": 100,
}

# The paper's settings, but for one exception, of ddpg; where it states none, those of stable-baselines3.
PAPER = {
    "ppo": Recipe(
        algorithm="ppo",
        steps=500_000,
        missions=16,
        env=PAPER_ENV,
        layers=PAPER_LAYERS,
        learning_rate=1e-4,
        final_learning_rate=1e-4,
        settings={"n_steps": 128, "batch_size": 64, "gamma": 0.99, "gae_lambda": 0.95},
    ),
    "dqn": Recipe(
        algorithm="dqn",
        steps=200_000,
        missions=1,
        env=PAPER_ENV,
        layers=PAPER_LAYERS,
        learning_rate=1e-4,
        final_learning_rate=1e-4,
        settings={
            "batch_size": 64,
            "buffer_size": 1000,
            "learning_starts": 1000,
            "gamma": 0.99,
            "target_update_interval": 100,
        },
    ),
    "ddpg": Recipe(
        algorithm="ddpg",
        steps=100_000,
        missions=1,
        env={**PAPER_ENV, "continuous": True},
        layers=PAPER_LAYERS,
        learning_rate=1e-4,
        final_learning_rate=1e-4,
        actor_learning_rate_share=0.1,
        # Not the paper's replay of 1,000, and more noise than usual: else no training mission ends with a
        # stop, and there is nothing to learn from (docs/learning.md).
        action_noise=0.5,
        settings={"batch_size": 64, "buffer_size": 100_000, "learning_starts": 1000, "gamma": 0.99},
    ),
}

# The best settings found (docs/learning.md).
TUNED = {
    "ppo": Recipe(
        algorithm="ppo",
        steps=6_000_000,
        missions=128,
        env=TUNED_ENV,
        flown=TUNED_FLOWN,
        layers=(256, 256),
        learning_rate=5e-4,
        final_learning_rate=1e-5,
        settings={
            "n_steps": 64,
            "batch_size": 2048,
            "n_epochs": 4,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "ent_coef": 0.003,
        },
    ),
    "dqn": Recipe(
        algorithm="dqn",
        steps=1_500_000,
        missions=64,
        env=TUNED_ENV,
        flown=TUNED_FLOWN,
        layers=(256, 256),
        learning_rate=5e-4,
        final_learning_rate=1e-5,
        settings={
            "batch_size": 256,
            "buffer_size": 200_000,
            "learning_starts": 10_000,
            "train_freq": 1,
            "gradient_steps": 4,
            "n_steps": 3,
            "gamma": 0.99,
            "target_update_interval": 6400,
            "exploration_fraction": 0.1,
            "exploration_final_eps": 0.02,
        },
    ),
    "ddpg": Recipe(
        algorithm="ddpg",
        steps=1_000_000,
        missions=64,
        env={**TUNED_ENV, "continuous": True},
        flown=TUNED_FLOWN,
        layers=(256, 256),
        learning_rate=5e-4,
        final_learning_rate=1e-5,
        action_noise=0.2,
        actor_learning_rate_share=0.2,
        settings={
            "batch_size": 256,
            "buffer_size": 200_000,
            "learning_starts": 20_000,
            "train_freq": 1,
            "gradient_steps": 4,
            "n_steps": 3,
            "gamma": 0.99,
            "tau": 0.005,
        },
    ),
}

# For any area, step and prior: a problem is drawn for each mission (`agent.learn.problems`). Updates under
# `field` take longer than under `paper`, so the first part is learned under `paper`.
ANYWHERE = {
    "ppo": Recipe(
        algorithm="ppo",
        steps=1_500_000,
        missions=128,
        env=ANYWHERE_ENV,
        first={"assume": "paper", "particles": 200},
        first_share=0.45,
        layers=(256, 256),
        learning_rate=5e-4,
        final_learning_rate=1e-5,
        settings={
            "n_steps": 64,
            "batch_size": 2048,
            "n_epochs": 4,
            "gamma": 0.995,
            "gae_lambda": 0.95,
            "ent_coef": 0.003,
        },
    ),
}

PRESETS: Mapping[str, Mapping[str, Recipe]] = {"tuned": TUNED, "paper": PAPER, "anywhere": ANYWHERE}
