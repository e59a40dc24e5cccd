"""Reach: N robots reach random joint poses, with joint setpoints as actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.arrays.elementwise import TURN, wrap
from batchpid.checks.validate import array, choice, entries, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.gym.joint_space import MAX_SPEED, JointSpace
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv
from batchpid.sim.robot.description import LIMIT_TOLERANCE
from batchpid.sim.robot.robot import Robot
from batchpid.sim.signals.command import CommandSpec, own_command
from batchpid.sim.signals.observation import Observation

ACTIONS = ("setpoint", "increment")
SPREAD = 0.1
"""Largest distance of a joint from the robot's start pose at the beginning of an episode [rad or
m].
"""
MARGIN = 0.05
"""Share of a joint's range, at each limit, in which no goal is drawn."""


class ReachVectorEnv(RobotVectorEnv):
    """N robots, each with a joint pose to reach.

    Joints are the independent ones (:attr:`batchpid.sim.Robot.independent`): followers move with
    their leaders. A setpoint has one number for each of them. A :class:`batchpid.sim.Controller`
    may define another command, within the bounds of its :class:`batchpid.sim.CommandSpec`.

    - *Observation* (envs, 3 joints): qpos, qvel, goal [rad or m, and per second], clipped to the
      space.
    - *Action* (envs, size) in [-1, 1]: the setpoint within its limits, or an increment of the
      setpoint, which moves during the step. An episode begins with the setpoint at the joints'
      pose, or with the ``neutral`` one of the command.
    - *Reward*: minus the mean over joints of |goal - qpos| / range, plus 1 where every joint is
      within ``tolerance``. A joint without a range counts as 0.
    - *Terminated*: the env diverged (``info["diverged"]``), or reached its goal if
      ``terminate_on_success``.
    - *Truncated*: after ``max_episode_steps``.
    - *Info*: "success", "error" (largest |goal - qpos|), "diverged".

    A continuous joint has the range [-pi, pi]. Its qpos and goal are observed in that range, its
    error is the short way round, and increments move it past pi if the law can (control "pid" with
    ``continuous`` in its params). Another joint without limits has the range of half a turn, or pi
    m, on either side of its start.

    Parameters
    ----------
    num_envs, robot
        As for :class:`RobotVectorEnv`.
    actions
        ``"setpoint"`` or ``"increment"``.
    max_increment
        Change of the setpoint by an increment of 1, scalar or (size,) [rad or m]; default the
        velocity limit times the time of a step. No default for a controller that defines its
        command.
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
        self.actions = choice("actions", actions, ACTIONS)
        self.tolerance = number("tolerance", tolerance, 0.0, 1e3, "rad or m")
        self._max_increment = max_increment
        self._spec = own_command(options.get("control"))
        super().__init__(num_envs, robot, **options)
        if self.runner.control == "pid":
            law = self.runner.params.continuous
        else:
            law = None
        if law is None:
            turns = np.zeros(self.robot.dof)
        else:
            turns = np.asarray(law, np.float64).min(0) / TURN
        joint_turns = np.minimum(self._joints.turns, turns[self._joints.index])
        if self._spec is None:
            self._setpoint_turns = joint_turns
        else:
            self._setpoint_turns = np.zeros(len(self.action_names))
        self._goal = np.zeros((self.num_envs, len(self.joint_names)))

    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Return the spaces for the joint limits, or the bounds of the command."""
        self._joints = joints = JointSpace(self.robot)
        self.joint_names = joints.names
        self.low = joints.low
        self.high = joints.high
        span = self.high - self.low
        self._span = np.where(span > LIMIT_TOLERANCE, span, np.inf)
        self._margin = np.where(joints.continuous, 0.0, MARGIN * span)
        spec = self._spec
        self.action_names = self.joint_names
        self._setpoint_low = self.low
        self._setpoint_high = self.high
        if spec is not None:
            self.action_names = spec.names
            self._setpoint_low, self._setpoint_high = _finite_bounds(spec)
        max_increment = self._max_increment
        if max_increment is None:
            if spec is not None and self.actions == "increment":
                remedy = f"give one number for each of {', '.join(spec.names)}"
                raise InvalidArgumentError(
                    "max_increment", "is needed for the command of this control", remedy=remedy
                )
            fastest = self.robot.velocity_limit[joints.index]
            if spec is not None:
                max_increment = 0.0
            else:
                max_increment = np.minimum(fastest, MAX_SPEED) * self.step_seconds
        names = self.action_names
        kind: Any = "joint" if spec is None else "entry"
        self.max_increment = array(
            "max_increment", max_increment, (1, len(names)), names, kind=kind
        )[0]
        low, high = joints.bounds()
        observation = spaces.Box(
            np.concatenate([low, self.low]).astype(np.float32),
            np.concatenate([high, self.high]).astype(np.float32),
        )
        return observation, spaces.Box(-1.0, 1.0, (len(names),), np.float32)

    def draw(self, env: int, random: np.random.Generator) -> Float64:
        """Draw a start near the robot's start pose, and a goal within the joint limits."""
        joints = self._joints
        drawn = joints.start + random.uniform(-SPREAD, SPREAD, len(joints.names))
        self._goal[env] = random.uniform(self.low + self._margin, self.high - self._margin)
        return joints.of_robot(np.clip(wrap(drawn, joints.turns, np), self.low, self.high))

    def command(self, action: Float64, setpoint: Float64) -> Float64:
        """Return the setpoints for actions in [-1, 1]."""
        low, high = self._setpoint_low, self._setpoint_high
        if self.actions == "setpoint":
            chosen = low + (action + 1) / 2 * (high - low)
        else:
            if self._spec is not None:
                last = setpoint
            else:
                last = setpoint[:, self._joints.index]
            chosen = np.clip(
                wrap(last + action * self.max_increment, self._setpoint_turns, np), low, high
            )
        if self._spec is None:
            return self._joints.of_robot(chosen)
        return chosen

    def rate(self, setpoint: Float64, last: Float64) -> Float64 | None:
        """Return the rates of increments, the short way round on continuous joints; None for other
        actions.
        """
        if self.actions == "setpoint" or self._spec is not None:
            return None
        rate, index = (
            np.zeros_like(setpoint),
            self._joints.index,
        )  # the runner gives followers their leaders' rates
        rate[:, index] = (
            wrap((setpoint - last)[:, index], self._setpoint_turns, np) / self.step_seconds
        )
        return rate

    def observe(self, observed: Observation) -> Float32:
        """Return qpos, qvel, pose and twist of a floating base, and goal."""
        return np.concatenate([self._joints.observe(observed), self._goal], axis=1).astype(
            np.float32
        )

    def success(self, observation: Float32) -> Bool:
        """Return whether every joint is within the tolerance."""
        success: Bool = np.all(self._error(observation) <= self.tolerance, axis=1)
        return success

    def reward(self, observation: Float32, success: Bool) -> Float64:
        """Return minus the mean error as a share of the ranges, plus 1 at the goal."""
        reward: Float64 = 1.0 * success - (self._error(observation) / self._span).mean(1)
        return reward

    def info(self, observation: Float32) -> Mapping[str, Rows]:
        """Return the largest error."""
        return {"error": self._error(observation).max(1)}

    def _error(self, observation: Float32) -> Float64:
        """Return |goal - qpos| (envs, joints) [rad or m], the short way round."""
        return np.abs(
            wrap(self._goal - observation[:, : len(self.joint_names)], self._joints.turns, np)
        )


class ReachEnv(RobotEnv):
    """One robot of :class:`ReachVectorEnv`."""

    task = ReachVectorEnv


def _finite_bounds(command: CommandSpec) -> tuple[Float64, Float64]:
    """Return the bounds of a command; raise InvalidArgumentError if one is infinite."""
    low = np.asarray(command.lower)
    high = np.asarray(command.upper)
    good = np.isfinite(low) & np.isfinite(high)
    remedy = "let its command be a batchpid.sim.CommandSpec with lower= and upper="
    entries("control", low, good, "has no bounds", command.names, kind="entry", remedy=remedy)
    return low, high
