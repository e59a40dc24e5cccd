"""Dynamics of one robot and its contacts, at given poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache, wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, TypeVar
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.rigid_body import RigidBodies, mass_matrix
from batchpid.sim.engine.sapien.bodies import bodies_of
from batchpid.sim.engine.sapien.building import (
    add_point_mass,
    build_scene,
    center_of_mass,
    new_system,
    parse,
    rigid_bodies,
    shape_owners,
)
from batchpid.sim.engine.sapien.collision_groups import Pair
from batchpid.sim.engine.sapien.extents import WORLD, NearPair
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.kinematics import Kinematics
from batchpid.sim.robot.mimics import coupling_of
from batchpid.sim.robot.parts import Joint

P = ParamSpec("P")
T = TypeVar("T")


def _one_at_a_time(method: Callable[Concatenate[Dynamics, P], T]) -> Callable[Concatenate[Dynamics, P], T]:
    """Decorate a method to hold the lock of its object: methods set the pose of the robot and then read from it."""

    @wraps(method)
    def locked(self: Dynamics, *args: P.args, **kwargs: P.kwargs) -> T:
        with self._lock:
            return method(self, *args, **kwargs)

    return locked


class Dynamics:
    """Dynamics and contacts of one robot alone, at poses qpos (n, dof).

    The dynamics are Pinocchio's, on the model that SAPIEN derives, with ``payload`` [kg] at the center of mass of
    ``link`` if one is given. Friction and damping are left out. Several threads may use one object.
    """

    def __init__(self, spec: SceneSpec, payload: float = 0.0, link: str | None = None) -> None:
        self._spec, self._lock, self._load = spec, RLock(), (payload, link)
        self._system = new_system(replace(spec, timestep=1e-6))
        self._scene, self._robot = build_scene(spec, self._system)
        if link is not None:
            body, center = center_of_mass(spec, link)
            add_point_mass(next(each for each in self._robot.links if each.name == body), payload, center)
        self._model = self._robot.create_pinocchio_model()
        self._links = {link: number for number, link in enumerate(self._robot.links)}
        owners, bodies = shape_owners(spec), rigid_bodies(parse(spec))
        self._owners = {
            shape: owner
            for link in self._robot.links
            for shape, owner in zip(link.collision_shapes, owners[link.name], strict=True)
        }
        # Rigid body of each link, by number; the last is the ground's (WORLD), which counts as the base.
        self._bodies = [bodies[link.name] for link in (*self._robot.links, self._robot.links[0])]

    def __reduce__(self) -> Any:  # a controller that keeps it can be sent to worker processes
        if self._load == (0.0, None):
            return scene_dynamics, (self._spec,)
        return Dynamics, (self._spec, *self._load)

    @cached_property
    def bodies(self) -> RigidBodies:
        return bodies_of(self._robot)

    @_one_at_a_time
    def mass_matrix(self, qpos: Any) -> Any:
        """Return the joint-space mass matrices (n, dof, dof) [kg m^2 or kg].

        Those of a JAX array are computed in its program, on the CPU (:mod:`batchpid.sim.engine.rigid_body`); they have
        no derivatives.
        """
        if not isinstance(qpos, np.ndarray) and hasattr(qpos, "__array_namespace__"):
            return mass_matrix(self.bodies, qpos)
        return _rowwise(self._model.compute_generalized_mass_matrix, qpos)

    @_one_at_a_time
    def joint_mass_matrix(self, qpos: NDArray[Any], added: Mapping[str, Float64] | None = None) -> Float64:
        """Return the mass matrices (n, dof, dof) that the joints show, on a floating base where the robot has one.

        There it is the Schur complement M_jj - M_jb M_bb^-1 M_bj of the matrix with six more joints, for the base.
        ``added`` are spatial inertias (n, 6, 6) that links have in addition, by name
        (:func:`batchpid.task_space.spatial_inertia.spatial_matrix`).
        """
        if self._spec.fixed_base:
            return self.mass_matrix(qpos) + self._added_mass_matrix(qpos, added or {})
        base, on_joints = len(_BASE), scene_dynamics(_on_joints(self._spec))
        placed = np.pad(qpos, ((0, 0), (base, 0)))
        full = on_joints.mass_matrix(placed) + on_joints._added_mass_matrix(placed, added or {})
        couples = full[:, :base, base:]
        return full[:, base:, base:] - couples.transpose(0, 2, 1) @ np.linalg.solve(full[:, :base, :base], couples)

    def _added_mass_matrix(self, qpos: NDArray[Any], added: Mapping[str, Float64]) -> Float64:
        """Return the part of mass matrices (n, dof, dof) of spatial inertias S: the sum of J^T S J of their links."""
        matrices = np.zeros((*qpos.shape, qpos.shape[1]))
        numbers = {link.name: number for link, number in self._links.items() if link.name in added}
        if not numbers:
            return matrices
        inertias = np.stack([added[name] for name in numbers], axis=1)
        for row, pose in enumerate(np.asarray(qpos, np.float64)):
            self._model.compute_full_jacobian(pose)
            jacobians = np.array([self._model.get_link_jacobian(number, local=True) for number in numbers.values()])
            matrices[row] = (jacobians.transpose(0, 2, 1) @ inertias[row] @ jacobians).sum(0)
        return matrices

    @_one_at_a_time
    def inverse_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], qacc: NDArray[Any]) -> Float64:
        return _rowwise(self._model.compute_inverse_dynamics, qpos, qvel, qacc)

    @_one_at_a_time
    def passive_force(self, qpos: Float64, qvel: Float64, gravity: bool, coriolis: bool) -> Float64:
        still = np.zeros_like(qpos)
        force = self.inverse_dynamics(qpos, qvel if coriolis else still, still)
        return force if gravity else force - self.inverse_dynamics(qpos, still, still)

    @_one_at_a_time
    def forward_dynamics(self, qpos: NDArray[Any], qvel: NDArray[Any], effort: NDArray[Any]) -> Float64:
        """Return the accelerations (n, dof) [rad/s^2 or m/s^2] under ``effort`` [N m or N], gravity included.

        Followers keep to their leaders: q'' = G M_r^-1 G^T (u - passive force).
        """
        coupling = coupling_of(self._spec.joints)
        if coupling.is_identity:
            return _rowwise(self._model.compute_forward_dynamics, qpos, qvel, effort)
        free = self.inverse_dynamics(qpos, qvel, np.zeros_like(np.asarray(qpos, np.float64)))
        matrix, acting = coupling.mass_matrix(self.mass_matrix(qpos)), coupling.efforts(np.asarray(effort) - free)
        return coupling.rates(np.linalg.solve(matrix, acting[..., None])[..., 0])

    @_one_at_a_time
    def in_contact(self, qpos: NDArray[Any], clearance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground (n,).

        Links joined by fixed joints do not count, nor the base and the links fixed to it with the ground.
        """
        bodies = self._bodies
        return np.array(
            [
                any(bodies[a] != bodies[b] and distance < clearance for a, b, distance in self.near_pairs(row))
                for row in np.asarray(qpos)
            ]
        )

    @_one_at_a_time
    def link_distances(self, qpos: NDArray[Any]) -> dict[Pair, float]:
        """Return the distances [m] of the pairs of links of the URDF that are near each other, at one pose (dof,).

        Links joined by fixed joints do not count. The ground counts as the base.
        """
        distances: dict[Pair, float] = {}
        for names, distance in self._near_links(qpos):
            pair = frozenset([*names, self._bodies[WORLD]][:2])
            distances[pair] = min(distance, distances.get(pair, np.inf))
        return distances

    @_one_at_a_time
    def nearest_links(self, qpos: NDArray[Any]) -> tuple[str, ...]:
        return min(self._near_links(qpos), key=lambda near: near[1], default=((), np.inf))[0]

    def _near_links(self, qpos: NDArray[Any]) -> Iterator[tuple[tuple[str, ...], float]]:
        """Yield the links of the URDF, one or two, and the distance [m] of each pair of shapes near each other."""
        self.near_pairs(qpos)
        for contact in self._system.get_contacts():
            first, second = (self._bodies[self._links.get(body, WORLD)] for body in contact.bodies)
            if first != second:
                names = tuple(self._owners[shape] for shape in contact.shapes if shape in self._owners)
                yield names, min(point.separation for point in contact.points)

    @_one_at_a_time
    def height(self, qpos: NDArray[Any], base_too: bool = False) -> float:
        self._robot.set_qpos(qpos.astype(np.float32))
        base = self._bodies[WORLD]
        links = (link for link, number in self._links.items() if base_too or self._bodies[number] != base)
        boxes = (link.compute_global_aabb_tight() for link in links if link.collision_shapes)
        return min((float(box[0, 2]) for box in boxes), default=np.inf)

    @_one_at_a_time
    def link_poses(self, qpos: NDArray[Any]) -> Float64:
        self._model.compute_forward_kinematics(np.asarray(qpos, np.float64))
        return np.array(
            [self._model.get_link_pose(link).to_transformation_matrix() for link in range(len(self._links))], np.float64
        )

    @_one_at_a_time
    def near_pairs(self, qpos: NDArray[Any]) -> list[NearPair]:
        """Return the pairs of shapes that the engine lists as near each other, at one pose (dof,)."""
        self._robot.set_qpos(qpos.astype(np.float32))
        self._robot.set_qvel(np.zeros(self._robot.dof, np.float32))
        self._system.step()
        pairs = []
        for contact in self._system.get_contacts():
            first, second = (self._links.get(body, WORLD) for body in contact.bodies)
            pairs.append(NearPair(first, second, min(point.separation for point in contact.points)))
        return pairs


_BASE = [(kind, axis) for kind in ("prismatic", "revolute") for axis in ("1 0 0", "0 1 0", "0 0 1")]
"""Types and axes of the joints of a floating base."""


def _on_joints(spec: SceneSpec) -> SceneSpec:
    """Return ``spec`` with its floating base on six joints in front of the others; their links weigh 1e-6 kg."""
    robot = ElementTree.fromstring(spec.urdf)
    children = {child.get("link") for child in robot.iter("child")}
    (root,) = [name for link in robot.iter("link") if (name := link.get("name")) not in children]
    links, joints = [*(f"batchpid_base{number}" for number in range(len(_BASE))), str(root)], []
    for (kind, axis), parent, child in zip(_BASE, links[:-1], links[1:], strict=True):
        joints.append(Joint(parent, kind, parent, child))
        ElementTree.SubElement(robot, "link", name=parent)
        joint = ElementTree.SubElement(robot, "joint", name=parent, type=kind)
        for tag, attributes in {
            "parent": {"link": parent},
            "child": {"link": child},
            "axis": {"xyz": axis},
            "limit": {"lower": "-9", "upper": "9"},
        }.items():
            ElementTree.SubElement(joint, tag, attributes)
    urdf = ElementTree.tostring(robot, encoding="unicode")
    return replace(spec, urdf=urdf, joints=(*joints, *spec.joints), fixed_base=True, build=None)


def _rowwise(compute: Any, *tables: NDArray[Any]) -> Float64:
    return np.array([compute(*row) for row in zip(*(np.asarray(table, np.float64) for table in tables), strict=True)])


@lru_cache(maxsize=8)
def scene_dynamics(spec: SceneSpec) -> Dynamics:
    """Return the dynamics of the robot of ``spec``, the same object for equal specs."""
    return Dynamics(spec)


def loaded_dynamics(robot: RobotDescription, payload: float) -> Dynamics:
    """Return the dynamics of ``robot`` on a fixed base with ``payload`` [kg] at the center of mass of its tool link."""
    kinematics = Kinematics(robot)
    spec = SceneSpec(
        robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"], merge_fixed=robot.merge_fixed
    )
    return Dynamics(replace(spec, ground=False), payload, kinematics.links[kinematics.tool])


def robot_dynamics(robot: RobotDescription, ground: bool | None = None) -> Dynamics:
    """Return the dynamics of ``robot`` on a fixed base, with or without a ground at height 0."""
    spec = SceneSpec(
        robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["fast"], merge_fixed=robot.merge_fixed
    )
    return scene_dynamics(replace(spec, ground=robot.has_ground if ground is None else ground))
