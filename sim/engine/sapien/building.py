"""Scenes of one robot: the engine's settings, the robot from its tables, its collision groups, its
tree in PhysX.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from threading import RLock
from typing import Any

import numpy as np
from sapien import Pose, physx
from sapien.wrapper.articulation_builder import ArticulationBuilder

from batchpid.arrays.array_types import Float64
from batchpid.errors import RobotError
from batchpid.sim.description.merging import body_tree
from batchpid.sim.description.tables import CONTACT_FRICTION, Body, Tables
from batchpid.sim.engine.sapien.limits import filter_words
from batchpid.sim.engine.sapien.user_content import HeadlessScene
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.geometry.shapes import Shape, hull
from batchpid.task_space.frames import SpatialInertia, from_rpy, matrix_of
from batchpid.task_space.rigid_tree import RigidTree

SAPIEN_DISSIPATION = 0.05
"""SAPIEN 3's default of the friction of joints, and of the damping of links [1/s]."""
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

_JOINT_TYPES = {
    "fixed": "fixed",
    "revolute": "revolute_unwrapped",
    "continuous": "revolute",
    "prismatic": "prismatic",
}
"""SAPIEN's types of joints; "undefined" is that of a root that floats."""
_ALONG_Z = Pose(q=[0.7071068, 0.0, 0.7071068, 0.0])
"""Pose of SAPIEN's capsules and cylinders, which lie along x, in a shape along z."""


@lru_cache(maxsize=8)
def articulation_builder(spec: SceneSpec) -> ArticulationBuilder:
    """Return a builder that makes any number of copies of the robot, the same object for equal
    specs.
    """
    builder = ArticulationBuilder()
    tables = spec.simulated
    links: dict[str, Any] = {}
    for body in tables.bodies:
        joint = body.joint
        if joint is None:
            parent = None
        else:
            parent = links[joint.parent_link]
        links[body.name] = link = builder.create_link_builder(parent)
        link.set_name(body.name)
        moments, axes = _principal(body.inertia)
        frame = _pose(body.center, matrix_of(body.inertia_wxyz))
        link.set_mass_and_inertia(body.mass, frame * _pose(np.zeros(3), axes), moments)
        if joint is None:
            kind = "fixed" if spec.fixed_base else "undefined"
            link.set_joint_properties(kind, [], Pose(), Pose())
            continue
        link.set_joint_name(joint.name)
        limits = [joint.lower, joint.upper] if joint.moves else []
        # SAPIEN's joints turn about x.
        turn = _pose(np.zeros(3), _axes_along(joint.axis))
        link.set_joint_properties(
            _JOINT_TYPES[joint.type],
            limits,
            _pose(body.position, matrix_of(body.wxyz)) * turn,
            turn,
            damping=joint.damping,
        )
    return builder


def _collision_shape(shape: Shape) -> physx.PhysxCollisionShape:
    """Return SAPIEN's object for a shape. Raises RobotError for a mesh that PhysX refuses."""
    material = physx.PhysxMaterial(CONTACT_FRICTION, CONTACT_FRICTION, RESTITUTION)
    place = _pose(shape.position, matrix_of(shape.wxyz))
    size = shape.size
    built: physx.PhysxCollisionShape
    if shape.kind == "box":
        built = physx.PhysxCollisionShapeBox(np.array(size, np.float32), material)
    elif shape.kind == "sphere":
        built = physx.PhysxCollisionShapeSphere(*size, material)
    elif shape.kind == "capsule":
        built = physx.PhysxCollisionShapeCapsule(*size, material)
    elif shape.kind == "cylinder":
        built = physx.PhysxCollisionShapeCylinder(*size, material)
    else:
        try:
            built = physx.PhysxCollisionShapeConvexMesh(hull(shape), np.ones(3), material)
        except RuntimeError as error:
            problem = f"link {shape.owner!r}: PhysX cannot build a collision shape"
            remedy = "repair the file, or remove that <collision>"
            raise RobotError(f"{problem} from {shape.file}: {error}; {remedy}") from error
    if shape.kind in ("capsule", "cylinder"):
        place = place * _ALONG_Z
    built.set_local_pose(place)
    return built


def _pose(position: Float64, axes: Float64) -> Pose:
    """Return SAPIEN's pose by a matrix, which it rounds as its loader of URDFs does, unlike a
    quaternion.
    """
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, position
    return Pose(matrix)


def _axes_along(axis: tuple[float, ...]) -> Float64:
    """Return axes (3, 3), as columns, of which the first is that of a joint."""
    first = np.array(axis) / np.linalg.norm(axis)
    second = np.cross(first, [0, 0, 1] if abs(first[0]) > 0.9 else [1, 0, 0])
    second /= np.linalg.norm(second)
    return np.column_stack([first, second, np.cross(first, second)])


def _principal(inertia: Float64) -> tuple[Float64, Float64]:
    """Return the principal moments (3,) and axes (3, 3), those of the frame if they are
    principal.
    """
    moments = np.diag(inertia)
    axes = np.eye(3)
    if not np.array_equal(np.diag(moments), inertia):
        moments, axes = np.linalg.eigh(inertia)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
    return moments, axes


def set_inertia(link: physx.PhysxArticulationLinkComponent, inertia: SpatialInertia) -> None:
    """Give one of SAPIEN's links this inertia, in the frame of the link."""
    moments, axes = inertia.principal
    link.set_mass(inertia.mass)
    link.set_cmass_local_pose(_pose(inertia.center, axes))
    link.set_inertia(moments)


@contextmanager
def engine_settings(spec: SceneSpec) -> Iterator[None]:
    """Apply ``spec`` to SAPIEN's process-wide settings, and restore the caller's at the end.

    Every setting is overwritten, so that results do not depend on earlier settings of the process.
    Only one thread at a time enters the context.
    """
    with _building:
        scene = physx.get_scene_config()
        body = physx.get_body_config()
        shape = physx.get_shape_config()
        material = physx.get_default_material()
        solver = spec.physics
        # Settings that are not given get SAPIEN's defaults.
        gravity = np.array(spec.gravity, np.float32)
        physx.set_scene_config(gravity=gravity, enable_tgs=solver.solver == "TGS")
        physx.set_body_config(
            solver.position_iterations, solver.velocity_iterations, sleep_threshold=0.0
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


def new_system(spec: SceneSpec) -> physx.PhysxCpuSystem:
    """Return a new PhysX system with the solver, time step and gravity of ``spec``."""
    with engine_settings(spec):
        system = physx.PhysxCpuSystem()
    system.timestep = spec.timestep
    return system


def build_scene(
    spec: SceneSpec, system: physx.PhysxCpuSystem
) -> tuple[HeadlessScene, physx.PhysxArticulation]:
    """Return a new scene in ``system`` and the robot in it, with the ground and the dissipation of
    ``spec``.

    Raises RobotError if SAPIEN cannot build a collision shape.
    """
    scene = HeadlessScene(system)
    with engine_settings(spec):
        builder = articulation_builder(spec)
        robot = builder.set_scene(scene).build()
        builder.set_scene(None)  # the scene can be freed
        _add_shapes(spec, robot)
        if spec.ground and spec.collisions:
            scene.add_ground(0.0, render=False)
    robot.set_sleep_threshold(0.0)
    dissipation = SAPIEN_DISSIPATION if spec.dissipation == "sapien" else 0.0
    for link in robot.links:
        link.set_linear_damping(dissipation)
        link.set_angular_damping(dissipation)
        link.max_linear_velocity = link.max_angular_velocity = FASTEST
    for built, joint in zip(robot.active_joints, spec.joints, strict=True):
        if joint.mimic is not None and not joint.continuous:
            built.set_limits([[joint.lower, joint.upper]])  # the URDF's may keep it from following
        built.set_friction(dissipation)
        built.max_velocity = FASTEST
        if spec.dissipation == "urdf":
            # SAPIEN implements the URDF's damping as a drive, with an error that depends on the
            # solver; this is exact, with the effort of batchpid.motors.friction.
            built.set_drive_properties(0.0, 0.0)
            built.set_armature(np.array([spec.timestep * joint.damping], np.float32))
    return scene, robot


def _add_shapes(spec: SceneSpec, robot: physx.PhysxArticulation) -> None:
    """Give the links of a robot their collision shapes, with filter words."""
    words, _ = filter_words(spec)
    links = {link.name: link for link in robot.links}
    for shape in spec.simulated.shapes if spec.collisions else ():
        built = _collision_shape(shape)
        built.set_collision_groups(words[shape.owner])
        links[shape.body].attach(built)


@lru_cache(maxsize=8)
def rounded_tree(spec: SceneSpec) -> RigidTree:
    """Return the tree of the robot of ``spec`` as PhysX rounds it, all joints independent, the same
    object for equal specs.

    Before each link but the base comes a link without mass, "LINK (joint)", in the frame of the
    joint above.
    """
    _scene, robot = build_scene(spec, new_system(spec))
    links = {link.name: link for link in robot.links}
    rows = []
    for body in spec.simulated.bodies:
        link = links[body.name]
        place = link.cmass_local_pose
        axes = matrix_of(_wxyz(place))
        moments = np.diag([float(str(moment)) for moment in link.inertia])
        row = Body(body.name, None, mass=link.mass, center=np.asarray(place.p, float))
        row = row._replace(inertia=axes @ moments @ axes.T)
        if body.joint is not None:
            # SAPIEN's joint has a frame in the parent and one in the child: the link between has the first.
            above = f"{body.name} (joint)"
            moving = replace(body.joint, axis=(1.0, 0.0, 0.0))
            rows.append(_placed(Body(above, moving), link.joint.pose_in_parent))
            fixed = replace(body.joint, type="fixed", parent_link=above)
            row = _placed(row._replace(joint=fixed), link.joint.pose_in_child.inv())
        rows.append(row)
    return body_tree(Tables(tuple(rows), (), {}), spec.fixed_base, spec.gravity)


def _placed(row: Body, pose: Pose) -> Body:
    """Return a body at one of SAPIEN's poses in its parent."""
    return row._replace(position=np.asarray(pose.p, float), wxyz=_wxyz(pose))


def _wxyz(pose: Pose) -> Float64:
    """Return the rotation of one of SAPIEN's poses, by roll, pitch and yaw, as SAPIEN's own
    dynamics take it.
    """
    return from_rpy(np.asarray(pose.rpy, float))
