"""Operational-space control of one link, as the control of a Runner."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Document
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.records import summary
from batchpid.arrays.trees import digest
from batchpid.checks import array, choice, flag, instance, names
from batchpid.errors import InvalidArgumentError
from batchpid.motors.friction import LOOKAHEAD, compensation
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_options import FRICTION_BAND, known_joints
from batchpid.sim.signals import POSE_UNITS, TWIST_UNITS, WRENCH_UNITS, CommandSpec
from batchpid.task_space.frames import moved, pose_error
from batchpid.task_space.native_rows import BoundOSC
from batchpid.task_space.symmetric import gram, solve

ACCELERATION_UNITS = {
    **dict.fromkeys(("ax", "ay", "az"), "m/s^2"),
    **dict.fromkeys(("alphax", "alphay", "alphaz"), "rad/s^2"),
}
"""Names and units of the numbers in an acceleration: linear and angular."""


class OperationalSpace:
    """Controller for ``Runner(control=...)``: the law of
    :mod:`batchpid.task_space.operational_space`.

    A setpoint is a pose of the tool in the world (7,): position [m] and quaternion (w, x, y, z).
    The quaternion is normalised: its length and sign have no effect; one of length 0 has no
    direction, and fails its env. Further entries are the tool's twist, acceleration and wrench
    (6,), where these are True, and the positions of ``joints``.

    The bias is the runner's passive force, as ``compensate`` selects, plus the efforts of the
    joints' known damping and friction. Friction is compensated for the motion to the setpoint. Its
    direction is dq = J^T (J J^T + 1e-4)^-1 e, with the error e of the pose. Jacobian and mass
    matrix are computed from the kinematic tree. The state is the posture of each env, which a reset
    restores, and the integral. An env that has failed holds the pose of the posture. A runner sets
    time step and ``compensate``; elsewhere they are 1/2000 s and "none".

    Parameters
    ----------
    robot
        Robot of the runner.
    link
        Link that carries the tool.
    point
        Tool in the link's frame (3,) [m]; default its origin.
    twist, acceleration
        Whether setpoints give the velocity of the tool (m/s and rad/s), and its acceleration, in
        the world: a tool that moves follows its setpoint without the delay kd/kp, and on a circle
        without the error r w^2/kp. Pose, twist and acceleration are those at the end of the tick;
        before that the pose moves with the twist. Without twist the pose is constant in the tick.
    wrench
        Whether setpoints give the wrench of the tool on its surroundings (N and N m).
    joints
        Joints outside the chain to the link, such as fingers, whose positions are part of the
        setpoint; others hold their posture.
    posture
        Joint positions (dof,) that the null space is drawn to; default ``robot.start``.
    options
        Options of :func:`batchpid.task_space.make_osc_params`, one row for all envs;
        ``effort_limit`` is by default the robot's.

    Raises
    ------
    InvalidArgumentError
        A link, joint or option is unknown, or has a wrong shape or value.
    RobotError
        The robot has no kinematic tree: see :meth:`Robot.kinematic_tree`.
    """

    def __init__(
        self,
        robot: Robot,
        link: str,
        *,
        point: ArrayLike | None = None,
        twist: bool = False,
        acceleration: bool = False,
        wrench: bool = False,
        joints: Sequence[str] = (),
        posture: ArrayLike | None = None,
        **options: Any,
    ) -> None:
        robot = instance("robot", robot, Robot, "pass Robot.load(...)")
        self.tree = tree = robot.kinematic_tree()
        """Model of the robot."""
        self.link = link
        """Link that carries the tool."""
        self.point = None
        """Tool in the link's frame (3,) [m]; None for its origin."""
        if point is not None:
            self.point = array("point", point, (1, 3), "xyz", kind="entry")[0]
        posture = robot.start if posture is None else posture
        self._posture = robot.coupling.positions(
            array("posture", posture, (1, tree.dof), tree.joint_names)
        )
        for name, rows in options.items():
            if np.ndim(rows) > 1 and len(rows) > 1:
                problem = f"has rows for {len(rows)} envs"
                remedy = "give one row for all envs"
                raise InvalidArgumentError(name, problem, remedy=remedy)
        self._options: Document = {"effort_limit": robot.effort_limit} | options
        self.implicit = self._options.get("discretization") == "implicit"
        """Whether the gains are implicit."""
        self._timestep = 1 / 2000
        self._k = ts.make_osc_params(tree, self._timestep, **self._options)
        # Coulomb friction, and the band of errors in which it is reduced.
        self._friction: tuple[Array, Array] | None = None
        # Damping and friction that the robot is known to have: the law acts against them.
        modelled = robot.source.dissipation == "urdf"
        motors = known_joints(robot)
        damping = motors["viscous"] + robot.damping * modelled
        self._damping = damping[None] if damping.any() else None
        coulomb = motors["coulomb"] + robot.friction
        band = np.array([FRICTION_BAND[unit] for unit in robot.units])
        self._known_friction = (coulomb[None], band[None]) if coulomb.any() else None
        # A setpoint has the pose (7), then the optional twist, acceleration and wrench (6 each),
        # then single joints.
        entries = dict(POSE_UNITS)
        self._parts: dict[str, slice] = {}
        for name, is_part, units in (
            ("twist", twist, TWIST_UNITS),
            ("acceleration", acceleration, ACCELERATION_UNITS),
            ("wrench", wrench, WRENCH_UNITS),
        ):
            if flag(name, is_part):
                self._parts[name] = slice(len(entries), len(entries) + 6)
                entries |= units
        pose = ts.link_poses(tree, self._posture, [link], point=self.point)[0, 0]
        neutral = [*pose, *[0.0] * (len(entries) - len(POSE_UNITS))]
        self._columns = np.zeros(tree.dof, np.intp)  # of the setpoint, for each joint; 0 for none
        controlled = tree.chain(link) | ~tree.coupling.independent
        for name in names("joints", list(joints)):
            joint = tree.joint_names.index(choice("joints", name, tree.joint_names))
            if controlled[joint]:
                problem = f"the pose of {link!r}, or the joint's leader, controls it"
                remedy = "name leaders outside the chain, such as fingers"
                raise InvalidArgumentError("joints", problem, joint=name, remedy=remedy)
            self._columns[joint] = len(entries)
            entries[name] = robot.units[joint]
            neutral.append(self._posture[0, joint])
        self.command = CommandSpec(tuple(entries), tuple(entries.values()), neutral=neutral)
        """Names and units of a setpoint; the neutral one is the pose of the posture."""
        self.version = digest(
            self.link,
            self.point,
            self._posture,
            self._k,
            self.tree,
            self.command.names,
        )
        """Digest of all that the law depends on, besides the robot and the time step."""

    def __repr__(self) -> str:
        return summary(
            type(self).__name__, [self.link, "setpoints " + " ".join(self.command.names)]
        )

    def init(self, robot: Robot, num_envs: int, timestep: float) -> ts.OSCState:
        """Return the state of ``num_envs`` envs; :meth:`in_runner` takes the time step.

        Raises
        ------
        InvalidArgumentError
            The robot has other joints than the one of this controller.
        """
        if robot.joint_names != self.tree.joint_names:
            problem = f"was made for the joints {', '.join(self.tree.joint_names)}"
            remedy = "make it for the robot of the runner"
            raise InvalidArgumentError("control", problem, remedy=remedy)
        return ts.init(self._k, np.repeat(self._posture, num_envs, axis=0))

    def __call__(
        self,
        state: ts.OSCState,
        setpoint: Array,
        qpos: Array,
        qvel: Array,
        passive: Array,
    ) -> tuple[Array, Array]:
        """Return the state and the efforts (envs, dof) [N m or N].

        ``setpoint`` is taken as it is: within a tick the pose moves only where this method is not
        overridden.
        """
        return self.advance(state, setpoint, qpos, qvel, passive)[:2]

    def advance(
        self,
        state: ts.OSCState,
        setpoint: Array,
        qpos: Array,
        qvel: Array,
        passive: Array,
        left: Array = 0.0,
    ) -> tuple[Array, Array, Array]:
        """Return state and efforts ``left`` [s] before the end of the tick, and the joints (envs,
        dof) whose effort the limits have changed.
        """
        xp = namespace(setpoint, qpos)
        setpoint = self._carried(setpoint, left)
        posture = state.posture
        if self._columns.any():
            posture = xp.where(self._columns > 0, setpoint[:, self._columns], posture)
        dynamics = ts.task_dynamics(
            self.tree,
            qpos,
            qvel,
            self.link,
            point=self.point,
            bias=passive,
        )
        parts = {name: setpoint[:, part] for name, part in self._parts.items()}
        feedforward = None
        if self._damping is not None:
            # Damping acts within the step: as mass that is added to the joints.
            feedforward = self._damping * qvel
            added = self._timestep * (self._damping[:, None] * xp.eye(qpos.shape[1]))
            mass_matrix = dynamics.mass_matrix + added.astype(qpos.dtype)
            dynamics = dynamics._replace(mass_matrix=mass_matrix)
        if self._friction is not None:
            friction = self._friction_to(
                setpoint,
                parts.get("twist"),
                posture,
                qpos,
                dynamics,
                *self._friction,
            )
            feedforward = friction if feedforward is None else feedforward + friction
        inputs = ts.OSCInputs(setpoint[:, :7], qpos, qvel, **parts, feedforward=feedforward)
        # The state holds the posture of the episode, without the setpoints of single joints.
        new, terms = ts.osc(
            self._k,
            state._replace(posture=posture),
            dynamics,
            inputs,
        )
        saturated = terms.effort != terms.unsaturated
        return new._replace(posture=state.posture), terms.effort, saturated

    def _carried(self, setpoint: Array, left: Array) -> Array:
        """Return the setpoints of the moment ``left`` [s] before the end of the tick: the pose
        moves with its twist, as joints do in :class:`batchpid.stages.setpoint.Setpoint`.
        """
        if "twist" not in self._parts:
            return setpoint
        twist = setpoint[:, 7:13]
        change: Array = 0.0
        if "acceleration" in self._parts:
            change = left * setpoint[:, self._parts["acceleration"]]
        pose = moved(setpoint[:, :7], -left * (twist - 0.5 * change))
        parts = [pose, twist - change, setpoint[:, 13:]]
        return namespace(setpoint).concatenate(parts, axis=-1)

    def bound(
        self,
        qpos: Array,
        qvel: Array,
        passive: Array,
        left: Array,
    ) -> BoundOSC:
        """Return this controller as a native call on these arrays (envs, dof), and the time to the
        end of the tick ().
        """
        # Native code reads the caller's arrays where they are.
        return BoundOSC(
            self._k,
            ts.Tool(self.tree, self.link, self.point),
            self._parts,
            self._columns,
            self._damping,
            self._friction,
            self._timestep,
            (qpos, qvel, passive),
            left,
        )

    def _friction_to(
        self,
        setpoint: Array,
        twist: Array,
        posture: Array,
        qpos: Array,
        dynamics: ts.TaskDynamics,
        coulomb: Array,
        band: Array,
    ) -> Array:
        """Return the friction (envs, dof) on the way to the setpoint; joints outside the chain go
        to ``posture``.
        """
        # Joint velocities of least squares that move the tool towards its setpoint.
        error = pose_error(setpoint[:, :7], dynamics.pose)
        j = dynamics.jacobian
        others = posture - qpos
        ahead = error if twist is None else error + LOOKAHEAD * twist
        rows = namespace(j).swapaxes(j, -1, -2)
        eye = 1e-4 * namespace(j).eye(6)
        damped = gram(rows, rows) + eye.astype(j.dtype)
        motion = gram(j, solve(damped, ahead[..., None]))[..., 0]
        chain = dynamics.chain
        return compensation(
            coulomb,
            chain * motion + (1 - chain) * others,
            None,
            band,
        )

    def in_runner(self, timestep: float, compensate: str) -> OperationalSpace:
        """Return this controller for the time step [s] and the option ``compensate`` of a
        runner.
        """
        other = copy(self)
        other._k = ts.make_osc_params(self.tree, timestep, **self._options)
        other._timestep = timestep
        other._friction = self._known_friction if "friction" in compensate.split("+") else None
        return other

    def tool_pose(self, qpos: Array) -> NDArray[np.float32]:
        """Return the poses of the tool (..., 7) at ``qpos`` (..., dof), as they are observed."""
        poses = ts.link_poses(self.tree, qpos, [self.link], point=self.point)
        return poses[..., 0, :].astype(np.float32)
