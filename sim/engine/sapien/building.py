"""Scenes of one robot: the engine's settings, the robot from its URDF, its collision groups, its
tree in PhysX.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from threading import RLock
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sapien import Pose, physx
from sapien.wrapper.articulation_builder import ArticulationBuilder

from batchpid.arrays.array_types import Document, Float64
from batchpid.errors import RobotError
from batchpid.sim.engine.sapien.user_content import Frames, HeadlessScene
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.collision_groups import link_groups
from batchpid.sim.robot.merging import place_links
from batchpid.sim.robot.meshes import note_meshes
from batchpid.sim.robot.parts import CONTACT_FRICTION, DISSIPATION
from batchpid.sim.robot.simulated_links import simulated
from batchpid.task_space.frames import matrix_of
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.rotations import from_rpy
from batchpid.task_space.spatial_inertia import SpatialInertia


class LazyModule(ModuleType):
    """Module that is imported at the first use of a name in it."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:  # within the block
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


@contextmanager
def imported_lazily(name: str) -> Iterator[None]:
    """Give a :class:`LazyModule` to modules that import the package ``name`` within the block."""
    if name in sys.modules:
        yield
        return
    sys.modules[name] = lazy = LazyModule(name)
    try:
        yield
    finally:
        if sys.modules.get(name) is lazy:
            del sys.modules[name]


FASTEST = 1000.0
"""Largest speed of links and joints [m/s or rad/s]. PhysX's defaults stop links at 10 m/s and 50
rad/s, and joints at 100 rad/s. Without a limit, a robot that starts deep in a contact diverges.
"""
RESTITUTION = 0.1
"""Coefficient of restitution of SAPIEN's default material."""
_building = RLock()
"""Lock of the thread that builds a robot: SAPIEN's settings are process-wide, and builders are
shared.
"""

with imported_lazily(
    "trimesh"
):  # for meshes that are not loaded here: two fifths of the start of a worker
    # Its packages suppress Ctrl-C during their import, so they are imported before a run.
    import sapien.wrapper.urdf_loader  # noqa: F401


@lru_cache(maxsize=8)
def parse(spec: SceneSpec) -> ArticulationBuilder:
    """Return a builder that makes any number of copies of the robot, the same object for equal
    specs.

    Raises RobotError if SAPIEN's loader refuses the description, or finds other than one
    articulated robot in it.
    """
    with _building:
        builder = _load(simulated(spec.urdf, spec.separate).urdf, spec.fixed_base)
        if not spec.collisions:
            for link in builder.link_builders:
                link.collision_records = []
        return builder


def set_inertia(link: Any, inertia: SpatialInertia) -> None:
    """Give one of SAPIEN's links this inertia, in the frame of the link."""
    principal, axes = np.linalg.eigh(inertia.tensor)
    at = np.eye(4)
    at[:3, :3], at[:3, 3] = (
        axes * np.linalg.det(axes),
        inertia.center,
    )  # a rotation, not a reflection
    link.set_mass(inertia.mass)
    link.set_cmass_local_pose(Pose(at))
    link.set_inertia(principal)


def shape_owners(spec: SceneSpec) -> dict[str, list[str]]:
    """Return the link of the URDF that owns each collision shape of each simulated link, in the
    engine's order.
    """
    if not spec.collisions:
        return {link.name: [] for link in parse(spec).link_builders}
    return simulated(spec.urdf, spec.separate).owners


def _load(urdf: str, fixed_base: bool) -> ArticulationBuilder:
    loader = HeadlessScene().create_urdf_loader()
    loader.fix_root_link = fixed_base
    with _in_memory(urdf) as urdf_path, _in_memory("<robot/>") as srdf_path:
        try:
            builders, actors, _ = loader.parse(urdf_path, srdf_path)
        except Exception as error:
            raise RobotError(f"SAPIEN cannot load the robot: {error}; correct the URDF") from error
    if len(builders) != 1 or actors:
        raise RobotError(
            "the URDF does not describe one articulated robot; it needs at least one moving joint"
        )
    records = (record for link in builders[0].link_builders for record in link.collision_records)
    note_meshes(record.filename for record in records if record.filename)
    return builders[0]


@contextmanager
def _in_memory(text: str) -> Iterator[str]:
    """Provide ``text`` under a path, which SAPIEN's loader requires: an in-memory file, gone after
    the block.
    """
    with open(os.memfd_create("batchpid-text"), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield f"/proc/self/fd/{file.fileno()}"


@contextmanager
def engine_settings(spec: SceneSpec) -> Iterator[None]:
    """Apply ``spec`` to SAPIEN's process-wide settings, and restore the caller's at the end.

    Every setting is overwritten, so that results do not depend on earlier settings of the process.
    Only one thread at a time enters the context.
    """
    with _building:
        yield from _engine_settings(spec)


def _engine_settings(spec: SceneSpec) -> Iterator[None]:
    scene, body = physx.get_scene_config(), physx.get_body_config()
    shape, material = physx.get_shape_config(), physx.get_default_material()
    # Settings that are not given get SAPIEN's defaults.
    gravity = np.array(spec.gravity, np.float32)
    physx.set_scene_config(gravity=gravity, enable_tgs=spec.physics.solver == "TGS")
    physx.set_body_config(
        spec.physics.position_iterations, spec.physics.velocity_iterations, sleep_threshold=0.0
    )
    physx.set_shape_config()
    physx.set_default_material(CONTACT_FRICTION, CONTACT_FRICTION, RESTITUTION)
    try:
        yield
    finally:
        physx.set_scene_config(scene)
        physx.set_body_config(body)
        physx.set_shape_config(shape)
        physx.set_default_material(
            material.static_friction, material.dynamic_friction, material.restitution
        )


def new_system(spec: SceneSpec, gravity: NDArray[np.float64] | None = None) -> Any:
    """Return a new PhysX system, which has the solver and time step of ``spec``, and its or another
    gravity (3,).
    """
    with engine_settings(
        spec if gravity is None else replace(spec, gravity=tuple(gravity.tolist()))
    ):
        system = physx.PhysxCpuSystem()
    system.timestep = spec.timestep
    return system


def build_scene(spec: SceneSpec, system: Any) -> tuple[HeadlessScene, Any]:
    """Return a new scene in ``system`` and the robot in it, with the ground and the dissipation of
    ``spec``.

    Raises RobotError if SAPIEN cannot build a collision shape, which it would silently leave out,
    or numbers the joints in another order than ours.
    """
    scene, builder = HeadlessScene(system), parse(spec)
    with engine_settings(spec):
        robot = builder.set_scene(scene).build()
        builder.set_scene(None)  # the scene can be freed
        if spec.ground and spec.collisions:
            scene.add_ground(0.0, render=False)
    asked = {link.name: link.collision_records for link in builder.link_builders}
    for link in robot.links:
        if len(link.collision_shapes) != len(records := asked[link.name]):
            files = ", ".join(record.filename for record in records if record.filename)
            remedy = "repair the file, or remove that <collision>"
            raise RobotError(
                f"link {link.name!r}: SAPIEN cannot build a collision shape from {files}; {remedy}"
            )
    ignored = {frozenset(pair) for pair in spec.ignored}
    words, _ = link_groups(spec.urdf, spec.separate, spec.fixed_base, spec.joints, ignored)
    owners = shape_owners(spec)
    for link in robot.links:
        for shape, owner in zip(link.collision_shapes, owners[link.name], strict=True):
            shape.set_collision_groups(words[owner])
    names, ours = (
        [joint.name for joint in robot.active_joints],
        [joint.name for joint in spec.joints],
    )
    if names != ours:
        raise RobotError(
            f"SAPIEN numbers the joints {names}, not {ours}; please report it, with the URDF"
        )
    robot.set_sleep_threshold(0.0)
    dissipation = DISSIPATION[spec.dissipation]
    for link in robot.links:
        link.set_linear_damping(dissipation.link_damping)
        link.set_angular_damping(dissipation.link_damping)
        link.max_linear_velocity = link.max_angular_velocity = FASTEST
    for built, joint in zip(robot.active_joints, spec.joints, strict=True):
        if joint.mimic is not None and not joint.continuous:
            built.set_limits([[joint.lower, joint.upper]])  # the URDF's may keep it from following
        built.set_friction(dissipation.joint_friction)
        built.max_velocity = FASTEST
        if dissipation.modelled:
            # SAPIEN implements the URDF's damping as a drive, with an error that depends on the
            # solver; this is exact, with the effort of batchpid.motors.friction.
            built.set_drive_properties(0.0, 0.0)
            built.set_armature(np.array([spec.timestep * joint.damping], np.float32))
    return scene, robot


def link_frames(spec: SceneSpec, robot: Any) -> Frames:
    """Return all links of the URDF, in the entities of ``robot``, which is one of ``spec``."""
    entities = {link.name: link.entity for link in robot.links}
    return {
        name: (entities[at.link], None if at.link == name else Pose(at.position, at.wxyz))
        for name, at in place_links(spec.urdf, spec.separate).items()
    }


@lru_cache(maxsize=8)
def scene_tree(spec: SceneSpec) -> RigidTree:
    """Return the tree of the robot of ``spec``, all joints independent, the same object for equal
    specs.

    Before each link but the base comes a link without mass, "LINK (joint)", in the frame of the
    joint above.
    """
    _scene, robot = build_scene(spec, new_system(spec))
    rows: list[Document] = []
    at: dict[Any, int] = {}
    for link in robot.links:
        kind, turn = "fixed", np.diag([float(str(one)) for one in link.inertia])
        axes, center = _place(link.cmass_local_pose)
        inertia = {"mass": link.mass, "center": center, "inertia": axes @ turn @ axes.T}
        if link.parent is None:
            rows.append(_row(link.name, -1, "fixed", None) | inertia)
        else:
            kind = {"fixed": "fixed", "prismatic": "prismatic"}.get(link.joint.type, "revolute")
            rows.append(
                _row(f"{link.name} (joint)", at[link.parent], kind, link.joint.pose_in_parent)
            )
            rows.append(
                _row(link.name, len(rows) - 1, "fixed", link.joint.pose_in_child.inv()) | inertia
            )
        at[link] = len(rows) - 1
    columns: Document = {
        name: np.array([row[name] for row in rows])
        for name in rows[0]
        if name not in ("links", "joint_types")
    }
    names = tuple(joint.name for joint in spec.joints)
    links, kinds = (tuple(row[name] for row in rows) for name in ("links", "joint_types"))
    return RigidTree(
        links,
        joint_types=kinds,
        joint_names=names,
        **columns,
        gravity=spec.gravity,
        fixed_base=spec.fixed_base,
    )


def _row(name: str, parent: int, kind: str, pose: Any) -> Document:
    """Return a link without mass at one of SAPIEN's poses in its parent."""
    position, wxyz = (
        (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])) if pose is None else (pose.p, _wxyz(pose))
    )
    empty = {"mass": 0.0, "center": np.zeros(3), "inertia": np.zeros((3, 3))}
    place = {
        "position": np.asarray(position, float),
        "wxyz": wxyz,
        "axis": np.array([1.0, 0.0, 0.0]),
    }
    return {"links": name, "parent": parent, "joint_types": kind, **place, **empty}


def _place(pose: Any) -> tuple[Float64, Float64]:
    """Return axes (3, 3) and position (3,) of one of SAPIEN's poses."""
    return matrix_of(_wxyz(pose)), np.asarray(pose.p, float)


def _wxyz(pose: Any) -> Float64:
    """Return the rotation of one of SAPIEN's poses, by roll, pitch and yaw, as SAPIEN's own
    dynamics take it.
    """
    return from_rpy(np.asarray(pose.rpy, float))
