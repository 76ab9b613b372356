"""Parallel missions as a stable-baselines3 VecEnv."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agent.learn.env import Settings, SourceSearchVector


class StableBaselinesEnv(VecEnv):
    """`SourceSearchVector` with the interface of stable-baselines3."""

    def __init__(self, vector: SourceSearchVector) -> None:
        self.vector = vector
        self._actions: NDArray[Any] = np.empty(0)
        super().__init__(vector.num_envs, vector.single_observation_space, vector.single_action_space)

    def fly(self, settings: Mapping[str, Any]) -> None:
        """Fly missions of other settings from the next reset on; observations and actions stay the same."""
        if Settings.of(settings) != self.vector.settings:
            self.vector = SourceSearchVector(self.num_envs, self.vector.threads, **settings)

    def reset(self) -> NDArray[np.float32]:
        """Begin new missions. Raises ValueError if options have been set: there are none."""
        # The first mission's seed and options stand for all.
        observations, _ = self.vector.reset(
            seed=self._seeds[0], options=next(filter(None, self._options), None)
        )
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Fly the stored actions."""
        observations, rewards, terminated, truncated, told = self.vector.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        over = terminated | truncated
        for i in np.flatnonzero(over).tolist():
            last = {name: values[i] for name, values in told["final_info"].items()}
            infos[i] = last | {
                "terminal_observation": told["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "ceased": bool(terminated[i]),
            }
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return the shared value once for each mission."""
        return [getattr(self.vector, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Not possible: all missions share one object."""
        raise NotImplementedError("the missions of a batch share their settings")

    def env_method(
        self, method_name: str, *args: Any, indices: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Not possible: all missions share one object."""
        raise NotImplementedError("the missions of a batch share their methods")

    def env_is_wrapped(
        self, wrapper_class: type[Any], indices: int | Iterable[int] | None = None
    ) -> list[bool]:
        """Nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]
