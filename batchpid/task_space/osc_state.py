"""Inputs, state and terms of operational-space control."""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.records import array_summary
from batchpid.task_space.frames import in_axes, matrix_of
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.tree_quantities import evaluated


class Tool(NamedTuple):
    """A point of a robot's link."""

    tree: RigidTree
    link: str
    point: Array = None
    """Point (3,) in the frame of the link [m]; None: its origin."""


class OSCInputs(NamedTuple):
    """Inputs of one step, arrays (envs, ...), or (1, ...) for all envs; None: 0."""

    setpoint: Array
    """Poses (envs, 7): position [m] and quaternion (w, x, y, z) of any length, in the world."""
    qpos: Array
    """(envs, dof) [rad or m]."""
    qvel: Array
    """(envs, dof) [rad/s or m/s]."""
    twist: Array = None
    """V of the setpoint (envs, 6) [m/s, rad/s], in the axes of the world."""
    acceleration: Array = None
    """V' of the setpoint (envs, 6) [m/s^2, rad/s^2], in these axes."""
    wrench: Array = None
    """Wrench of the tool on its surroundings (envs, 6) [N, N m], in the axes of the params'
    frame.
    """
    feedforward: Array = None
    """Effort added (envs, dof), such as the effort of viscous damping [N m or N]."""

    def __repr__(self) -> str:
        return array_summary(self, "envs", "columns")


class TaskDynamics(NamedTuple):
    """Dynamics of a robot and its tool at present positions and velocities, from
    :func:`task_dynamics` or an engine.
    """

    pose: Array
    """Of the tool (envs, 7): position [m] and quaternion (w, x, y, z)."""
    jacobian: Array
    """J of the tool (envs, 6, dof), in the axes of the world."""
    jacobian_rate: Array
    """J' q' (envs, 6)."""
    mass_matrix: Array
    """M (envs, dof, dof) [kg m^2 or kg]."""
    bias: Array
    """h (envs, dof): gravity, Coriolis and centrifugal forces [N m or N]."""
    chain: Array
    """1.0 for the joints between the base and the tool, else 0.0 (dof,)."""


class OSCState(NamedTuple):
    """State of the law."""

    posture: Array
    """Positions (envs, dof) that the joints are drawn to, by the posture gains [rad or m]."""
    integral: Array = None
    """I (envs, 6): acceleration of the task [m/s^2, rad/s^2]. None without
    ``integral_gain``."""

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")


class OSCTerms(NamedTuple):
    """Terms of one step."""

    error: Array
    """Error of the pose (envs, 6) [m, rad], in the axes of the params' frame, before its norms are
    limited.
    """
    wrench: Array
    """Wrench F of the task (envs, 6) [N, N m], in these axes, before saturation."""
    task: Array
    """Efforts of F, J^T F (envs, dof)."""
    posture: Array
    """Efforts of the posture, before saturation (envs, dof)."""
    unsaturated: Array
    """Sum of all efforts (envs, dof) [N m or N]."""
    effort: Array
    """Efforts after saturation (envs, dof)."""
    task_share: Array
    """s1 (envs,): share of F that the limits allow."""
    posture_share: Array
    """s2 (envs,): share of the posture's efforts."""
    near_singular: Array
    """Bool (envs,): an eigenvalue of A is below s0, so that some direction has lost stiffness; True
    for NaN.
    """

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")


def task_dynamics(
    tree: RigidTree,
    qpos: Array,
    qvel: Array,
    link: str,
    *,
    point: Array = None,
    bias: Array = None,
) -> TaskDynamics:
    """Return the dynamics of ``tree`` with a tool: a ``point`` (3,) [m] of ``link``, default its
    origin.

    ``qpos`` and ``qvel`` are (envs, dof). A ``bias`` (envs, dof), such as an engine's, takes the
    place of the tree's.

    Raises
    ------
    InvalidArgumentError
        The link is unknown, or a shape is wrong.
    """
    names: tuple[str, ...] = ("pose", "jacobian", "jacobian_rate", "mass_matrix")
    if bias is None:
        names = (*names, "bias")
    results = evaluated(
        tree,
        names,
        qpos,
        qvel,
        link,
        point,
    )
    xp = namespace(results["pose"])
    chain = xp.asarray(tree.chain(link), dtype=results["pose"].dtype)
    return TaskDynamics(**{"bias": bias, "chain": chain, **results})


def in_tool_axes(dynamics: TaskDynamics) -> TaskDynamics:
    """Return ``dynamics`` with J and J' q' in the axes of the tool."""
    turn = matrix_of(dynamics.pose[..., 3:])
    rate = in_axes(turn, dynamics.jacobian_rate[..., None])[..., 0]
    return dynamics._replace(jacobian=in_axes(turn, dynamics.jacobian), jacobian_rate=rate)
