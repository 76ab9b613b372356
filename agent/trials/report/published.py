"""The figures that the paper reports."""

from typing import NamedTuple


class Published(NamedTuple):
    """One figure of the paper. Settings that the paper does not state are None."""

    figure: str  # our figure of the same meaning: a key of `agent.trials.figures.figures`
    value: float  # a share, or m, or s
    method: str
    policy: str  # our policy of the same name
    particles: int | None = None
    threshold_m: float | None = None
    below: bool = False  # the paper says only that the figure is below `value`


PUBLISHED = (
    Published("ceased", 0.8821, "AGDC-PPO", "ppo", particles=100),
    Published("ceased", 0.9527, "AGDC-PPO", "ppo", particles=4000),
    Published("ceased", 0.8839, "Infotaxis", "infotaxis", particles=4000),
    Published("ceased", 0.05, "random", "random", below=True),
    Published("ceased", 0.9913, "AGDC-PPO", "ppo", threshold_m=0.9),
    Published("mtd_m", 34.33, "AGDC-DDPG", "ddpg", particles=100),
    Published("mtd_m", 16.83, "AGDC-DDPG", "ddpg", particles=4000),
    Published("mtd_m", 148.83, "Entrotaxis", "entrotaxis", particles=100),
    Published("mtd_m", 78.69, "Entrotaxis", "entrotaxis", particles=4000),
    Published("mtd_m", 12.8, "AGDC-DDPG", "ddpg", threshold_m=0.9),
    Published("mtd_m", 56.4, "Infotaxis", "infotaxis", threshold_m=0.9),
    Published("search_time_s", 0.94, "AGDC-DQN", "dqn"),
    Published("search_time_s", 3.15, "Infotaxis", "infotaxis"),
)
