"""Tasks as vector environments of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from batchpid.arrays.array_types import Document, Rows
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    raise MissingDependencyError("stable-baselines3", "batchpid.sim.gym.stable_baselines3", "sb3") from None


class TaskVecEnv(VecEnv):
    """A task as a ``VecEnv`` of Stable-Baselines3, such as for ``PPO("MlpPolicy", TaskVecEnv(envs))``.

    An env is reset within the step that ends its episode, as Stable-Baselines3 expects: the observation is the first of
    the next episode, and the last one is ``infos[env]["terminal_observation"]``, with "TimeLimit.truncated" and the
    entries of the task's info. "is_success" is the task's success.

    Parameters
    ----------
    envs
        A task with ``autoreset_mode="SameStep"``, also as :func:`gymnasium.make_vec` returns it.

    Raises
    ------
    InvalidArgumentError
        ``envs`` is not a task, or has another autoreset mode.
    MissingDependencyError
        Stable-Baselines3 is missing; importing this module raises it.
    """

    def __init__(self, envs: Any) -> None:
        task = getattr(envs, "unwrapped", envs)
        if not isinstance(task, RobotVectorEnv):
            raise InvalidArgumentError("envs", "is not a task", value=envs, remedy="pass e.g. ReachVectorEnv(8)")
        if task.autoreset_mode is not AutoresetMode.SAME_STEP:
            value, remedy = task.autoreset_mode.value, 'make the task with autoreset_mode="SameStep"'
            raise InvalidArgumentError("envs", "resets in another step than this adapter", value=value, remedy=remedy)
        self.envs = task
        self.render_mode = task.render_mode
        super().__init__(task.num_envs, task.single_observation_space, task.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """Begin new episodes in all envs, with the seeds of ``seed(s)``: s + k in env k."""
        seeds = None if self._seeds[0] is None else list(self._seeds)
        observation, info = self.envs.reset(seed=seeds)
        self.reset_infos = [self._of_env(info, env) for env in range(self.num_envs)]
        self._reset_seeds()
        return observation

    def step_async(self, actions: Rows) -> None:
        """Begin a step."""
        self.envs.step_async(actions)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[Document]]:
        """Wait for the step; return observation, reward, ends of episodes, and an info for each env."""
        observation, reward, terminated, truncated, info = self.envs.step_wait()
        ends = terminated | truncated
        infos = []
        for env, end in enumerate(ends):
            own = self._of_env(info["final_info"] if end else info, env)
            own["TimeLimit.truncated"] = bool(truncated[env] and not terminated[env])
            if end:
                own["terminal_observation"] = info["final_obs"][env]
            infos.append(own)
        return observation, reward.astype(np.float32), ends, infos

    def close(self) -> None:
        """Close the task."""
        self.envs.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture of each env, None without a ``render_mode``."""
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the task, once for each env of ``indices``."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of the task. Single envs have no attributes: ``indices`` must be None."""
        if indices is not None:
            raise InvalidArgumentError("indices", "cannot be chosen: all envs are one task", remedy="leave it out")
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the task once, for all envs; return its result for each env of ``indices``."""
        result = getattr(self.envs, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False for each env of ``indices``: single envs have no wrappers."""
        return [False for _ in self._get_indices(indices)]

    def _of_env(self, info: Document, env: int) -> Document:
        """Return the entries of one env in an info of the task."""
        own = {key: rows[env].item() for key, rows in info.items() if key[0] != "_" and not key.startswith("final_")}
        return own | {"is_success": own["success"]}
