"""Adapter of tasks to Stable-Baselines3."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from batchpid.arrays.array_types import Document, Rows
from batchpid.errors import InvalidArgumentError, MissingDependencyError

try:
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv
except ImportError:
    raise MissingDependencyError("stable-baselines3", "SB3VecEnv", "sb3") from None


class SB3VecEnv(VecEnv):  # type: ignore[misc]
    """Task as a ``VecEnv`` of Stable-Baselines3, which resets an env within the step that ends its
    episode.

    The observation is then the first of the next episode; the last one is
    ``infos[env]["terminal_observation"]``.

    Parameters
    ----------
    envs
        Task, as from ``gymnasium.make_vec``, with ``autoreset_mode="Disabled"``.

    Raises
    ------
    InvalidArgumentError
        Another autoreset mode.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        self.envs: Any = envs.unwrapped
        if envs.metadata["autoreset_mode"] != AutoresetMode.DISABLED:
            remedy = 'make them with autoreset_mode="Disabled"'
            raise InvalidArgumentError("envs", "reset themselves", remedy=remedy)
        self.render_mode = self.envs.render_mode
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Rows:
        """Reset every env, with the seeds of :meth:`seed`, and return the observations."""
        seeds = None if self._seeds[0] is None else list(self._seeds)
        observation, info = self.envs.reset(seed=seeds)
        self.reset_infos = [_of_env(info, env) for env in range(self.num_envs)]
        self._reset_seeds()
        return np.asarray(observation)

    def step_async(self, actions: Rows) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Rows, Rows, Rows, list[Document]]:
        """Return observations, rewards, ends of episodes, and the infos of the envs."""
        observation, reward, terminated, truncated, info = self.envs.step(self._actions)
        ends = terminated | truncated
        infos = []
        for env, end in enumerate(ends):
            entries = _of_env(info, env)
            entries["TimeLimit.truncated"] = bool(truncated[env] and not terminated[env])
            if end:
                entries["terminal_observation"] = observation[env]
            infos.append(entries)
        if ends.any():
            observation, _ = self.envs.reset(options={"reset_mask": ends})
        return observation, reward.astype(np.float32), ends, infos

    def close(self) -> None:
        """Close the task."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the task for each env."""
        return self._for_envs(getattr(self.envs, attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the task, which all envs share."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **options: Any) -> Any:
        """Call a method of the task, and return the result for each env."""
        return self._for_envs(getattr(self.envs, method_name)(*args, **options), indices)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for each env: a task has no wrappers of single envs."""
        return self._for_envs(False, indices)

    def _for_envs(self, value: Any, indices: Any) -> list[Any]:
        """Return what all envs share for each of some envs."""
        return [value] * len(self._get_indices(indices))


def _of_env(info: Document, env: int) -> Document:
    """Return the entries of an info for one env."""
    entries = {key: rows[env].item() for key, rows in info.items() if not key.startswith("_")}
    return entries | {"is_success": entries["success"]}
