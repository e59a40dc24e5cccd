"""Reach: N robots reach random joint poses, with joint setpoints as actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.arrays.elementwise import TURN, wrap
from batchpid.checks import array, choice, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.findings import LIMIT_TOLERANCE
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals import Observation

EPISODE_SPREAD = 0.1
"""Largest distance of a joint from the robot's start pose at the beginning of an episode [rad or
m].
"""
MARGIN = 0.05
"""Share of a joint's range, at each limit, in which no goal is drawn."""
MAX_SPEED = 100.0
"""Joint speed that PhysX allows, and bound of the observed one [rad/s or m/s]."""
BASE_BOUND = 1000.0
"""Bound of the observed position of a floating base [m]."""


class ReachVectorEnv(RobotVectorEnv):
    """N robots, each with a joint pose to reach.

    Joints are the independent ones (:attr:`batchpid.sim.Robot.independent`): followers move with
    their leaders. A setpoint has one number for each of them.

    - *Observation* (envs, 3 joints): qpos, qvel, goal [rad or m, and per second], clipped to the
      space. On a floating base its pose and twist (13) stand before the goal. With ``chunk`` the
      setpoint of the last executed row (joints) stands behind it: the robot gets there late, and
      the next chunk counts from there.
    - *Action* (envs, joints) in [-1, 1]: the setpoint within its limits, or an increment of the
      setpoint, which moves during the step; with ``chunk`` (envs, rows, joints). An episode begins
      with the setpoint at the joints' pose.
    - *Reward*: minus the mean over joints of |goal - qpos| / range, plus 1 where every joint is
      within ``tolerance``. A joint without a range counts as 0.
    - *Terminated*: the env diverged (``info["diverged"]``), or reached its goal if
      ``terminate_on_success``.
    - *Truncated*: after ``max_episode_steps``.
    - *Info*: "success", "error" (largest |goal - qpos|), "diverged".

    A continuous joint has the range [-pi, pi]. Its qpos and goal are observed in that range, its
    error is the short way round. Another joint without limits has the range of half a turn, or pi
    m, on either side of its start.

    Parameters
    ----------
    num_envs, robot
        As for :class:`RobotVectorEnv`.
    actions
        ``"setpoint"`` or ``"increment"``.
    max_increment
        Change of the setpoint by an increment of 1, scalar or (joints,) [rad or m]; default the
        velocity limit times the time of a step, or of a row of a chunk.
    tolerance
        Largest error of a reached goal [rad or m].
    options
        Of :class:`RobotVectorEnv`: rate_hz, terminate_on_success, ..., and of
        :class:`batchpid.sim.Runner`.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range.
    """

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "panda",
        *,
        actions: str = "setpoint",
        max_increment: ArrayLike | None = None,
        tolerance: float = 0.02,
        **options: Any,
    ) -> None:
        self.actions = choice("actions", actions, ("setpoint", "increment"))
        self.tolerance = number("tolerance", tolerance, 0.0, 1e3, "rad or m")
        self._max_increment = max_increment
        super().__init__(num_envs, robot, **options)
        self._action_names = self.joint_names
        if self.runner.options.own_command is not None:
            self.close()
            problem = "takes no joint setpoints"
            raise InvalidArgumentError("control", problem, remedy="subclass RobotVectorEnv")
        self._goal = np.zeros((self.num_envs, len(self.joint_names)))
        self._error = np.zeros_like(self._goal)  # of the last observation: success comes first

    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Return the spaces for the joint limits."""
        robot = self.robot
        self._index = index = np.flatnonzero(robot.independent)
        self.joint_names = tuple(robot.joint_names[joint] for joint in index)
        continuous = robot.continuous[index]
        # Turns per rad, for wrap: 1 / (2 pi) for continuous joints, else 0.
        self._turns = continuous / TURN if continuous.any() else None
        self._start = wrap(robot.start[index], self._turns, np)
        # Every joint has a finite range: a space needs bounds.
        middle = np.where(continuous, 0.0, self._start)
        lower = robot.lower[index]
        upper = robot.upper[index]
        self.low = np.where(np.isfinite(lower), lower, middle - np.pi)
        self.high = np.where(np.isfinite(upper), upper, middle + np.pi)
        span = self.high - self.low
        self._span = np.where(span > LIMIT_TOLERANCE, span, np.inf)
        self._margin = np.where(continuous, 0.0, MARGIN * span)
        max_increment = self._max_increment
        if max_increment is None:
            fastest = np.minimum(robot.velocity_limit[index], MAX_SPEED)
            max_increment = fastest * self.step_seconds
        names = self.joint_names
        self.max_increment = array("max_increment", max_increment, (1, len(names)), names)[0]
        # Observed positions may be pi beyond a limit: physics is no clip.
        beyond = np.where(continuous, 0.0, np.pi)
        speed = np.full(len(names), MAX_SPEED)
        base = np.zeros(0)
        if not robot.fixed_base:
            base = np.repeat([BASE_BOUND, 1.0, MAX_SPEED], [3, 4, 6])
        goals = 1 if self._rows is None else 2  # goal and setpoint
        low = np.concatenate([self.low - beyond, -speed, -base, *[self.low] * goals])
        high = np.concatenate([self.high + beyond, speed, base, *[self.high] * goals])
        observation = spaces.Box(low.astype(np.float32), high.astype(np.float32))
        return observation, spaces.Box(-1.0, 1.0, (len(names),), np.float32)

    def draw(self, env: int, random: np.random.Generator) -> Float64:
        """Draw a start near the robot's start pose, and a goal within the joint limits."""
        start = self._start + random.uniform(-EPISODE_SPREAD, EPISODE_SPREAD, len(self._start))
        self._goal[env] = random.uniform(self.low + self._margin, self.high - self._margin)
        return self._of_robot(np.clip(wrap(start, self._turns, np), self.low, self.high))

    def command(self, action: Float64, setpoint: Float64) -> Float64:
        """Return the setpoints for actions in [-1, 1]."""
        if self.actions == "setpoint":
            return self._of_robot(self.low + (action + 1) / 2 * (self.high - self.low))
        moved = setpoint[:, self._index] + action * self.max_increment
        return self._of_robot(np.clip(moved, self.low, self.high))

    def rate(self, setpoint: Float64, last: Float64) -> Float64 | None:
        """Return the rates of increments; None for other actions."""
        if self.actions == "setpoint":
            return None
        return (setpoint - last) / self.step_seconds

    def observe(self, observed: Observation) -> Float32:
        """Return qpos, qvel, pose and twist of a floating base, goal, and with chunks the setpoint."""
        qpos = observed.qpos[:, self._index].astype(np.float64)
        rows = [wrap(qpos, self._turns, np), observed.qvel[:, self._index]]
        if observed.base_pose is not None:
            rows += [observed.base_pose, observed.base_twist]
        rows.append(self._goal)
        if self._rows is not None:
            rows.append(wrap(self.setpoint[:, self._index], self._turns, np))
        return np.concatenate(rows, axis=1, dtype=np.float32)

    def success(self, observation: Float32) -> Bool:
        """Return whether every joint is within the tolerance."""
        self._error = self._distance(observation)
        success: Bool = np.all(self._error <= self.tolerance, axis=1)
        return success

    def reward(self, observation: Float32, success: Bool) -> Float64:
        """Return minus the mean error as a share of the ranges, plus 1 at the goal."""
        reward: Float64 = 1.0 * success - (self._error / self._span).mean(1)
        return reward

    def info(self, observation: Float32) -> Mapping[str, Rows]:
        """Return the largest error."""
        return {"error": self._error.max(1)}

    def _distance(self, observation: Float32) -> Float64:
        """Return |goal - qpos| (envs, joints) [rad or m], the short way round."""
        error = self._goal - observation[:, : len(self.joint_names)]
        return np.abs(wrap(error, self._turns, np))

    def _of_robot(self, values: Float64) -> Float64:
        """Return values (..., joints) for all joints of the robot (..., dof)."""
        # The runner gives followers the values of their leaders.
        rows = np.zeros((*values.shape[:-1], self.robot.dof))
        rows[..., self._index] = values
        return rows


class ReachEnv(RobotEnv):
    """One robot of :class:`ReachVectorEnv`."""

    task = ReachVectorEnv
