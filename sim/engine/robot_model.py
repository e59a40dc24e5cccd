"""Model of one robot at given poses: dynamics by :mod:`batchpid.task_space`, contacts from its collision shapes.

The rigid tree has the simulated bodies in double precision. SAPIEN's tree has single precision (:func:`scene_tree`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Bool, Float64, Rows
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.collision_shapes import link_shapes
from batchpid.sim.robot.contacts import Contacts, Near
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.mimics import coupling_of
from batchpid.sim.robot.simulated_links import body_inertias, rigid_tree, simulated
from batchpid.task_space.frames import matrix_of, unrotate
from batchpid.task_space.rigid_tree import RigidTree


class RobotModel:
    """Dynamics and contacts of the robot of ``spec`` on a fixed base, at poses qpos (n, dof).

    Friction, damping and motors are left out. Several threads may use one object.
    """

    def __init__(self, spec: SceneSpec) -> None:
        self._spec, self.tree = spec, description_tree(spec)

    def __reduce__(self) -> Any:  # a controller that keeps it can be sent to worker processes
        return scene_model, (self._spec,)

    def mass_matrix(self, qpos: Array) -> Array:
        """Return the joint-space mass matrices (n, dof, dof) [kg m^2 or kg], in NumPy or JAX as ``qpos``."""
        return ts.mass_matrix(self.tree.held, qpos)

    def inverse_dynamics(self, qpos: Rows, qvel: Rows, qacc: Rows) -> Float64:
        """Return the efforts (n, dof) [N m or N] of a motion, gravity included."""
        return np.asarray(ts.inverse_dynamics(self.tree.held, qpos, qvel, qacc), np.float64)

    def passive_force(self, qpos: Float64, qvel: Float64, gravity: bool, coriolis: bool) -> Float64:
        """Return the efforts (n, dof) [N m or N] that cancel gravity and Coriolis and centrifugal forces."""
        return passive_force(self.tree.held, qpos, qvel, gravity, coriolis)

    def forward_dynamics(self, qpos: Rows, qvel: Rows, effort: Rows) -> Float64:
        """Return the accelerations (n, dof) [rad/s^2 or m/s^2] under ``effort`` [N m or N], gravity included.

        Followers move with their leaders.
        """
        return np.asarray(ts.forward_dynamics(self._coupled, qpos, qvel, effort), np.float64)

    def standing_inertia(self, qpos: Rows) -> Float64:
        """Return the inertia (dof,) that each joint moves at one pose (dof,) if the base floats and its feet stand.

        The feet F are pinned. Velocities q' of the joints move the base at V = A q', A = -J_b^+ J_j, where J_b and J_j
        are the Jacobians of F with respect to the base and the joints. The mass matrix of this motion is the sum of
        J^T I J of all bodies, with J = J_j + J_b A. The result is the sum of the absolute values in each of its rows:
        diagonal gains for these sums are at least as stiff as gains for the matrix (Gershgorin's theorem).
        """
        tree, joints = self.tree.held, np.asarray(qpos, np.float64)

        def jacobians(link: str, point: Float64) -> tuple[Float64, Float64]:
            """Return the Jacobians of a point of the world in a link (6, dof), and with respect to the base (6, 6)."""
            x, y, z = point
            crossed = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # -(p x)
            of_base = np.block([[np.eye(3), crossed], [np.zeros((3, 3)), np.eye(3)]])
            pose = ts.link_poses(tree, joints, (link,))[0]
            local = matrix_of(pose[3:]).T @ (point - pose[:3])
            return np.asarray(ts.jacobian(tree, joints, link, point=local)), of_base

        feet = [jacobians(link, point) for link, point in self._contacts.feet(joints)]
        follow = np.zeros((6, tree.dof))
        if feet:
            of_joints, of_base = (np.concatenate([each[:3] for each in part]) for part in zip(*feet, strict=True))
            follow = -np.linalg.pinv(of_base, rcond=1e-3) @ of_joints
        matrix = np.zeros((tree.dof, tree.dof))
        for at, link in enumerate(tree.links):
            pose = ts.link_poses(tree, joints, (link,))[0]
            turn = matrix_of(pose[3:])
            of_joints, of_base = jacobians(link, pose[:3] + turn @ tree.center[at])
            moving = of_joints + of_base @ follow
            linear, angular = moving[:3], moving[3:]
            matrix += tree.mass[at] * linear.T @ linear + angular.T @ turn @ tree.inertia[at] @ turn.T @ angular
        return np.abs(matrix).sum(1)

    @cached_property
    def _coupled(self) -> RigidTree:
        return replace(self.tree.held, coupling=coupling_of(self._spec.joints))

    @cached_property
    def _contacts(self) -> Contacts:
        return contacts_of(self._spec, self._spec.ground)

    def in_contact(self, qpos: Rows, clearance: float = 0.0) -> Bool:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground (n,).

        Links that a fixed joint connects may touch, and the base and the links fixed to it may touch the ground.
        """
        return self._contacts.in_contact(qpos, clearance)

    def near(self, qpos: Rows, within: float) -> list[Near]:
        """Return the pairs of shapes closer than ``within`` [m] to each other or to the ground, at one pose (dof,)."""
        return list(self._contacts.near(qpos, within))

    def nearest_links(self, qpos: Rows) -> tuple[str, ...]:
        """Return the two links of the URDF that are nearest to each other, or overlap most, at one pose (dof,).

        One link if the other is the ground; no link if none are near each other.
        """
        return self._contacts.nearest_links(qpos)

    def height(self, qpos: Rows, base_too: bool = False) -> float:
        """Return the height [m] of the lowest point of the links that move, at one pose (dof,); inf without shapes.

        With ``base_too`` the links that are fixed to the base count as well.
        """
        return self._contacts.height(qpos, base_too)


def passive_force(
    tree: RigidTree, qpos: Float64, qvel: Float64, gravity: bool, coriolis: bool, base: Float64 | None = None
) -> Float64:
    """Return the gravity part of :func:`batchpid.task_space.bias` (n, dof), its velocity part, or both.

    ``base`` (n, 6) are gravity and the rate at which the base turns, in its own axes, of one that floats, or with a
    tree on a fixed base of one that is held where it is. The gravity part of a floating base is 0.
    """
    zero, turning, bodies = np.zeros_like(np.asarray(qpos, np.float64)), None, None
    if base is not None:
        turning = base[:, 3:]
        bodies = tree.bodies._replace(gravity=base[:, None, :3])
    force = zero
    if coriolis or (gravity and tree.fixed_base):
        force = ts.bias(tree, qpos, qvel if coriolis else zero, turning if coriolis else None, bodies=bodies)
    if coriolis and not gravity and tree.fixed_base:
        force = force - ts.bias(tree, qpos, zero, bodies=bodies)
    return np.asarray(force, np.float64)


def turned_back(wxyz: Float64, vectors: Any) -> Float64:
    """Return vectors of the world, (3,) or (n, 3), in the axes of bases with these quaternions (n, 4).

    Rounded as by ``turn_back`` in ``sim_step.h``.
    """
    return np.asarray(unrotate(matrix_of(wxyz), vectors))


@lru_cache(maxsize=16)
def description_tree(spec: SceneSpec) -> RigidTree:
    """Return the rigid tree of the simulated bodies of ``spec``, not coupled; the same object for equal specs."""
    text = simulated(spec.urdf, spec.separate).urdf
    inertias = body_inertias(spec.urdf, spec.separate)
    return rigid_tree(text, inertias, gravity=spec.gravity, fixed_base=spec.fixed_base)


def contacts_of(spec: SceneSpec, ground: bool) -> Contacts:
    """Return the contacts of the robot of ``spec``, even of one without shapes there; ``ground`` is at height 0."""
    ignored = {frozenset(pair) for pair in spec.ignored}
    return Contacts(description_tree(spec), link_shapes(spec.urdf, spec.separate), ignored, ground)


def scene_tree(spec: SceneSpec) -> RigidTree:
    """Return the rigid tree of the robot of ``spec`` as its engine simulates it, the same object for equal specs."""
    return load_engine(spec.engine).scene_tree(spec)


@lru_cache(maxsize=8)
def scene_model(spec: SceneSpec) -> RobotModel:
    """Return the model of the robot of ``spec``, the same object for equal specs."""
    return RobotModel(spec)


def base_start(robot: RobotDescription, qpos: Float64, ground: bool) -> Float64:
    """Return the pose (7,) from which a floating base starts with its joints at ``qpos`` (dof,).

    It is the file's, with the lowest point of the robot as high as at the start pose of the joints. If the file does
    not place the base, it is upright at the origin. On a ``ground`` at height 0 the lowest point is then on the ground,
    and otherwise not below.
    """
    pose, model = np.array(robot.base_start or (0, 0, 0, 1, 0, 0, 0), np.float64), robot_model(robot)
    height = model.height(np.nan_to_num(qpos), base_too=True)
    if not np.isfinite(height):
        return pose
    if robot.base_start is not None:
        lowest = pose[2] + model.height(robot.start, base_too=True)
        pose[2] = (max(lowest, 0.0) if ground else lowest) - height
    elif ground:
        pose[2] = -height
    return pose


def robot_model(robot: RobotDescription, ground: bool | None = None) -> RobotModel:
    """Return the model of ``robot`` on a fixed base; ``ground`` at height 0, by default ``robot.has_ground``."""
    has_ground = robot.has_ground if ground is None else ground
    return scene_model(SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, None, ground=has_ground))
