"""Scenes of one robot: the engine's settings, the robot from its URDF, its collision groups."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import sapien.wrapper.urdf_loader  # noqa: F401 - its packages suppress a Ctrl-C while they are imported: not amid a run
from sapien import physx
from sapien.wrapper.articulation_builder import ArticulationBuilder

from batchpid.errors import RobotError
from sim.engine.contact_prediction import LinkExtent
from sim.engine.physics import Physics
from sim.engine.user_content import Build, HeadlessScene
from sim.robot.description import DISSIPATION, Joint


@dataclass(frozen=True)
class SceneSpec:
    """Everything that a scene is built from, picklable.

    ``urdf`` is sanitised text (see :mod:`sim.robot.urdf`); ``joints`` are the degrees of freedom in SAPIEN's order.
    Specs that differ in ``build`` alone are equal.
    """

    urdf: str
    srdf: str | None
    joints: tuple[Joint, ...]
    timestep: float
    physics: Physics
    dissipation: str = "urdf"
    ground: bool = True
    fixed_base: bool = True
    build: Build | None = field(default=None, compare=False)
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)


@lru_cache(maxsize=8)
def parse(spec: SceneSpec) -> ArticulationBuilder:
    """Return a builder that makes any number of copies of the robot, the same object for equal specs.

    Raises
    ------
    RobotError
        SAPIEN's loader refuses the description, or finds other than one articulated robot in it.
    """
    loader = HeadlessScene().create_urdf_loader()
    loader.fix_root_link = spec.fixed_base
    with _in_memory(spec.urdf) as urdf, _in_memory(spec.srdf or "<robot/>") as srdf:
        try:
            builders, actors, _ = loader.parse(urdf, srdf)
        except Exception as error:
            raise RobotError(f"SAPIEN cannot load the robot: {error}; correct the URDF") from error
    if len(builders) != 1 or actors:
        raise RobotError("the URDF does not describe one articulated robot; it needs at least one moving joint")
    _ignore_contacts_within_bodies(builders[0])
    return builders[0]


def rigid_bodies(builder: ArticulationBuilder) -> dict[str, str]:
    """Return the rigid body of each link: links joined by fixed joints are one, named after the first of them."""
    bodies: dict[str, str] = {}
    for link in builder.link_builders:
        fixed = link.parent is not None and link.joint_record.joint_type == "fixed"
        bodies[link.name] = bodies[link.parent.name] if fixed else link.name
    return bodies


def _ignore_contacts_within_bodies(builder: ArticulationBuilder) -> None:
    """Filter out contacts between links of one rigid body: they cannot move apart, and the solver would shake them.

    PhysX filters a parent and its child only, not a hand whose flange is a separate link. Shapes that share a bit of
    the third collision group never touch; each body gets one that no pair of the .srdf uses, as long as there are any.
    """
    bodies = rigid_bodies(builder)
    used = 0
    for link in builder.link_builders:
        used |= link.collision_groups[2]
    free = (1 << bit for bit in range(32) if not used >> bit & 1)
    for body in dict.fromkeys(bodies.values()):
        links = [link for link in builder.link_builders if bodies[link.name] == body]
        solid = [link for link in links if link.collision_records]
        if len(links) > 2 and len(solid) > 1:
            bit = next(free, 0)
            for link in solid:
                link.collision_groups[2] |= bit


@contextmanager
def _in_memory(text: str) -> Iterator[str]:
    """Provide ``text`` under a path, as SAPIEN's loader requires; the file is in memory and ends with the process."""
    with open(os.memfd_create("batchpid-text"), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield f"/proc/self/fd/{file.fileno()}"


@contextmanager
def engine_settings(spec: SceneSpec) -> Iterator[None]:
    """Apply ``spec`` to SAPIEN's process-wide settings, and restore the caller's at the end.

    Every setting is overwritten, so that a result does not depend on what the caller's process did before.
    """
    scene, body = physx.get_scene_config(), physx.get_body_config()
    shape, material = physx.get_shape_config(), physx.get_default_material()
    # Settings that are not given get SAPIEN's defaults.
    gravity = np.array(spec.gravity, np.float32)
    physx.set_scene_config(gravity=gravity, enable_tgs=spec.physics.solver == "TGS")
    physx.set_body_config(spec.physics.position_iterations, spec.physics.velocity_iterations, sleep_threshold=0.0)
    physx.set_shape_config()
    physx.set_default_material(0.3, 0.3, 0.1)
    try:
        yield
    finally:
        physx.set_scene_config(scene)
        physx.set_body_config(body)
        physx.set_shape_config(shape)
        physx.set_default_material(material.static_friction, material.dynamic_friction, material.restitution)


def new_system(spec: SceneSpec) -> Any:
    """Return a new PhysX system, which has the solver, gravity and time step of ``spec``."""
    with engine_settings(spec):
        system = physx.PhysxCpuSystem()
    system.timestep = spec.timestep
    return system


def build_scene(spec: SceneSpec, system: Any) -> tuple[HeadlessScene, Any]:
    """Return a new scene in ``system`` and the robot in it, with the ground and the dissipation of ``spec``.

    Raises
    ------
    RobotError
        SAPIEN cannot build a collision shape, which it would silently leave out, or numbers the joints in another order
        than ours.
    """
    scene, builder = HeadlessScene(system), parse(spec)
    with engine_settings(spec):
        robot = builder.set_scene(scene).build()
        builder.set_scene(None)  # the scene can be freed
        if spec.ground:
            scene.add_ground(0.0, render=False)
    asked = {link.name: link.collision_records for link in builder.link_builders}
    for link in robot.links:
        if len(link.collision_shapes) != len(records := asked[link.name]):
            files = ", ".join(record.filename for record in records if record.filename)
            remedy = "repair the file, or remove that <collision>"
            raise RobotError(f"link {link.name!r}: SAPIEN cannot build a collision shape from {files}; {remedy}")
    names, ours = [joint.name for joint in robot.active_joints], [joint.name for joint in spec.joints]
    if names != ours:
        raise RobotError(f"SAPIEN numbers the joints {names}, not {ours}; please report it, with the URDF")
    robot.set_sleep_threshold(0.0)
    dissipation = DISSIPATION[spec.dissipation]
    for link in robot.links:
        link.set_linear_damping(dissipation.link_damping)
        link.set_angular_damping(dissipation.link_damping)
    for built, joint in zip(robot.active_joints, spec.joints, strict=True):
        # SAPIEN parses <dynamics friction> and never applies it.
        built.set_friction(joint.friction if dissipation.joint_friction is None else dissipation.joint_friction)
    return scene, robot


def link_extents(robot: Any) -> list[LinkExtent]:
    """Return the extents of a robot's links, parents first."""
    dofs = {joint.name: dof for dof, joint in enumerate(robot.active_joints)}
    numbers = {link: number for number, link in enumerate(robot.links)}
    extents = []
    for link in robot.links:
        joint, slides = link.joint, link.joint.type == "prismatic"
        offset = np.linalg.norm(joint.pose_in_parent.p) + np.linalg.norm(joint.pose_in_child.p)
        if slides:
            offset += np.abs(np.clip(joint.limits, -10.0, 10.0)).max(initial=0.0)  # a rail may have no end
        radius = 0.0
        if link.collision_shapes:
            corners = np.abs(link.compute_global_aabb_tight() - link.entity_pose.p)
            radius = float(np.linalg.norm(corners.max(0)))
        parent = None if link.parent is None else numbers[link.parent]
        extents.append(LinkExtent(parent, dofs.get(joint.name), slides, float(offset), radius))
    return extents


def set_collision_group(scene: HeadlessScene, group: int) -> None:
    """Put every shape of ``scene`` into collision group ``group``: shapes of different groups never touch.

    PhysX's filter, as SAPIEN sets it up, compares the upper 16 bits of the fourth word.
    """
    for entity in scene.entities:
        for component in entity.components:
            if isinstance(component, physx.PhysxRigidBaseComponent):
                for shape in component.collision_shapes:
                    words = list(shape.get_collision_groups())
                    words[3] = (words[3] & 0xFFFF) | (group << 16)
                    shape.set_collision_groups(words)
