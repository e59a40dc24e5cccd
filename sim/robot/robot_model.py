"""Model of one robot at given poses: dynamics by :mod:`batchpid.task_space`, contacts from its
collision shapes.

The rigid tree has the simulated bodies in double precision. SAPIEN's tree has single precision.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Bool, Float64, Rows
from batchpid.motors.coupling import Coupling
from batchpid.sim.geometry.distances import Contacts
from batchpid.sim.robot.tables import Tables
from batchpid.task_space.frames import matrix_of
from batchpid.task_space.rigid_tree import RigidTree


class RobotModel:
    """Dynamics and contacts of a robot on a fixed base, at poses qpos (n, dof).

    Friction, damping and motors are left out. Several threads may use one object.

    Parameters
    ----------
    tree, coupling
        Tree of the simulated links on a fixed base, and the coupling of its joints.
    tables, ignored
        Simulated bodies of the robot, and pairs of its links that do not collide.
    ground
        Whether there is a ground at height 0.
    """

    def __init__(
        self,
        tree: RigidTree,
        coupling: Coupling,
        tables: Tables,
        ignored: frozenset[frozenset[str]],
        ground: bool,
    ) -> None:
        self.tree = tree
        self._coupling = coupling
        self._tables = tables
        self._ignored = ignored
        self._ground = ground

    def __reduce__(self) -> Any:  # a controller that keeps it can be sent to worker processes
        return RobotModel, (self.tree, self._coupling, self._tables, self._ignored, self._ground)

    def mass_matrix(self, qpos: Array) -> Array:
        """Return the joint-space mass matrices (n, dof, dof) [kg m^2 or kg], in NumPy or JAX as
        ``qpos``.
        """
        return ts.mass_matrix(self.tree, qpos)

    def inverse_dynamics(self, qpos: Array, qvel: Array, qacc: Array) -> Array:
        """Return the efforts (n, dof) [N m or N] of a motion, gravity included; in NumPy or JAX as
        the arguments.
        """
        return ts.inverse_dynamics(self.tree, qpos, qvel, qacc)

    def holding_efforts(self, qpos: Rows) -> Float64:
        """Return the efforts (n, dof) [N m or N] that hold ``qpos`` against gravity; leaders hold
        followers.
        """
        still = np.zeros_like(qpos)
        efforts: Float64 = self._coupling.efforts(self.inverse_dynamics(qpos, still, still))
        return efforts

    def forward_dynamics(self, qpos: Array, qvel: Array, effort: Array) -> Array:
        """Return the accelerations (n, dof) [rad/s^2 or m/s^2] under ``effort`` [N m or N], gravity
        included.

        Followers move with their leaders. The result is in NumPy or JAX as the arguments.
        """
        return ts.forward_dynamics(self._coupled, qpos, qvel, effort)

    def standing_inertia(self, qpos: Rows) -> Float64:
        """Return the inertia (dof,) that each joint moves at one pose (dof,) if the base floats and
        its feet stand.

        The feet F are pinned. Velocities q' of the joints move the base at V = A q', A = -J_b^+
        J_j, where J_b and J_j are the Jacobians of F with respect to the base and the joints. The
        mass matrix of this motion is the sum of J^T I J of all bodies, with J = J_j + J_b A. The
        result is the sum of the absolute values in each of its rows: diagonal gains for these sums
        are at least as stiff as gains for the matrix (Gershgorin's theorem).
        """
        tree = self.tree
        joints = np.asarray(qpos, np.float64)

        def jacobians(link: str, point: Float64) -> tuple[Float64, Float64]:
            """Return the Jacobians of a point of the world in a link (6, dof), and with respect to
            the base (6, 6).
            """
            x, y, z = point
            # A twist of the base moves each point of the world by v + w x p.
            crossed = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # -(p x)
            of_base = np.block([[np.eye(3), crossed], [np.zeros((3, 3)), np.eye(3)]])
            pose = ts.link_poses(tree, joints, (link,))[0]
            local = matrix_of(pose[3:]).T @ (point - pose[:3])
            return np.asarray(ts.jacobian(tree, joints, link, point=local)), of_base

        feet = [jacobians(link, point) for link, point in self.contacts.feet(joints)]
        follow = np.zeros((6, tree.dof))
        if feet:
            of_joints, of_base = (
                np.concatenate([foot[:3] for foot in part]) for part in zip(*feet, strict=True)
            )
            # Directions that the feet leave free are cut off, not followed.
            follow = -np.linalg.pinv(of_base, rcond=1e-3) @ of_joints
        matrix = np.zeros((tree.dof, tree.dof))
        for at, link in enumerate(tree.links):
            pose = ts.link_poses(tree, joints, (link,))[0]
            turn = matrix_of(pose[3:])
            of_joints, of_base = jacobians(link, pose[:3] + turn @ tree.center[at])
            moving = of_joints + of_base @ follow
            linear = moving[:3]
            angular = moving[3:]
            matrix += (
                tree.mass[at] * linear.T @ linear
                + angular.T @ turn @ tree.inertia[at] @ turn.T @ angular
            )
        inertia: Float64 = np.abs(matrix).sum(1)
        return inertia

    @cached_property
    def _coupled(self) -> RigidTree:
        return replace(self.tree, coupling=self._coupling)

    @cached_property
    def contacts(self) -> Contacts:
        """Distances of the links to each other and to the ground."""
        return Contacts(self.tree, self._tables.shapes, self._ignored, self._ground)

    def in_contact(self, qpos: Rows, clearance: float = 0.0) -> Bool:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground
        (n,).

        Links that a fixed joint connects may touch, and the base and the links fixed to it may
        touch the ground.
        """
        return self.contacts.in_contact(qpos, clearance)


def base_start(robot: Any, qpos: Float64, ground: bool) -> Float64:
    """Return the pose (7,) from which a floating base starts with its joints at ``qpos`` (dof,).

    It is the file's, with the lowest point of the robot as high as at the start pose of the joints.
    If the file does not place the base, it is upright at the origin. On a ``ground`` at height 0
    the lowest point is then on the ground, and otherwise not below.
    """
    pose = np.array(robot.reading.base_start or (0, 0, 0, 1, 0, 0, 0), np.float64)
    model = robot.dynamics()
    # The ground is met by any link, the base included.
    height = model.contacts.height(np.nan_to_num(qpos), base_too=True)
    if not np.isfinite(height):
        return pose
    if robot.reading.base_start is not None:
        lowest = pose[2] + model.contacts.height(robot.start, base_too=True)
        pose[2] = (max(lowest, 0.0) if ground else lowest) - height
    elif ground:
        pose[2] = -height
    return pose
