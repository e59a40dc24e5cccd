"""One robot of a task as an environment of Gymnasium."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Document, Float32
from batchpid.errors import SingleOwner
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv
from batchpid.sim.robot.robot import Robot


class RobotEnv(SingleOwner, gymnasium.Env):
    """One robot of a task as a :class:`gymnasium.Env`, by default in this process. A subclass names
    its ``task``.

    ``robot`` None is the task's own default. Episodes have no time limit, which
    :func:`gymnasium.make` adds. The other arguments belong to the task.
    """

    instead = RobotVectorEnv.instead
    metadata: ClassVar[Document] = RobotVectorEnv.metadata  # type: ignore[misc]
    task: ClassVar[type[RobotVectorEnv]]
    """Class of the task."""

    def __init__(
        self, robot: str | Robot | None = None, *, render_mode: str | None = None, **options: Any
    ) -> None:
        if robot is not None:
            options["robot"] = robot
        # gymnasium.make adds the time limit and the resets.
        self._envs = self.task(
            num_envs=1,
            max_episode_steps=None,
            autoreset_mode="Disabled",
            render_mode=render_mode,
            **{"workers": 0, **options},
        )
        self.runner = self._envs.runner
        self.render_mode = render_mode
        self.metadata = self._envs.metadata  # type: ignore[misc]
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Document | None = None
    ) -> tuple[Float32, Document]:
        """Begin a new episode."""
        super().reset(seed=seed)
        observation, info = self._envs.reset(seed=seed)
        return observation[0], self._single(info)

    def step(self, action: ArrayLike) -> tuple[Float32, float, bool, bool, Document]:
        """Apply an action (size,) for one step; return observation, reward, terminated, truncated
        and info.
        """
        observation, reward, terminated, truncated, info = self._envs.step(np.asarray(action)[None])
        return (
            observation[0],
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            self._single(info),
        )

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (height, width, 3) in RGB; None without a ``render_mode``."""
        pictures = self._envs.render()
        if pictures is None:
            return None
        return pictures[0]

    def close(self) -> None:
        """Close the runner."""
        self._envs.close()

    @staticmethod
    def _single(info: Document) -> Document:
        """Return the info of the first env."""
        return {key: value[0].item() for key, value in info.items() if not key.startswith("_")}
