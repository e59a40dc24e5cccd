"""Tasks whose actions move a tool, by operational-space control: their base class, and reaching poses of the tool."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.checks.validate import array, choice, entries, number
from batchpid.errors import InvalidArgumentError
from batchpid.sim.gym.joint_space import JointSpace
from batchpid.sim.gym.reach import ACTIONS
from batchpid.sim.gym.robot_env import RobotEnv
from batchpid.sim.gym.robot_vector_env import RobotVectorEnv
from batchpid.sim.observation import Observation
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tool_space.osc_controller import OperationalSpace
from batchpid.task_space.frames import pose_error, rotation_error
from batchpid.task_space.rotations import about, multiply

STIFFNESS = 400.0
"""Default stiffness of the tool [1/s^2]: with damping ratio 1, a time constant of 50 ms."""
MAX_INCREMENT = (0.02, 0.02, 0.02, 0.1, 0.1, 0.1)
"""Default change of the tool's target by an increment of 1 [m, rad]."""
FAR = 3.0
"""Bound of observed positions, as a distance from the workspace [m]."""


class ToolVectorEnv(RobotVectorEnv, ABC):
    """Task of a tool in a box, the workspace, under control "osc". A task is a subclass.

    An action (envs, 3) in [-1, 1] is the target of the tool: its position in the workspace, or an increment of it. With
    a ``rotation`` it is (envs, 6): the last three turn the target from the tool's orientation in the posture, by a
    rotation vector in the world's axes. Without, the target keeps that orientation. An episode begins with the target
    at the tool.

    With increments a setpoint also has the twist of the target (``twist`` of :class:`batchpid.sim.OperationalSpace`):
    the increment per second, 0 where the target is clipped. The law holds the pose, and not the twist, within a step:
    the tool of a moving target is ahead of it by half a step, where without twist it lags by kd / kp.

    Parameters
    ----------
    num_envs, robot
        As for :class:`RobotVectorEnv`.
    tool
        Link of the tool; default the last link of the robot's longest chain.
    posture
        Joint positions (dof,) at the start [rad or m], to which the null space is drawn. Default: for a panda one with
        the hand down; other robots need one in which the tool is where it works, and no direction is singular.
    workspace
        Distances (3,) [m] from the center of the workspace to its sides, along x, y and z of the world.
    rotation
        Largest component of the rotation vector of a target [rad].
    actions
        ``"setpoint"``: the target in the workspace; or ``"increment"``: a change of it.
    max_increment
        Change of the target by an increment of 1, scalar or (3,), with a rotation (6,) [m, rad].
    osc
        Options of :class:`batchpid.sim.OperationalSpace`, such as ``{"stiffness": 400.0}``, the default.
    options
        Of :class:`RobotVectorEnv`, and of :class:`batchpid.sim.Runner` except ``control`` and ``tool``.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range, or ``posture`` is needed.
    """

    panda_posture: ClassVar[tuple[float, ...]] = (0.0, -0.255, 0.0, -2.437, 0.0, 2.182, 0.786, 0.02, 0.02)
    """Default ``posture`` of a panda: the hand down, at (0.45, 0, 0.4) m."""
    spread: ClassVar[float] = 0.1
    """Largest distance of a joint from the posture at the start of an episode [rad or m]."""
    center_offset: ClassVar[tuple[float, float, float]] = (0.0, 0.0, 0.0)
    """Center of the workspace, from the tool in the posture [m]."""

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "panda",
        *,
        tool: str | None = None,
        posture: ArrayLike | None = None,
        workspace: ArrayLike = 0.15,
        rotation: float = 0.0,
        actions: str = "setpoint",
        max_increment: ArrayLike | None = None,
        osc: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        self.actions = choice("actions", actions, ACTIONS)
        self.rotation = number("rotation", rotation, 0.0, 1.5, "rad")
        size = 6 if self.rotation else 3
        self.action_names = ("x", "y", "z", "rx", "ry", "rz")[:size]
        self._half = array("workspace", workspace, (1, 3), "xyz", kind="entry")[0]
        entries("workspace", self._half, self._half >= 0, "is negative", "xyz", kind="entry")
        increment = MAX_INCREMENT[:size] if max_increment is None else max_increment
        self.max_increment = array("max_increment", increment, (1, size), self.action_names, kind="entry")[0]
        self._tool, self._posture = tool, posture
        self._osc = {"stiffness": STIFFNESS} if osc is None else dict(osc)
        super().__init__(num_envs, robot, **options)

    def runner_options(self) -> Mapping[str, Any]:
        """Return the control of the tool."""
        robot, posture = self.robot, self._posture
        if posture is None:
            if robot.name != "panda":
                remedy = "give joint positions in which the tool is where it works, such as robot.target"
                raise InvalidArgumentError("posture", f"is needed for the robot {robot.name!r}", remedy=remedy)
            posture = self.panda_posture
        self.posture = robot.coupled(array("posture", posture, (1, robot.dof), robot.joint_names)[0])
        tree = robot.rigid_tree
        self.tool = tree.tool if self._tool is None else choice("tool", self._tool, tree.links)
        options = {"twist": self.actions == "increment"} | self._osc
        self._control = OperationalSpace(robot, self.tool, posture=self.posture, **options)
        self._home = np.array(self._control.command.neutral)[:7]
        self.center = self._home[:3] + self.center_offset
        """Center of the workspace (3,) [m]."""
        return {"control": self._control}

    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Return the spaces: joints, pose of the tool, and further entries with :meth:`task_bounds`."""
        self._joints = JointSpace(self.robot)
        position, unit = self._half + FAR, np.ones(4)
        ends = [
            (*self._joints.bounds(),),
            (np.r_[self.center - position, -unit], np.r_[self.center + position, unit]),
            self.task_bounds(),
        ]
        low, high = (np.concatenate(parts).astype(np.float32) for parts in zip(*ends, strict=True))
        return spaces.Box(low, high), spaces.Box(-1.0, 1.0, (len(self.action_names),), np.float32)

    def task_bounds(self) -> tuple[Float64, Float64]:
        """Return the bounds of the task's own entries of the observation. Default: none."""
        return np.zeros(0), np.zeros(0)

    def draw(self, env: int, random: np.random.Generator) -> Float64:
        """Draw a start around the posture; joints outside the chain to the tool start in it."""
        moves = self.robot.kinematic_tree().chain(self.tool) & self.robot.independent
        drawn = self.posture + self.spread * moves * random.uniform(-1.0, 1.0, self.robot.dof)
        return self.robot.coupled(np.clip(drawn, self.robot.lower, self.robot.upper))

    def first_setpoint(self, qpos: Float64) -> Float64:
        """Return the poses of the tool."""
        return self._near_home(self._control.tool_pose(qpos))

    def setpoint_sizes(self) -> tuple[int, int]:
        """Return the numbers of entries of a pose and of a twist."""
        return 7, 6

    def command(self, action: Float64, setpoint: Float64) -> Float64:
        """Return the target for actions in [-1, 1]: poses (envs, 7)."""
        limits = np.concatenate([self._half, np.full(3, self.rotation)])[: action.shape[1]]
        if self.actions == "setpoint":
            return self.pose_at(action * limits)
        turn = rotation_error(setpoint[:, 3:], self._home[3:])
        last = np.concatenate([setpoint[:, :3] - self.center, turn], axis=1)[:, : action.shape[1]]
        asked = last + action * self.max_increment
        place = np.clip(asked, -limits, limits)
        self._is_inside = place == asked
        return self.pose_at(place)

    def rate(self, setpoint: Float64, last: Float64) -> Float64 | None:
        """Return the twists (envs, 6) of increments, 0 along axes whose target is clipped; None for other actions."""
        if self.actions == "setpoint" or self._control.command.size != 13:
            return None
        change, is_inside = np.zeros((len(setpoint), 6)), self._is_inside
        change[:, :3] = (setpoint - last)[:, :3] * is_inside[:, :3]
        if self.rotation:
            turn = rotation_error(setpoint[:, 3:], last[:, 3:])
            change[:, 3:] = turn * is_inside[:, 3:].all(1, keepdims=True)
        return change / self.step_seconds

    def send(self, setpoint: Float64, rate: Float64 | None) -> None:
        """Begin a step of the runner; the twist is a part of the control's setpoint, 0 where there is none."""
        parts = [setpoint]
        if self._control.command.size > setpoint.shape[1]:
            parts.append(self._rate)
        self.runner.send(np.concatenate(parts, axis=1))

    def pose_at(self, place: Float64) -> Float64:
        """Return the poses (..., 7) at places in the workspace (..., 3) or (..., 6).

        A place is a position from the center [m], and a rotation vector from the orientation in the posture [rad].
        """
        turn = place[..., 3:]
        wxyz = np.broadcast_to(self._home[3:], (*place.shape[:-1], 4))
        if turn.shape[-1]:
            angle = np.sqrt((turn * turn).sum(-1))
            axis = turn / np.where(angle > 0, angle, 1.0)[..., None]
            wxyz = multiply(about(axis, angle), wxyz)
        return np.concatenate([self.center + place[..., :3], wxyz], axis=-1)

    def observe(self, observed: Observation) -> Float64:
        """Return the joints' positions and velocities, and the pose of the tool."""
        assert observed.tool_pose is not None
        return np.concatenate([self._joints.observe(observed), self._near_home(observed.tool_pose)], axis=1)

    def _near_home(self, poses: Float32) -> Float64:
        """Return the poses (envs, 7) with the one of two quaternions that is nearer to that in the posture."""
        near = poses.astype(np.float64)
        near[:, 3:] *= np.where((near[:, 3:] * self._home[3:]).sum(1, keepdims=True) < 0, -1.0, 1.0)
        return near


ANGLE_WEIGHT = 0.1
"""Cost of an angle in the reward [1/rad], where a distance costs 1 [1/m]."""


class ToolReachVectorEnv(ToolVectorEnv):
    """N robots, each of which has to reach a pose with its tool. Goals are drawn from poses that actions can command.

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
