"""Inputs, state and terms of operational-space control."""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.task_space.rigid_tree import RigidTree


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
    """Wrench of the tool on its surroundings (envs, 6) [N, N m], in these axes."""
    feedforward: Array = None
    """Effort added (envs, dof), such as the effort of viscous damping [N m or N]."""


class TaskDynamics(NamedTuple):
    """Dynamics of a robot and its tool at present positions and velocities, from
    :func:`.task_dynamics` or an engine.
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


class OSCTerms(NamedTuple):
    """Terms of one step."""

    error: Array
    """Error of the pose (envs, 6) [m, rad], in the axes of the world, before its norms are limited."""
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
