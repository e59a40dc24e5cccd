"""Scenes that need no render device, and the content that the user's ``build`` function adds to
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import sapien
from sapien.physx import (
    PhysxArticulation,
    PhysxArticulationJoint,
    PhysxArticulationLinkComponent,
    PhysxCollisionShapeConvexMesh,
    PhysxCpuSystem,
    PhysxMaterial,
    PhysxRigidDynamicComponent,
    PhysxRigidStaticComponent,
)
from sapien.wrapper.actor_builder import ActorBuilder
from sapien.wrapper.articulation_builder import ArticulationBuilder

from batchpid.arrays.array_types import Document, Float32
from batchpid.arrays.trees import digest
from batchpid.errors import InvalidArgumentError
from batchpid.sim.engine.scene_spec import Build, SceneSpec

Frames = Mapping[str, tuple[sapien.Entity, sapien.Pose | None]]
"""Entity of each link of a robot, by name, and the pose of the link in it; None for the same frame.
"""


_STATE = (
    "entity_pose",
    "linear_velocity",
    "angular_velocity",
    "sleeping",
    "is_sleeping",
    "children",
)
"""Properties that a snapshot holds, or that follow from others."""
_PLAIN_TYPES = (bool, int, float, str, tuple, list, dict, np.ndarray)


class _HeadlessBuilder(ActorBuilder):
    """Actor builder whose ``add_*_visual`` methods do nothing: a visual would need a render
    device.
    """


class HeadlessScene(sapien.Scene):
    """Scene in ``system``, or in a new PhysX system under the present settings, that needs no
    render device.

    Visuals and lights are left out, so that code written for a screen runs.
    """

    def __init__(self, system: PhysxCpuSystem | None = None) -> None:
        # Without a list of systems SAPIEN builds a render system, which fails without a device, or
        # ends the process.
        super().__init__([PhysxCpuSystem() if system is None else system])

    def create_articulation_builder(self) -> ArticulationBuilder:
        """Return a builder of articulations for this scene."""
        return ArticulationBuilder().set_scene(self)

    def create_actor_builder(self) -> ActorBuilder:
        """Return a builder of actors for this scene."""
        return _HeadlessBuilder().set_scene(self)


for _name in dir(ActorBuilder):
    if _name.startswith("add_") and "visual" in _name:
        setattr(_HeadlessBuilder, _name, lambda self, *_, **__: self)
for _name in dir(sapien.Scene):
    if _name.startswith(("add_", "set_")) and any(
        word in _name for word in ("light", "environment_map")
    ):
        setattr(HeadlessScene, _name, lambda self, *_, **__: None)


class SceneContent:
    """Content that ``build`` added to the scene of env ``env``.

    ``watched`` are the entities that ``build`` returned, each with the pose of a frame in it or
    None; ``size`` is the number of values in the state. ``links`` are the links of the scene's
    robot.
    """

    def __init__(
        self,
        spec: SceneSpec,
        build: Build,
        scene: HeadlessScene,
        env: int,
        links: Frames,
    ) -> None:
        # What exists now is the robot and the ground; the rest is the user's.
        before = {entity.per_scene_id for entity in scene.entities}
        self.watched = _call(build, scene, env, links)
        _check_shapes(scene, env, spec.collisions)
        self._bodies = []
        self._articulations = []
        parts = []
        for entity in scene.entities:
            if entity.per_scene_id in before:
                continue
            for component in entity.components:
                parts.append(_describe(component))
                if isinstance(component, PhysxRigidDynamicComponent):
                    self._bodies.append((entity, component))
                elif isinstance(component, PhysxArticulationLinkComponent) and component.is_root:
                    self._articulations.append(component.articulation)
        self.digest = int.from_bytes(bytes.fromhex(digest(parts))[:7], "big")
        """Number that tells this content from another, whose properties differ."""
        self._start = self.read()
        self.size = self._start.size

    def reset(self) -> None:
        """Put everything that moves into the state in which ``build`` left it."""
        self.write(self._start)

    def read(self) -> Float32:
        """Return the state of everything that moves (size,)."""
        parts: list[Any] = [np.zeros(0, np.float32)]
        for entity, body in self._bodies:
            pose = entity.get_pose()
            parts += [pose.p, pose.q, body.get_linear_velocity(), body.get_angular_velocity()]
        for robot in self._articulations:
            parts += [read_root(robot), robot.get_qpos(), robot.get_qvel(), robot.get_qf()]
        return np.concatenate(parts, dtype=np.float32)

    def write(self, state: Float32) -> None:
        """Put everything that moves into the state that :meth:`read` returned; values beyond
        ``size`` are ignored.
        """
        values = iter(np.asarray(state, np.float32))

        def take(count: int) -> Float32:
            return np.fromiter(values, np.float32, count)

        for entity, body in self._bodies:
            entity.set_pose(sapien.Pose(take(3), take(4)))
            linear = take(3)
            angular = take(3)
            # PhysX refuses velocities of kinematic bodies.
            if not body.kinematic:
                body.set_linear_velocity(linear)
                body.set_angular_velocity(angular)
        for robot in self._articulations:
            write_root(robot, take(ROOT_SIZE))
            robot.set_qpos(take(robot.dof))
            robot.set_qvel(take(robot.dof))
            robot.set_qf(take(robot.dof))

    def poses(self) -> Float32:
        """Return the poses of the watched entities (watched, 7): x, y, z [m] and the quaternion w,
        x, y, z.
        """
        frames = [(entity.get_pose(), frame) for entity, frame in self.watched]
        poses = [pose if frame is None else pose * frame for pose, frame in frames]
        rows = [np.concatenate([pose.p, pose.q]) for pose in poses]
        return np.array(rows, np.float32).reshape(len(rows), 7)


def _describe(part: object) -> Document:
    """Return the properties of a component, a shape or a material, all that are plain values, by
    name; not those that its state changes.
    """
    properties: Document = {"type": type(part).__name__}
    for name in dir(part):
        is_state = name in _STATE and not isinstance(part, PhysxRigidStaticComponent)
        # ``pose`` is the deprecated name of ``entity_pose``.
        if name.startswith("_") or is_state or "gpu" in name or name == "pose":
            continue
        try:
            value = getattr(part, name)
        except (RuntimeError, SystemError):  # a property of another kind of body
            continue
        if isinstance(value, sapien.Pose):
            value = value.p, value.q
        elif isinstance(value, PhysxMaterial | PhysxArticulationJoint):
            value = _describe(value)
        elif name == "collision_shapes":
            value = [_describe(shape) for shape in value]
        if isinstance(value, _PLAIN_TYPES):
            properties[name] = value
    return properties


def _check_shapes(scene: HeadlessScene, env: int, collisions: bool) -> None:
    """Raise InvalidArgumentError if an entity of ``scene``, which belongs to env ``env``, has a
    collision shape without ``collisions``, or a convex mesh of negative scale.
    """
    for entity in scene.entities:
        for component in entity.components:
            for shape in getattr(component, "collision_shapes", ()):
                if not collisions:
                    raise InvalidArgumentError(
                        "build",
                        f"added collision shapes (to {entity.name!r}), and collisions are False",
                        env=env,
                        remedy="leave them out, or use collisions=True",
                    )
                # Two of them end the process once they touch.
                if isinstance(shape, PhysxCollisionShapeConvexMesh) and min(shape.scale) < 0:
                    problem = f"gave {entity.name!r} a convex mesh of negative scale"
                    remedy = "mirror the vertices in the file"
                    raise InvalidArgumentError("build", problem, env=env, remedy=remedy)


def _call(
    build: Build,
    scene: HeadlessScene,
    env: int,
    links: Frames,
) -> list[tuple[sapien.Entity, sapien.Pose | None]]:
    """Return the entities and frames that ``build`` returns; its errors become an
    InvalidArgumentError.
    """
    try:
        returned = build(scene, env)
    except Exception as error:
        problem = f"raised {type(error).__name__}: {error}"
        remedy = "correct the function; try it with workers=0 for the traceback"
        raise InvalidArgumentError("build", problem, env=env, remedy=remedy) from error
    if returned is None:
        return []
    several = isinstance(returned, Iterable) and not isinstance(returned, str)
    watched = []
    for item in returned if several else [returned]:
        if isinstance(item, str) and item in links:
            watched.append(links[item])
        elif isinstance(item, sapien.Entity):
            watched.append((item, None))
        else:
            raise InvalidArgumentError(
                "build",
                "returned something other than entities and names of the robot's links",
                env=env,
                value=item if isinstance(item, str) else type(item).__name__,
                remedy="return the entities and links for runner.poses(), or None",
            )
    return watched


ROOT_SIZE = 13


def read_root(articulation: PhysxArticulation) -> Float32:
    """Return the state of the root link of a SAPIEN articulation (13,)."""
    pose = articulation.get_root_pose()
    velocity = articulation.get_root_linear_velocity(), articulation.get_root_angular_velocity()
    return np.concatenate([pose.p, pose.q, *velocity], dtype=np.float32)


def write_root(articulation: PhysxArticulation, state: Float32) -> None:
    """Set the state of the root link of a SAPIEN articulation (13,)."""
    articulation.set_root_pose(sapien.Pose(state[:3], state[3:7]))
    articulation.set_root_linear_velocity(state[7:10])
    articulation.set_root_angular_velocity(state[10:])
