"""Dynamics of one robot at given poses: by MuJoCo in double precision. Contacts and places of links are SAPIEN's."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.engines import load_engine
from batchpid.sim.engine.mujoco.batch_model import BatchModel
from batchpid.sim.engine.mujoco.model_builder import robot_model
from batchpid.sim.engine.protocol import RobotModel
from batchpid.sim.engine.rigid_body import RigidBodies, mass_matrix
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.mimics import coupling_of
from batchpid.task_space.spatial_inertia import SpatialInertia, rotation_matrix, total

Float64 = NDArray[np.float64]


class MujocoDynamics:
    """Dynamics of the robot of ``spec``. Implements :class:`batchpid.sim.engine.protocol.RobotModel`."""

    def __init__(self, spec: SceneSpec) -> None:
        self._spec, self._robot, self._lock = spec, robot_model(spec), RLock()

    def __reduce__(self) -> Any:  # a controller that keeps it can be sent to worker processes
        return scene_dynamics, (self._spec,)

    @cached_property
    def bodies(self) -> RigidBodies:
        """Bodies of the robot on a fixed base."""
        return bodies_of(self._spec)

    def mass_matrix(self, qpos: Any) -> Any:
        """Return the joint-space mass matrices (n, dof, dof) [kg m^2 or kg]."""
        if not isinstance(qpos, np.ndarray) and hasattr(qpos, "__array_namespace__"):
            return mass_matrix(self.bodies, qpos)
        with self._lock:
            return self._computed(qpos, 0.0).mass_matrix()

    def joint_mass_matrix(self, qpos: NDArray[Any]) -> Float64:
        """Return the mass matrices (n, dof, dof) that the joints show, on a floating base where there is one."""
        with self._lock:
            return self._computed(qpos, 0.0).joint_mass_matrix()

    def inverse_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], qacc: NDArray[Any]) -> Float64:
        """Return the efforts (n, dof) [N m or N] of a motion, gravity included."""
        with self._lock:
            batch = self._computed(qpos, qvel)
            return batch.bias() + (batch.mass_matrix() @ np.asarray(qacc, float)[..., None])[..., 0]

    def passive_force(self, qpos: Float64, qvel: Float64, gravity: bool, coriolis: bool) -> Float64:
        """Return the efforts (n, dof) [N m or N] that cancel gravity and Coriolis and centrifugal forces."""
        with self._lock:
            force = self._computed(qpos, qvel if coriolis else 0.0).bias()
            return force if gravity else force - self._computed(qpos, 0.0).bias()

    def forward_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], effort: NDArray[Any]) -> Float64:
        """Return the accelerations (n, dof) under ``effort``; followers keep to their leaders."""
        with self._lock:
            batch = self._computed(qpos, qvel)
            acting, matrix = np.asarray(effort) - batch.bias(), batch.mass_matrix()
        coupling = coupling_of(self._spec.joints)
        qacc = np.linalg.solve(coupling.mass_matrix(matrix), coupling.efforts(acting)[..., None])[..., 0]
        return np.asarray(coupling.rates(qacc), np.float64)

    def _computed(self, qpos: NDArray[Any], qvel: Any) -> BatchModel:
        batch = self._batch(len(qpos))
        batch.compute(qpos, qvel)
        return batch

    @lru_cache(maxsize=4)  # noqa: B019 (robots are few, and kept)
    def _batch(self, size: int) -> BatchModel:
        return BatchModel(self._robot, size)

    @cached_property
    def _shapes(self) -> RobotModel:
        return load_engine("sapien").scene_dynamics(in_sapien(self._spec))

    def link_poses(self, qpos: NDArray[Any]) -> Float64:
        """Return the poses of the simulated links (links, 4, 4), homogeneous [m], at one pose (dof,)."""
        return self._shapes.link_poses(qpos)

    def in_contact(self, qpos: NDArray[Any], clearance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground (n,)."""
        return self._shapes.in_contact(qpos, clearance)

    def nearest_links(self, qpos: NDArray[Any]) -> tuple[str, ...]:
        """Return the two links of the URDF that are nearest to each other at one pose (dof,)."""
        return self._shapes.nearest_links(qpos)

    def height(self, qpos: NDArray[Any], base_too: bool = False) -> float:
        """Return the height [m] of the lowest point of the links that move, at one pose (dof,)."""
        return self._shapes.height(qpos, base_too)


def in_sapien(spec: SceneSpec) -> SceneSpec:
    """Return ``spec`` for SAPIEN, for questions about contact at a pose."""
    return replace(spec, engine="sapien", physics=load_engine("sapien").physics["fast"])


def bodies_of(spec: SceneSpec) -> RigidBodies:
    """Return the bodies of the robot of ``spec`` on a fixed base, from MuJoCo's model."""
    robot = robot_model(spec)
    model, dof = robot.model, len(robot.qvel)
    order = {int(model.dof_jntid[index]): number for number, index in enumerate(robot.qvel)}
    places: dict[int, tuple[int, Float64]] = {0: (-1, np.eye(4))}  # of each body: its joint, and its place in its frame
    parts: list[list[SpatialInertia]] = [[] for _ in range(dof + 1)]  # the last are the base's
    tree, at_zero = np.tile(np.array([-1, 0], np.int32), (dof, 1)), np.tile(np.eye(4), (dof, 1, 1))
    for body in range(1, model.nbody):
        above, place = places[int(model.body_parentid[body])]
        joint = int(model.body_jntadr[body])
        floats = joint >= 0 and joint not in order
        if not floats:
            place = place @ _matrix(model.body_pos[body], model.body_quat[body])
        if joint in order:
            turned = _along_x(model.jnt_axis[joint])
            above, number = order[joint], above
            tree[above] = number, model.jnt_type[joint] == 2
            at_zero[above], place = place @ turned, turned.T
        places[body] = above, place
        if model.body_mass[body] > 0:
            at = place @ _matrix(model.body_ipos[body], model.body_iquat[body])
            tensor = at[:3, :3] @ np.diag(model.body_inertia[body]) @ at[:3, :3].T
            parts[above].append(SpatialInertia(float(model.body_mass[body]), at[:3, 3], tensor))
    *bodies, base = [total(of_joint or [_NO_BASE]) for of_joint in parts]
    mass, center, tensor = map(np.array, zip(*bodies, strict=True))
    links = {name: places[body] for name, body in robot.bodies.items()}
    return RigidBodies(tree, at_zero[:, :3, :3], at_zero[:, :3, 3], mass, center, tensor, base, links).frozen()


_NO_BASE = SpatialInertia(1e-12, np.zeros(3), np.zeros((3, 3)))
"""Inertia of a fixed base, which MuJoCo does not simulate."""


def _matrix(position: Float64, wxyz: Float64) -> Float64:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(np.array(wxyz)), position
    return matrix


def _along_x(axis: Float64) -> Float64:
    """Return a rotation (4, 4), homogeneous, whose x axis is ``axis``."""
    matrix, x = np.eye(4), np.asarray(axis, float) / np.linalg.norm(axis)
    y = np.cross(x, np.eye(3)[np.argmin(np.abs(x))])
    y /= np.linalg.norm(y)
    matrix[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    return matrix


@lru_cache(maxsize=8)
def scene_dynamics(spec: SceneSpec) -> MujocoDynamics:
    """Return the dynamics of the robot of ``spec``, the same object for equal specs."""
    return MujocoDynamics(spec)
