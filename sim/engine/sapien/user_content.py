"""Scenes that need no render device, and the content that the user's ``build`` function adds to
them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import sapien
from sapien.physx import (
    PhysxArticulation,
    PhysxCollisionShapeConvexMesh,
    PhysxCpuSystem,
)
from sapien.wrapper.actor_builder import ActorBuilder
from sapien.wrapper.articulation_builder import ArticulationBuilder, LinkBuilder

from batchpid.arrays.array_types import Float32
from batchpid.errors import InvalidArgumentError
from batchpid.sim.engine.scene_spec import Build

ROOT_SIZE = 13
"""Number of values of :func:`read_body`."""


class _HeadlessBuilder(ActorBuilder):
    """Actor builder whose ``add_*_visual`` methods do nothing: a visual would need a render
    device.
    """


class _HeadlessLink(_HeadlessBuilder, LinkBuilder):
    """Builder of a link, likewise without visuals."""


class _HeadlessArticulation(ArticulationBuilder):
    """Builder of articulations whose links have no visuals."""

    def create_link_builder(self, parent: LinkBuilder | None = None) -> LinkBuilder:
        """Return a builder of a link that moves with ``parent``; None for the root."""
        link = super().create_link_builder(parent)
        self.link_builders[-1] = _HeadlessLink(link.index, parent)
        return self.link_builders[-1]


class HeadlessScene(sapien.Scene):
    """Scene in ``system``, or in a new PhysX system under the present settings, that needs no
    render device.

    Visuals and lights are left out, so that code written for a screen runs.
    """

    def __init__(self, system: PhysxCpuSystem | None = None) -> None:
        # Without a list of systems SAPIEN builds a render system, which fails without a device, or
        # ends the process.
        super().__init__([PhysxCpuSystem() if system is None else system])

    def create_actor_builder(self) -> ActorBuilder:
        """Return a builder of actors for this scene."""
        return _HeadlessBuilder().set_scene(self)

    def create_articulation_builder(self) -> ArticulationBuilder:
        """Return a builder of articulations for this scene."""
        return _HeadlessArticulation().set_scene(self)


for _name in dir(ActorBuilder):
    if _name.startswith("add_") and "visual" in _name:
        setattr(_HeadlessBuilder, _name, lambda self, *_, **__: self)
for _name in dir(sapien.Scene):
    if _name.startswith(("add_", "set_")) and any(
        word in _name for word in ("light", "environment_map")
    ):
        setattr(HeadlessScene, _name, lambda self, *_, **__: None)


class SceneContent:
    """Actors and articulations that ``build`` added to the scene of env ``env``; ``watched`` are the
    entities that it returned.
    """

    def __init__(self, build: Build, scene: HeadlessScene, env: int) -> None:
        self.watched = _call(build, scene, env)
        for entity in scene.entities:
            for component in entity.components:
                _check(component, env)
        # In the order of their making: the first articulation is the robot.
        self._bodies = scene.physx_system.rigid_dynamic_components
        self._articulations = scene.get_all_articulations()[1:]
        self._start = self.read()

    def reset(self) -> None:
        """Put everything that moves into the state in which ``build`` left it."""
        self.write(self._start)

    def read(self) -> Float32:
        """Return the state of everything that moves (values,)."""
        parts: list[Any] = [np.zeros(0), *map(read_body, self._bodies)]
        for articulation in self._articulations:
            parts += [
                read_body(articulation.root),
                articulation.qpos,
                articulation.qvel,
                articulation.qf,
            ]
        return np.concatenate(parts, dtype=np.float32)

    def write(self, state: Float32) -> None:
        """Put everything that moves into the state that :meth:`read` returned; further values are
        ignored.
        """
        values = iter(state)

        def take(count: int) -> Float32:
            return np.fromiter(values, np.float32, count)

        for body in self._bodies:
            row = take(ROOT_SIZE)
            body.set_entity_pose(sapien.Pose(row[:3], row[3:7]))
            # PhysX refuses velocities of kinematic bodies.
            if not body.kinematic:
                body.set_linear_velocity(row[7:10])
                body.set_angular_velocity(row[10:])
        for articulation in self._articulations:
            write_root(articulation, take(ROOT_SIZE))
            for write in (articulation.set_qpos, articulation.set_qvel, articulation.set_qf):
                write(take(articulation.dof))

    def poses(self) -> Float32:
        """Return the poses of the watched entities (watched, 7): x, y, z [m] and the quaternion w,
        x, y, z.
        """
        poses = [entity.get_pose() for entity in self.watched]
        rows = [np.concatenate([pose.p, pose.q]) for pose in poses]
        return np.array(rows, np.float32).reshape(len(rows), 7)


def _check(component: Any, env: int) -> None:
    """Raise InvalidArgumentError for a component with a shape that ends the process."""
    for shape in getattr(component, "collision_shapes", ()):
        # Two of them end it once they touch.
        if isinstance(shape, PhysxCollisionShapeConvexMesh) and min(shape.scale) < 0:
            problem = f"gave {component.entity.name!r} a convex mesh of negative scale"
            remedy = "mirror the vertices in the file"
            raise InvalidArgumentError("build", problem, env=env, remedy=remedy)


def _call(build: Build, scene: HeadlessScene, env: int) -> list[sapien.Entity]:
    """Return the entities that ``build`` returns; its errors become an InvalidArgumentError."""
    try:
        returned = build(scene, env)
    except Exception as error:
        problem = f"raised {type(error).__name__}: {error}"
        remedy = "correct the function; try it with workers=0 for the traceback"
        raise InvalidArgumentError("build", problem, env=env, remedy=remedy) from error
    if returned is None:
        return []
    watched = [*returned] if isinstance(returned, Iterable) else [returned]
    for item in watched:
        if not isinstance(item, sapien.Entity):
            raise InvalidArgumentError(
                "build",
                "returned something other than entities",
                env=env,
                value=type(item).__name__,
                remedy="return the entities for runner.poses(), or None",
            )
    return watched


def read_body(body: Any) -> Float32:
    """Return pose and velocities (13,) of a body in SAPIEN: of an actor, or of a link."""
    pose = body.get_entity_pose()
    velocity = body.get_linear_velocity(), body.get_angular_velocity()
    return np.concatenate([pose.p, pose.q, *velocity], dtype=np.float32)


def write_root(articulation: PhysxArticulation, state: Float32) -> None:
    """Set the state of the root link of a SAPIEN articulation (13,)."""
    articulation.set_root_pose(sapien.Pose(state[:3], state[3:7]))
    articulation.set_root_linear_velocity(state[7:10])
    articulation.set_root_angular_velocity(state[10:])
