"""The user's own content of a scene: built headless, watched, and put back at a reset.

Beside ``sim/engine/pack.py`` this is the one module that touches SAPIEN, which the user's function does too.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien.physx import PhysxArticulationLinkComponent, PhysxRigidDynamicComponent
from sapien.wrapper.actor_builder import ActorBuilder

from batchpid.errors import InvalidArgumentError

Build = Callable[[Any, int], Any]
"""``build(scene, env)`` adds to the scene of env ``env``; returns the entities whose poses are wanted, or None."""

_LIGHTS = (
    "add_directional_light",
    "add_point_light",
    "add_spot_light",
    "add_area_light_for_ray_tracing",
    "set_ambient_light",
    "set_environment_map",
    "set_environment_map_from_files",
)
_VISUALS = tuple(name for name in dir(ActorBuilder) if name.startswith("add_") and "visual" in name)


class _HeadlessBuilder(ActorBuilder):
    """An actor builder that leaves visuals out: each of them would need a render device."""


def _same_builder(self: _HeadlessBuilder, *_: Any, **__: Any) -> _HeadlessBuilder:
    return self


class HeadlessScene(sapien.Scene):
    """A scene in which visuals and lights are left out, so that code written for a screen runs without one."""

    def create_actor_builder(self) -> Any:
        """Return a builder of actors for this scene."""
        return _HeadlessBuilder().set_scene(self)


def _nothing(self: HeadlessScene, *_: Any, **__: Any) -> None:
    return None


for _name in _VISUALS:
    setattr(_HeadlessBuilder, _name, _same_builder)
for _name in _LIGHTS:
    setattr(HeadlessScene, _name, _nothing)


class Content:
    """What ``build`` added to the scene of one env, and where everything stood then."""

    def __init__(self, build: Build, scene: Any, env: int) -> None:
        own = {entity.per_scene_id for entity in scene.entities}  # the robot and the ground
        self.watched = _run(build, scene, env)
        self._bodies, self._articulations = [], []
        for entity in scene.entities:
            if entity.per_scene_id in own:
                continue
            for component in entity.components:
                if isinstance(component, PhysxRigidDynamicComponent):
                    self._bodies.append((component, entity, entity.get_pose()))
                elif isinstance(component, PhysxArticulationLinkComponent) and component.is_root:
                    robot = component.articulation
                    self._articulations.append((robot, robot.get_pose(), robot.get_qpos()))

    def reset(self) -> None:
        """Put everything that moves back to where ``build`` left it, at rest."""
        for body, entity, pose in self._bodies:
            entity.set_pose(pose)
            if not body.kinematic:
                body.set_linear_velocity([0.0, 0.0, 0.0])
                body.set_angular_velocity([0.0, 0.0, 0.0])
        for robot, pose, qpos in self._articulations:
            robot.set_root_pose(pose)
            robot.set_root_linear_velocity([0.0, 0.0, 0.0])
            robot.set_root_angular_velocity([0.0, 0.0, 0.0])
            robot.set_qpos(qpos)
            robot.set_qvel(np.zeros_like(qpos))

    @property
    def size(self) -> int:
        """How many numbers :meth:`read` gives."""
        return 13 * len(self._bodies) + sum(13 + 3 * robot.dof for robot, *_ in self._articulations)

    def read(self) -> NDArray[np.float32]:
        """State of everything that moves, in one row of numbers."""
        parts: list[Any] = []
        for body, entity, _ in self._bodies:
            pose = entity.get_pose()
            parts += [pose.p, pose.q, body.get_linear_velocity(), body.get_angular_velocity()]
        for robot, *_ in self._articulations:
            pose = robot.get_root_pose()
            parts += [pose.p, pose.q, robot.get_root_linear_velocity(), robot.get_root_angular_velocity()]
            parts += [robot.get_qpos(), robot.get_qvel(), robot.get_qf()]
        return np.concatenate(parts, dtype=np.float32) if parts else np.zeros(0, np.float32)

    def write(self, row: NDArray[np.float32]) -> None:
        """Put everything that moves into the state that :meth:`read` gave."""
        numbers = iter(np.asarray(row, np.float32))

        def take(count: int) -> NDArray[np.float32]:
            return np.fromiter(numbers, np.float32, count)

        for body, entity, _ in self._bodies:
            entity.set_pose(sapien.Pose(take(3), take(4)))
            linear, angular = take(3), take(3)
            if not body.kinematic:
                body.set_linear_velocity(linear)
                body.set_angular_velocity(angular)
        for robot, *_ in self._articulations:
            robot.set_root_pose(sapien.Pose(take(3), take(4)))
            robot.set_root_linear_velocity(take(3))
            robot.set_root_angular_velocity(take(3))
            dof = robot.dof
            robot.set_qpos(take(dof))
            robot.set_qvel(take(dof))
            robot.set_qf(take(dof))

    def poses(self) -> NDArray[np.float32]:
        """Poses of the watched entities (watched, 7): x, y, z [m] and the quaternion w, x, y, z."""
        rows = [np.concatenate([pose.p, pose.q]) for pose in (entity.get_pose() for entity in self.watched)]
        return np.array(rows, np.float32).reshape(len(rows), 7)


def _run(build: Build, scene: Any, env: int) -> list[Any]:
    try:
        returned = build(scene, env)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        raise InvalidArgumentError(
            "build",
            f"raised {type(error).__name__}: {error} ({where.filename}:{where.lineno})",
            env=env,
            remedy="correct the function; try it with workers=0 for the whole traceback",
        ) from error
    if returned is None:
        return []
    entities = list(returned) if isinstance(returned, Iterable) else [returned]
    for entity in entities:
        if not isinstance(entity, sapien.Entity):
            raise InvalidArgumentError(
                "build",
                "returned something that is no entity",
                env=env,
                value=type(entity).__name__,
                remedy="return the entities whose poses are wanted, or None",
            )
    return entities
