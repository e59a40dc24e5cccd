"""Poses of a tool: setpoints of joint control, by inverse kinematics; reachable poses of operational-space control."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.read_only import read_only
from batchpid.checks.validate import array, entries, read_array
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError
from batchpid.sim.command import POSE_UNITS, CommandSpec
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tool_space.osc_controller import OPTIONAL, OperationalSpace, tool_pose
from batchpid.task_space.frames import pose_error
from batchpid.task_space.osc_params import TASK_CHOICES

DAMPING = 1e-4
"""Damping of the inverse Jacobian of a tool's twist."""


class ToolSetpoints:
    """Inverse kinematics for ``Runner(setpoint_space="tool")``: poses of ``link`` become joint positions.

    A search starts at the last joint setpoints of its env, and stays near them: successive poses give continuous joint
    positions. A pose that is not reached gives the nearest one that was found, and one
    :class:`batchpid.task_space.InverseKinematicsWarning` per runner.

    Raises
    ------
    InvalidArgumentError
        The link is unknown, or a joint in the chain to it follows a continuous joint, so that a whole turn of that
        changes the pose of the tool.
    RobotError
        The robot has no kinematic tree: see :meth:`Robot.kinematic_tree`.
    """

    def __init__(self, robot: Robot, link: str) -> None:
        self._tree, self.link = robot.kinematic_tree(), link
        self._check_turns(robot)
        self._others = np.flatnonzero(~self._tree.chain(link))
        names, units = ([of[joint] for joint in self._others] for of in (robot.joint_names, robot.units))
        self.command = CommandSpec((*POSE_UNITS, *names), (*POSE_UNITS.values(), *units))
        """Names and units of a setpoint: the pose, and the positions of joints outside the chain to the link."""
        self._has_warned = False

    def _check_turns(self, robot: Robot) -> None:
        """Raise InvalidArgumentError for followers that have another position after a whole turn of their leader.

        The law takes setpoints of continuous joints modulo whole turns.
        """
        moving = self._tree.chains[self._tree.link_bodies[self._tree.index(self.link)]] > 0
        for index, joint in enumerate(robot.joints):
            if not moving[index] or robot.independent[index]:
                continue
            leader, multiplier = robot.joints[robot.coupling.leader[index]], robot.coupling.multiplier[index]
            if leader.continuous and (multiplier % 1 if joint.unit == "rad" else multiplier):
                problem = f"'tool': the pose of {self.link!r} depends on the turns of {leader.name!r}"
                remedy = "use control 'osc', or setpoint_space 'joints'"
                raise InvalidArgumentError("setpoint_space", problem, joint=joint.name, remedy=remedy)

    def tool_pose(self, qpos: Array) -> NDArray[np.float32]:
        """Return the poses of the link (..., 7) at ``qpos`` (..., dof)."""
        return tool_pose(self._tree, self.link, None, qpos)

    def joints(self, name: str, setpoint: Array, last: Float64, finite: bool, ticks: int | None) -> Float64:
        """Return joint setpoints (envs, dof), or (ticks, envs, dof), for poses after ``last`` (envs, dof).

        Setpoints have 7 entries, or all entries of :attr:`command`; with 7 the other joints keep their setpoint. A
        quaternion is normalised. If invalid numbers are allowed (not ``finite``), they make their env's setpoint NaN.

        Raises
        ------
        InvalidArgumentError
            A shape is wrong, or a number is not finite, or a quaternion has the length 0.
        """
        given = read_array(name, setpoint)
        names = self.command.names[: 7 if given.shape[-1:] == (7,) else None]
        if ticks is not None and given.ndim == 2:
            given = given[:, None]
        lead = (len(last),) if ticks is None else (ticks, len(last))
        rows = array(name, given, (*lead, len(names)), names, finite=finite, kind="entry").astype(np.float64)
        rows = rows.reshape(-1, len(last), len(names))
        length = np.linalg.norm(rows[..., 3:7], axis=-1, keepdims=True)
        if finite:
            for part in length:
                entries(
                    name, part, part > 0, "has a quaternion of length 0", ["qw"], kind="entry", remedy="give w, x, y, z"
                )
        found = np.empty((*rows.shape[:2], last.shape[1]))
        for tick, poses in enumerate(rows):
            good = np.isfinite(poses).all(1) & (length[tick, :, 0] > 0)
            found[tick] = np.nan
            start = last.copy()
            start[:, self._others[: len(names) - 7]] = np.where(good[:, None], poses[:, 7:], 0.0)
            unit = poses[good, :7] / np.where(np.arange(7) < 3, 1.0, length[tick, good])
            if good.any():
                solved = ts.inverse_kinematics(self._tree, self.link, unit, start[good], starts=1, on_failure="return")
                found[tick, good] = solved.qpos
                self._warn(name, np.flatnonzero(good)[~solved.success], solved)
            last = np.where(good[:, None], found[tick], last)
        return read_only(found.reshape(*lead, -1))

    def rates(self, name: str, twist: Array, qpos: Float64, finite: bool) -> Float64:
        """Return the joint rates (..., envs, dof) at setpoints ``qpos`` (..., envs, dof) for twists of the tool.

        A twist has 6 entries, in the world [m/s, rad/s], and may go on with the rates of the joints outside the chain.
        The joint rates are J^T (J J^T + 1e-4)^-1 twist, with the Jacobian J: bounded where the tool cannot move.

        Raises
        ------
        InvalidArgumentError
            A shape is wrong, or a number is not finite unless invalid numbers are allowed (not ``finite``).
        """
        given = read_array(name, twist)
        names = (*OPTIONAL["twist"][0].split(), *self.command.names[7:])[: 6 if given.shape[-1:] == (6,) else None]
        if qpos.ndim == 3 and given.ndim == 2:
            given = given[:, None]
        rows = array(name, given, (*qpos.shape[:-1], len(names)), names, finite=finite, kind="entry")
        j = ts.jacobian(self._tree, qpos, self.link)
        across = j @ j.swapaxes(-1, -2) + DAMPING * np.eye(6)
        found = (j.swapaxes(-1, -2) @ np.linalg.solve(across, rows[..., :6, None]))[..., 0]
        found[..., self._others[: len(names) - 6]] = rows[..., 6:]
        return read_only(found)

    def _warn(self, name: str, failed: Array, found: ts.IKResult) -> None:
        """Warn of the first env whose pose was not reached, once."""
        if not len(failed) or self._has_warned:
            return
        self._has_warned, row = True, int(np.flatnonzero(~found.success)[0])
        problem = (
            f"is a pose that was not reached: {found.position_error[row] * 1e3:.3g} mm and "
            f"{found.rotation_error[row] * 1e3:.3g} mrad are left; the nearest pose is used, without further warning"
        )
        error = InvalidArgumentError(name, problem, env=int(failed[0]), remedy="keep setpoints within reach")
        warn(str(error), ts.InverseKinematicsWarning)


SECONDS, TIMESTEP = 3.0, 1 / 250
"""Time that a tool has, and time step of the model [s]."""
ARRIVED = 2e-3
"""Largest error of a pose that was reached [m, rad]."""
SLACK = 1e-3
"""Distance by which a joint may pass a limit [rad or m]."""


def reaches(robot: Robot, control: OperationalSpace, start: Float64, goal: Float64) -> NDArray[np.bool_]:
    """Return whether the tool gets from rest at ``start`` (envs, dof) to ``goal``, (7,) or (envs, 7): bools (envs,).

    The joints have to stay within their limits, which the law does not know, on the whole way. The model has no
    contact and no friction.
    """
    tree = control.tree
    params = control.params._replace(discretization=TASK_CHOICES["discretization"]["implicit"])
    k, state = ts.discretise(params, TIMESTEP), control.init(robot, len(start))
    tool = ts.Tool(tree, control.link, control.point)
    goal = np.broadcast_to(goal, (len(start), 7)).astype(np.float64)
    qpos, qvel, inside = start.astype(np.float64), np.zeros(start.shape), np.ones(len(start), bool)

    for _ in range(round(SECONDS / TIMESTEP)):
        state, terms = ts.osc(k, state, tool, ts.OSCInputs(goal, qpos, qvel), ("effort",))
        qvel = qvel + TIMESTEP * ts.forward_dynamics(tree, qpos, qvel, terms.effort)
        qpos = qpos + TIMESTEP * qvel
        inside &= ((qpos >= robot.lower - SLACK) & (qpos <= robot.upper + SLACK)).all(1)
    left: Array = np.abs(pose_error(goal, ts.link_poses(tree, qpos, [tool.link], point=tool.point)[:, 0])).max(1)
    reached: NDArray[np.bool_] = inside & (left <= ARRIVED)
    return reached


def default_goal(robot: Robot, control: OperationalSpace, start: Float64, poses: Float64) -> Float64:
    """Return the first pose (7,) of the tool at ``poses`` (n, dof) that it reaches from all ``start`` (envs, dof).

    Raises
    ------
    InvalidArgumentError
        No pose is reached from all starts.
    """
    goals: Float64 = ts.link_poses(control.tree, poses, [control.link], point=control.point)[:, 0]
    for goal in goals:
        reached = reaches(robot, control, start, goal)
        if reached.all():
            return goal
    problem = (
        f"has no default: {len(goals)} poses near the target were tried, and {control.link!r} does not reach the last "
        f"one within the joint limits from {np.count_nonzero(~reached)} of {len(start)} start poses"
    )
    remedy = "give a pose, or start nearer to the robot's target (spread)"
    raise InvalidArgumentError("setpoint", problem, env=int(np.argmin(reached)), remedy=remedy)
