"""Scenes of one robot: the engine's settings, the robot from its URDF, its collision groups."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from itertools import combinations
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sapien import Pose, physx
from sapien.wrapper.articulation_builder import ArticulationBuilder

from batchpid.errors import RobotError
from batchpid.sim.engine.lazy_module import imported_lazily
from batchpid.sim.engine.sapien.collision_groups import CollisionGroups, Pair, collision_groups
from batchpid.sim.engine.sapien.user_content import Frames, HeadlessScene
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.dissipation import DISSIPATION
from batchpid.sim.robot.merging import Merged, merge_fixed_links, place_links
from batchpid.sim.robot.meshes import note_meshes
from batchpid.task_space.spatial_inertia import SpatialInertia, total

_building = RLock()
"""Lock of the thread that builds a robot: SAPIEN's settings are process-wide, and builders are shared."""

with imported_lazily("trimesh"):  # for meshes that are not loaded here: two fifths of the start of a worker
    # Its packages suppress Ctrl-C during their import, so they are imported before a run.
    import sapien.wrapper.urdf_loader  # noqa: F401


@lru_cache(maxsize=8)
def parse(spec: SceneSpec) -> ArticulationBuilder:
    """Return a builder that makes any number of copies of the robot, the same object for equal specs.

    Raises RobotError if SAPIEN's loader refuses the description, or finds other than one articulated robot in it.
    """
    with _building:
        builder = _load(merged(spec).urdf if spec.merge_fixed else spec.urdf, spec.fixed_base)
        if not spec.collisions:
            for link in builder.link_builders:
                if link._auto_inertial:  # a link without <inertial> has the inertia of its shapes
                    shaped = link.build_physx_component()
                    link.set_mass_and_inertia(shaped.mass, shaped.cmass_local_pose, shaped.inertia)
                link.collision_records = []
        return builder


@lru_cache(maxsize=8)
def merged(spec: SceneSpec) -> Merged:
    """Return the robot of ``spec`` with its fixed joints merged, the same object for equal specs."""

    @cache
    def unmerged() -> dict[str, Any]:
        return unmerged_links(spec.urdf, spec.fixed_base)

    def inertia_of_shapes(link: str) -> SpatialInertia:
        return link_inertia(unmerged()[link].build_physx_component())

    with _building:
        return merge_fixed_links(spec.urdf, inertia_of_shapes)


def unmerged_links(urdf: str, fixed_base: bool) -> dict[str, Any]:
    """Return SAPIEN's builder of every link of a sanitised URDF, by name, fixed joints not merged."""
    return {link.name: link for link in _load(urdf, fixed_base).link_builders}


def center_of_mass(spec: SceneSpec, link: str) -> tuple[str, NDArray[np.float64]]:
    """Return the simulated link that a link of the URDF is part of, and the center of mass of the latter in its frame.

    That of a link without mass is its origin.
    """
    at, inertia = place_links(spec.urdf, spec.merge_fixed)[link], merged(spec).inertias.get(link)
    return at.link, at.position if inertia is None else inertia.moved(at.position, at.wxyz).center


def add_point_mass(link: Any, mass: float, position: NDArray[np.float64]) -> None:
    """Add ``mass`` [kg] at ``position`` (3,) [m] in the frame of one of SAPIEN's links."""
    set_inertia(link, total([link_inertia(link), SpatialInertia(mass, position, np.zeros((3, 3)))]))


def set_inertia(link: Any, inertia: SpatialInertia) -> None:
    """Give one of SAPIEN's links this inertia, in the frame of the link."""
    principal, axes = np.linalg.eigh(inertia.tensor)
    at = np.eye(4)
    at[:3, :3], at[:3, 3] = axes * np.linalg.det(axes), inertia.center  # a rotation, not a reflection
    link.set_mass(inertia.mass)
    link.set_cmass_local_pose(Pose(at))
    link.set_inertia(principal)


@lru_cache(maxsize=8)
def link_groups(spec: SceneSpec) -> CollisionGroups:
    """Return the words by which PhysX ignores the pairs of ``spec``, for each link of the URDF that has shapes.

    Links of one rigid body are ignored, too: they cannot move apart, and the solver would shake them. PhysX ignores
    contacts within a simulated link, and with its parent, unless that is the root of a fixed base.
    """
    builder = parse(spec)
    simulated = {name: at.link for name, at in place_links(spec.urdf, spec.merge_fixed).items()}
    bodies = {name: rigid_bodies(builder)[link] for name, link in simulated.items()}
    root = builder.link_builders[0].name if spec.fixed_base else None
    joined = [(simulated[joint.parent_link], simulated[joint.child_link]) for joint in spec.joints]
    neighbours = {frozenset(pair) for pair in joined if root not in pair}
    links = list(dict.fromkeys(owner for owners in shape_owners(spec).values() for owner in owners))
    ignored, free = {frozenset(pair) for pair in spec.ignored}, set[Pair]()
    for first, second in combinations(links, 2):
        pair = frozenset((simulated[first], simulated[second]))
        if len(pair) == 1 or pair in neighbours:
            free.add(frozenset((first, second)))
        elif bodies[first] == bodies[second]:
            ignored.add(frozenset((first, second)))
    return collision_groups(links, {pair for pair in ignored if pair <= set(links)} - free, free)


def shape_owners(spec: SceneSpec) -> dict[str, list[str]]:
    """Return the link of the URDF that owns each collision shape of each simulated link, in the engine's order."""
    if not spec.collisions:
        return {link.name: [] for link in parse(spec).link_builders}
    if spec.merge_fixed:
        return merged(spec).owners
    return {link.name: [link.name] * len(link.collision_records) for link in parse(spec).link_builders}


def link_inertia(link: Any) -> SpatialInertia:
    """Return the inertia of one of SAPIEN's links, in the link's frame."""
    at, principal = link.cmass_local_pose, np.diag(np.asarray(link.inertia, float))
    return SpatialInertia(link.mass, np.zeros(3), principal).moved(np.asarray(at.p, float), np.asarray(at.q, float))


def _load(urdf: str, fixed_base: bool) -> ArticulationBuilder:
    loader = HeadlessScene().create_urdf_loader()
    loader.fix_root_link = fixed_base
    with _in_memory(urdf) as urdf_path, _in_memory("<robot/>") as srdf_path:
        try:
            builders, actors, _ = loader.parse(urdf_path, srdf_path)
        except Exception as error:
            raise RobotError(f"SAPIEN cannot load the robot: {error}; correct the URDF") from error
    if len(builders) != 1 or actors:
        raise RobotError("the URDF does not describe one articulated robot; it needs at least one moving joint")
    records = (record for link in builders[0].link_builders for record in link.collision_records)
    note_meshes(record.filename for record in records if record.filename)
    return builders[0]


def rigid_bodies(builder: ArticulationBuilder) -> dict[str, str]:
    """Return the rigid body of each link: links joined by fixed joints are one, named after the first of them."""
    bodies: dict[str, str] = {}
    for link in builder.link_builders:
        fixed = link.parent is not None and link.joint_record.joint_type == "fixed"
        bodies[link.name] = bodies[link.parent.name] if fixed else link.name
    return bodies


@contextmanager
def _in_memory(text: str) -> Iterator[str]:
    """Provide ``text`` under a path, which SAPIEN's loader requires: an in-memory file, gone after the block."""
    with open(os.memfd_create("batchpid-text"), "w", encoding="utf-8") as file:
        try:
            file.write(text)
            file.flush()
        except OSError as error:
            size, remedy = len(text), "raise the limit of file sizes (ulimit -f)"
            raise RobotError(
                f"the URDF of {size} bytes cannot be kept in memory: {error.strerror}; {remedy}"
            ) from error
        yield f"/proc/self/fd/{file.fileno()}"


@contextmanager
def engine_settings(spec: SceneSpec) -> Iterator[None]:
    """Apply ``spec`` to SAPIEN's process-wide settings, and restore the caller's at the end.

    Every setting is overwritten, so that results do not depend on earlier settings of the process. Only one thread at a
    time enters the context.
    """
    with _building:
        yield from _engine_settings(spec)


def _engine_settings(spec: SceneSpec) -> Iterator[None]:
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

    Raises RobotError if SAPIEN cannot build a collision shape, which it would silently leave out, or numbers the joints
    in another order than ours.
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
            raise RobotError(f"link {link.name!r}: SAPIEN cannot build a collision shape from {files}; {remedy}")
    words, owners = link_groups(spec).words, shape_owners(spec)
    for link in robot.links:
        for shape, owner in zip(link.collision_shapes, owners[link.name], strict=True):
            shape.set_collision_groups(words[owner])
    names, ours = [joint.name for joint in robot.active_joints], [joint.name for joint in spec.joints]
    if names != ours:
        raise RobotError(f"SAPIEN numbers the joints {names}, not {ours}; please report it, with the URDF")
    robot.set_sleep_threshold(0.0)
    dissipation = DISSIPATION[spec.dissipation]
    for link in robot.links:
        link.set_linear_damping(dissipation.link_damping)
        link.set_angular_damping(dissipation.link_damping)
    for built, joint in zip(robot.active_joints, spec.joints, strict=True):
        if joint.mimic is not None and not joint.continuous:
            built.set_limits([[joint.lower, joint.upper]])  # the URDF's may keep it from following
        built.set_friction(dissipation.joint_friction)
        if dissipation.modelled:
            # SAPIEN implements the URDF's damping as a drive, with an error that depends on the solver; this is exact,
            # with the effort of batchpid.motors.friction.
            built.set_drive_properties(0.0, 0.0)
            built.set_armature(np.array([spec.timestep * joint.damping], np.float32))
    return scene, robot


def link_frames(spec: SceneSpec, robot: Any) -> Frames:
    """Return all links of the URDF, in the entities of ``robot``, which is one of ``spec``."""
    entities = {link.name: link.entity for link in robot.links}
    return {
        name: (entities[at.link], None if at.link == name else Pose(at.position, at.wxyz))
        for name, at in place_links(spec.urdf, spec.merge_fixed).items()
    }
