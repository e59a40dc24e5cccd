"""Operational-space control of one link, as the control of a Runner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import batchpid.task_space as ts
from batchpid.arrays.display import summary
from batchpid.arrays.elementwise import namespace
from batchpid.checks.validate import array, choice, instance, names
from batchpid.errors import InvalidArgumentError
from batchpid.sim.command import CommandSpec
from batchpid.sim.robot.robot import Robot

_POSE = {"x": "m", "y": "m", "z": "m", "qw": "", "qx": "", "qy": "", "qz": ""}
_TWIST = {"vx": "m/s", "vy": "m/s", "vz": "m/s", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}


class OperationalSpace:
    """Controller for ``Runner(control=...)``: the law of :mod:`batchpid.task_space.operational_space`.

    A setpoint is a pose of the tool in the world (7,): position [m] and quaternion (w, x, y, z). The quaternion is
    normalised: its length and sign have no effect; one of length 0 has no direction, and fails its env. Further entries
    are the tool's twist (6,), with ``twist=True``, and the positions of ``joints``.

    The bias is the runner's passive force, as ``compensate`` selects; Jacobian and mass matrix are those of ``tree``.
    The state is the posture of each env, which a reset restores. An env that has failed holds the pose of the posture.

    Parameters
    ----------
    robot
        Robot of the runner.
    link
        Link that carries the tool.
    point
        Tool in the link's frame (3,) [m]; default its origin.
    twist
        Whether setpoints give the velocity of the tool, too (m/s and rad/s, in the world): a tool that moves follows
        its setpoint without the delay kd/kp.
    joints
        Joints outside the chain to the link, such as fingers, whose positions are part of the setpoint; others hold
        their posture.
    posture
        Joint positions (dof,) that the null space is drawn to; default ``robot.start``.
    tree
        Kinematic tree; default ``robot.kinematic_tree()``.
    options
        Options of :func:`batchpid.task_space.make_osc_params`, one row for all envs; ``effort_limit`` is by default
        the robot's.

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
        joints: Sequence[str] = (),
        posture: ArrayLike | None = None,
        tree: ts.KinematicTree | None = None,
        **options: Any,
    ) -> None:
        robot = instance("robot", robot, Robot, "pass Robot.load(...)")
        tree = robot.kinematic_tree() if tree is None else tree
        self._tree = instance("tree", tree, ts.KinematicTree, "pass robot.kinematic_tree()")
        self._link, self._twist = link, bool(twist)
        self._point = None if point is None else array("point", point, (1, 3), "xyz", kind="entry")[0]
        self._posture = array("posture", robot.start if posture is None else posture, (1, tree.dof), tree.joint_names)
        if not {"effort_limit", "effort_min", "effort_max"} & set(options):
            options["effort_limit"] = robot.effort_limit
        self._params = _of_one_row(ts.make_osc_params(tree, **options))
        chain = tree.chain(link)
        self._columns = np.zeros(tree.dof, np.intp)  # of the setpoint, for each joint; 0 for none
        size = len(_POSE) + self._twist * len(_TWIST)
        for column, name in enumerate(names("joints", list(joints)), size):
            joint = tree.joint_names.index(choice("joints", name, tree.joint_names))
            if chain[joint]:
                remedy = "name joints outside the chain, such as fingers"
                raise InvalidArgumentError("joints", f"the pose of {link!r} controls it", joint=name, remedy=remedy)
            self._columns[joint] = column
        units = dict(zip(robot.joint_names, robot.units, strict=True)) if joints else {}
        entries = _POSE | (_TWIST if self._twist else {}) | {name: units[name] for name in joints}
        pose = ts.link_poses(tree, self._posture, [link])[0, 0]
        if point is not None:
            pose[:3] = ts.task_dynamics(tree, self._posture, 0 * self._posture, link, point=self._point).pose[0, :3]
        others = [self._posture[0, tree.joint_names.index(name)] for name in joints]
        neutral = np.concatenate([pose, np.zeros(size - len(_POSE)), others])
        self.command = CommandSpec(tuple(entries), tuple(entries.values()), neutral=neutral)
        """Names and units of a setpoint; the neutral one is the pose of the posture."""

    def __repr__(self) -> str:
        return summary(type(self).__name__, [self._link, "setpoints " + " ".join(self.command.names)])

    def init(self, robot: Robot, num_envs: int) -> ts.OSCState:
        """Return the state of ``num_envs`` envs.

        Raises
        ------
        InvalidArgumentError
            The robot has other joints than the one of this controller.
        """
        if robot.joint_names != self._tree.joint_names:
            problem = f"was made for the joints {', '.join(self._tree.joint_names)}, but the runner's robot has others"
            raise InvalidArgumentError("control", problem, remedy="make it for the robot of the runner")
        return ts.init(self._params, np.repeat(self._posture, num_envs, axis=0))

    def __call__(self, state: ts.OSCState, setpoint: Any, qpos: Any, qvel: Any, passive: Any) -> tuple[Any, Any]:
        """Return the state, which stays the same, and the efforts (envs, dof) [N m or N]."""
        xp = namespace(setpoint, qpos)
        aimed = state
        if self._columns.any():
            aimed = ts.OSCState(xp.where(self._columns > 0, setpoint[:, self._columns], state.posture))
        dynamics = ts.task_dynamics(self._tree, qpos, qvel, self._link, point=self._point, bias=passive)
        twist = setpoint[:, 7:13] if self._twist else None
        _, effort = ts.advance(self._params, aimed, dynamics, setpoint[:, :7], qpos, qvel, twist)
        return state, effort


def _of_one_row(params: ts.OSCParams) -> ts.OSCParams:
    """Raise InvalidArgumentError for options that differ by env: a controller is called for any group of envs."""
    for name, leaf in params._asdict().items():
        if isinstance(leaf, np.ndarray) and len(leaf) > 1:
            problem = f"has rows for {len(leaf)} envs"
            raise InvalidArgumentError(name, problem, remedy="give one row: a controller is called for groups of envs")
    return params
