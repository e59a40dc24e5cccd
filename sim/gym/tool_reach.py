"""Tool reach: N robots reach random poses of a tool, with targets of the tool as actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.checks.validate import number
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.robot_vector_env import Bool, Float32, Float64
from batchpid.sim.gym.tool_vector_env import ToolVectorEnv
from batchpid.sim.observation import Observation
from batchpid.sim.robot.robot import Robot
from batchpid.task_space.frames import pose_error

ANGLE_WEIGHT = 0.1
"""Cost of an angle in the reward [1/rad], where a distance costs 1 [1/m]."""


class ToolReachVectorEnv(ToolVectorEnv):
    """N robots, each with a pose of its tool to reach. Goals are drawn from the poses that an action can be.

    - *Observation*: qpos, qvel (joints), pose of the tool (7), goal (7): position [m] and quaternion (w, x, y, z).
    - *Action*: see :class:`batchpid.sim.gym.tool_vector_env.ToolVectorEnv`.
    - *Reward*: minus the distance to the goal [m], minus 0.1 times the angle [rad], plus 1 at the goal.
    - *Success*: the distance is at most ``tolerance``, and the angle at most ``angle_tolerance``.
    - *Info*: "success", "distance" [m], "angle" [rad], "diverged".

    Parameters
    ----------
    num_envs, robot
        As for :class:`batchpid.sim.gym.RobotVectorEnv`.
    tolerance
        Largest distance of a reached goal [m].
    angle_tolerance
        Largest angle of a reached goal [rad].
    options
        Of :class:`batchpid.sim.gym.tool_vector_env.ToolVectorEnv`, :class:`batchpid.sim.gym.RobotVectorEnv` and the
        Runner.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range, or ``posture`` is needed.
    """

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "panda",
        *,
        tolerance: float = 0.01,
        angle_tolerance: float = 0.1,
        **options: Any,
    ) -> None:
        self.tolerance = number("tolerance", tolerance, 0.0, 1e3, "m")
        self.angle_tolerance = number("angle_tolerance", angle_tolerance, 0.0, np.pi, "rad")
        super().__init__(num_envs, robot, **options)
        self._goal = np.zeros((self.num_envs, 7))

    def task_bounds(self) -> tuple[Float64, Float64]:
        """Return the bounds of a goal."""
        unit = np.ones(4)
        return np.r_[self.center - self._half, -unit], np.r_[self.center + self._half, unit]

    def draw(self, env: int, random: np.random.Generator) -> Float64:
        """Draw a start around the posture, and a goal in the workspace."""
        start = super().draw(env, random)
        limits = np.concatenate([self._half, np.full(3, self.rotation)])[: len(self.action_names)]
        self._goal[env] = self.pose_at(random.uniform(-limits, limits))
        return start

    def observe(self, observed: Observation) -> Float64:
        """Return joints, pose of the tool, and goal."""
        return np.concatenate([super().observe(observed), self._goal], axis=1)

    def success(self, observation: Float32) -> Bool:
        """Return whether the tool is at the goal."""
        distance, angle = self._errors(observation)
        success: Bool = (distance <= self.tolerance) & (angle <= self.angle_tolerance)
        return success

    def reward(self, observation: Float32, success: Bool) -> Float64:
        """Return minus the weighed distance and angle, plus 1 at the goal."""
        distance, angle = self._errors(observation)
        return 1.0 * success - distance - ANGLE_WEIGHT * angle

    def info(self, observation: Float32) -> Mapping[str, Rows]:
        """Return distance [m] and angle [rad]."""
        return dict(zip(("distance", "angle"), self._errors(observation), strict=True))

    def _errors(self, observation: Float32) -> tuple[Float64, Float64]:
        """Return the distance [m] and the angle [rad] of each tool to its goal (envs,)."""
        error = pose_error(self._goal, observation[:, -14:-7].astype(np.float64))
        return np.sqrt((error[:, :3] ** 2).sum(1)), np.sqrt((error[:, 3:] ** 2).sum(1))


class ToolReachEnv(RobotEnv):
    """One robot of :class:`ToolReachVectorEnv`."""

    task = ToolReachVectorEnv
