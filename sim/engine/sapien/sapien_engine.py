"""SAPIEN as an :class:`batchpid.sim.engine.protocol.Engine`, and robots in it that differ from the model, env by env.

Compensation and mass matrix keep the model's values, because a controller does not know its payload.

The engine takes changed payloads, masses, centers of mass and friction while a robot exists, and then moves
bit-identically to a robot that was built with them, with one exception: a new center of mass moves the frames of the
joints by rounding, so that they are set again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, get_args

from sapien import Pose, physx

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64, Rows
from batchpid.motors.friction import Friction
from batchpid.sim.engine.native.library import obstacle
from batchpid.sim.engine.native_model import NativeModel
from batchpid.sim.engine.physics import PHYSICS, Physics
from batchpid.sim.engine.protocol import Capability, Engine
from batchpid.sim.engine.sapien.building import RESTITUTION, new_system, scene_tree, set_inertia
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.scene_spec import SceneSpec, Variation, VariedMasses, own_friction


class VariedPack(Pack):
    """Pack whose robots differ from the model by ``variation``, one row for each, which :meth:`vary` changes.

    ``carrier`` is the link of the URDF that carries the payload, ``links`` are those whose mass or center varies.
    """

    def __init__(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int,
        variation: Variation,
        carrier: str,
        links: Sequence[str],
    ) -> None:
        self._variation = variation
        self._masses = VariedMasses(spec, size, variation, carrier, links)
        self._shapes: dict[int, list[Any]] = {}
        self._frames: list[tuple[Pose, Pose] | None] = []
        super().__init__(spec, size, first_env)
        if variation.armature is not None:
            self._motors = variation.armature  # vary() changes its rows
        self.write_joints(None)

    def vary(self, rows: Sequence[int], variation: Variation) -> None:
        for mine, new in zip(self._variation, variation, strict=True):
            if mine is not None:
                mine[rows] = new
        if self._variation.gravity is not None:  # a system keeps its gravity
            self._rebuild(rows)
        else:
            for row in rows:
                self._change_masses(self.robots[row], row)
                self._change_friction(row)
        if self._masses.added and "_joint_model" in self.__dict__:
            self._joint_model.vary(rows, self.size, self._masses.added)

    @cached_property
    def _joint_model(self) -> NativeModel:
        model = super()._joint_model
        if self._masses.added:
            model.vary(range(len(self.qf)), len(self.qf), self._masses.added)
        return model

    def _system(self, row: int) -> Any:
        gravity = self._variation.gravity
        return new_system(self.spec, None if gravity is None else gravity[row])

    def _build(self, row: int, system: Any) -> tuple[Any, Any]:
        """Return a new scene and the robot in it, with its masses."""
        scene, robot = super()._build(row, system)
        if not self._frames:
            moves = [joint.parent_link is not None for joint in robot.joints]
            pairs = zip(robot.joints, moves, strict=True)
            self._frames = [(joint.pose_in_parent, joint.pose_in_child) if move else None for joint, move in pairs]
        self._change_masses(robot, row)
        owners = *robot.links, *system.rigid_static_components
        self._shapes[row] = [shape for owner in owners for shape in owner.collision_shapes]
        self._change_friction(row)
        return scene, robot

    def _change_friction(self, row: int) -> None:
        """Set the friction of the robot's shapes and of the ground."""
        if (friction := self._variation.ground_friction) is not None:
            material = physx.PhysxMaterial(friction[row], friction[row], RESTITUTION)
            for shape in self._shapes[row]:
                shape.set_physical_material(material)

    def _change_masses(self, robot: Any, row: int) -> None:
        if not self._masses.added:
            return
        inertias = self._masses.of_robot(row)
        for link in robot.links:
            if link.name in inertias:
                set_inertia(link, inertias[link.name])
        for joint, frames in zip(robot.joints, self._frames, strict=True):
            if frames is not None:
                joint.set_pose_in_parent(frames[0])
                joint.set_pose_in_child(frames[1])

    def _friction(self) -> Friction:
        """Return the friction and damping of the joints."""
        return own_friction(self.spec, self._variation)

    def _joint_mass_matrix(self, qpos: Rows) -> Float64:
        tree, added = scene_tree(self.spec), self._masses.added
        return ts.mass_matrix(tree, qpos, tree.varied(added) if added else None)

    def steps_read_force(self, gravity: bool, coriolis: bool) -> bool:
        """Return whether compiled steps read the force of the model: not where a mass differs from it."""
        own = not self._masses.added and self._variation.gravity is None
        return own and super().steps_read_force(gravity, coriolis)


class SapienEngine:
    """SAPIEN with PhysX on the CPU. Implements :class:`batchpid.sim.engine.protocol.Engine`."""

    name, title = "sapien", "SAPIEN"
    capabilities: frozenset[Capability] = frozenset(get_args(Capability)) - {"base_state"}
    physics: Mapping[str, Any] = PHYSICS
    group_size = 16

    def is_physics(self, settings: object) -> bool:
        """Return whether these are :class:`batchpid.sim.Physics`."""
        return isinstance(settings, Physics)

    def least_memory(self, num_envs: int, dof: int) -> int:
        """Return a lower estimate of the bytes of ``num_envs`` robots, each with a PhysX system.

        Chains of 1 to 30 boxes and jaco2 take up to 35 % more; a panda, with large collision meshes, 2.7 times as much.
        """
        return num_envs * (405_000 + 6_000 * dof)

    def make_pack(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        variation: Variation | None = None,
        carrier: str = "",
        links: Sequence[str] = (),
        workspace: dict[Any, Any] | None = None,
    ) -> Pack:
        """Return a new pack, with a PhysX system for each scene."""
        if variation is None:
            return Pack(spec, size, first_env)
        return VariedPack(spec, size, first_env, variation, carrier, links)

    native_obstacle = staticmethod(obstacle)
    scene_tree = staticmethod(scene_tree)


ENGINE: Engine = SapienEngine()
