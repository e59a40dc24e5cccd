"""Walk: N quadrupeds on the ground follow a commanded velocity, with joint setpoints around a trot as actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.checks.validate import array, entries
from batchpid.errors import InvalidArgumentError
from batchpid.sim.gym.joint_space import MAX_SPEED
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv
from batchpid.sim.observation import Observation
from batchpid.sim.robot.robot import Robot
from batchpid.task_space.rotations import inverse, rotate

TROT = [
    [0, 0, 0, 0, 0.2, 0, 0, 0.2, -0.4, 0, 0, -0.4],
    [0, 0, 0, 0, 0, 0.2, 0.2, 0, 0, -0.4, -0.4, 0],
    [0, 0, 0, 0, 0.385, -0.385, -0.385, 0.385, 0, 0, 0, 0],
]
"""Gait of the bundled quadruped [rad]: feet rise by 6 cm, and sweep a quarter of 0.4 m/s over its legs of 0.26 m."""


class WalkVectorEnv(RobotVectorEnv):
    """N quadrupeds, each with a velocity to follow: forward, to the left, and about the vertical axis.

    The joint setpoint is the sum of the posture, a gait that depends on a clock, and :attr:`scale` times the action, in
    [-1, 1] (A. Iscen et al., "Policies modulating trajectory generators", CoRL 2018). The gait is a trot that lifts two
    legs at a time, and swings all hips in proportion to the command. An episode begins at a random phase.

    - *Observation*: velocity [m/s] and angular velocity [rad/s] of the trunk and the vertical, (3) each, in the axes of
      the trunk; command (3); joint positions relative to the posture, joint velocities and last action, (dof) each;
      sine and cosine of the clock.
    - *Reward*: exp(-error^2 / 0.1) for the horizontal velocity and 0.5 exp(-error^2 / 0.25) for the turn, minus v_z^2,
      0.02 (roll rate^2 + pitch rate^2), 2 sin^2 of the tilt, 1e-4 effort^2, and 0.01 (change of the action)^2.
    - *Terminated*: the robot fell: its trunk is lower than :attr:`lowest`, or tilted by 60 degrees; or it diverged.
    - *Info*: "speed" (forward [m/s]), "distance" (from the start along x [m]), "diverged".

    Parameters
    ----------
    num_envs, robot
        As for :class:`RobotVectorEnv`, with ``fixed_base=False``.
    commands
        Smallest and largest command (2, 3): forward, left [m/s], turn [rad/s]. Each episode draws one.
    posture
        Joint positions (dof,) of the standing robot [rad]; default ``robot.start``.
    gait
        Offsets (3, dof) [rad]: lift of the first and of the second pair of legs in the middle of their swing, and the
        stride at 1 m/s at the start of a period. Default: a trot for the bundled quadruped, 0 for other robots.
    options
        Options of :class:`RobotVectorEnv` and the Runner. Defaults here: ``params`` of a bundled robot's settings, and
        ``compensate="none"``.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range, or the base of the robot is fixed.
    """

    period: ClassVar[float] = 0.4
    """Time in which every leg makes a step [s]."""
    scale: ClassVar[float] = 0.3
    """Offset of a setpoint from the gait at an action of 1 [rad]."""
    lowest: ClassVar[float] = 0.15
    """Height of the trunk below which the robot has fallen [m]."""

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "quadruped",
        *,
        commands: ArrayLike = ((0.0, 0.0, -0.5), (1.0, 0.0, 0.5)),
        posture: ArrayLike | None = None,
        gait: ArrayLike | None = None,
        **options: Any,
    ) -> None:
        robot = robot if isinstance(robot, Robot) else Robot.load(robot, fixed_base=False)
        if robot.fixed_base:
            raise InvalidArgumentError("robot", "has a fixed base", remedy="load it with fixed_base=False")
        axes, names = ("forward", "left", "turn"), robot.joint_names
        low, high = self.commands = array("commands", commands, (2, 3), axes, kind="entry")
        entries("commands", high, high >= low, "is below the first row", axes, kind="entry")
        trot = TROT if robot.name == "quadruped" else np.zeros((3, robot.dof))
        self.posture = array("posture", robot.start if posture is None else posture, (1, robot.dof), names)[0]
        self.gait = array("gait", trot if gait is None else gait, (3, robot.dof), names)
        own = {} if robot.settings is None else {"params": robot.params()}
        super().__init__(num_envs, robot, **{"compensate": "none", **own, **options})
        self._clock, self._command = np.zeros(self.num_envs), np.zeros((self.num_envs, 3))

    def runner_options(self) -> Mapping[str, Any]:
        """Return the control mode and the ground."""
        return {"control": "pid", "ground": True}

    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Return the spaces of observation and action."""
        self.action_names, dof = self.robot.joint_names, self.robot.dof
        high = np.repeat([MAX_SPEED, 1.0, MAX_SPEED, 1.0], [6, 3, 3 + 2 * dof, dof + 2]).astype(np.float32)
        return spaces.Box(-high, high), spaces.Box(-1.0, 1.0, (dof,), np.float32)

    def draw(self, env: int, random: np.random.Generator) -> Float64:
        """Draw a command, a phase of the clock, and a start within 0.1 rad of the posture."""
        self._command[env] = random.uniform(*self.commands)
        self._clock[env] = random.uniform()
        self.action[env] = 0.0
        return np.clip(self.posture + random.uniform(-0.1, 0.1, self.robot.dof), self.robot.lower, self.robot.upper)

    def command(self, action: Float64, setpoint: Float64) -> Float64:
        """Return the setpoints of the gait, with the actions added."""
        self._change = action - self.action
        self._clock = (self._clock + self.step_seconds / self.period) % 1.0
        angle = 2 * np.pi * self._clock[:, None]
        first, second, stride = self.gait
        gait = np.maximum(np.sin(angle), 0.0) * first + np.maximum(-np.sin(angle), 0.0) * second
        gait += np.cos(angle) * self._command[:, :1] * stride
        return np.clip(self.posture + gait + self.scale * action, self.robot.lower, self.robot.upper)

    def observe(self, observed: Observation) -> Float64:
        """Return the motion of the trunk, the command, the joints and the clock."""
        pose, twist = (np.asarray(each, np.float64) for each in (observed.base_pose, observed.base_twist))
        turn = inverse(pose[:, 3:])  # from the world's axes to the trunk's
        trunk = [rotate(turn, each) for each in (twist[:, :3], twist[:, 3:], np.array([0.0, 0.0, 1.0]))]
        angle = 2 * np.pi * self._clock[:, None]
        joints = [observed.qpos - self.posture, observed.qvel, self.action]
        return np.concatenate([*trunk, self._command, *joints, np.sin(angle), np.cos(angle)], axis=1)

    def reward(self, observation: Float32, success: Bool) -> Float64:
        """Return the rewards of the velocity and of the turn, minus the costs."""
        velocity, rate, upright, command = np.split(observation[:, :12].astype(np.float64), 4, axis=1)
        off, turn = ((command[:, :2] - velocity[:, :2]) ** 2).sum(1), (command[:, 2] - rate[:, 2]) ** 2
        costs = velocity[:, 2] ** 2 + 0.02 * (rate[:, :2] ** 2).sum(1) + 2.0 * (upright[:, :2] ** 2).sum(1)
        costs += 1e-4 * (self.observed.effort.astype(np.float64) ** 2).sum(1) + 0.01 * (self._change**2).sum(1)
        return np.exp(-off / 0.1) + 0.5 * np.exp(-turn / 0.25) - costs

    def terminated(self, observation: Float32, success: Bool) -> Bool:
        """Return whether the robot fell."""
        fell = (np.asarray(self.observed.base_pose)[:, 2] < self.lowest) | (observation[:, 8] < 0.5)
        return fell | np.asarray(super().terminated(observation, success))

    def info(self, observation: Float32) -> Mapping[str, Rows]:
        """Return the forward speed [m/s] and the distance along x [m]."""
        return {"speed": observation[:, 0], "distance": np.asarray(self.observed.base_pose)[:, 0]}


class WalkEnv(RobotEnv):
    """One robot of :class:`WalkVectorEnv`."""

    task = WalkVectorEnv
