"""Pack of scenes in one process, read and written as arrays.

A pack is M scenes, each with one robot and a PhysX system. PhysX solves the contacts of a system in
an order that depends on everything in the system, so robots that share one would not move
bit-identically to a robot alone.

The engine takes changed payloads, masses, centers of mass and friction while a robot exists, and
then moves bit-identically to a robot that was built with them. The loop uses only the members of
:class:`batchpid.sim.engine.protocol.EnginePack`. Longer than 350 lines because
that is the whole interface between loop and engine.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np
from sapien import Pose, physx

from batchpid.arrays.array_types import Bool, Float32, Float64, Rows
from batchpid.motors import Actuators
from batchpid.sim.engine.native import FARTHEST
from batchpid.sim.engine.protocol import BASE_AT_REST, Engine, EnginePack
from batchpid.sim.engine.sapien.building import (
    RESTITUTION,
    build_scene,
    engine_settings,
    new_system,
    rounded_tree,
    set_inertia,
)
from batchpid.sim.engine.sapien.calls import SapienStep, obstacle
from batchpid.sim.engine.sapien.limits import refusals, shortfalls
from batchpid.sim.engine.sapien.user_content import ROOT_SIZE, SceneContent, read_body, write_root
from batchpid.sim.engine.scene_spec import PHYSICS, SceneSpec, Variation
from batchpid.task_space.frames import matrix_of, unrotate
from batchpid.task_space.rigid_tree import RigidTree


class Pack(EnginePack):
    """Pack of scenes in SAPIEN.

    Attributes
    ----------
    robots, systems
        SAPIEN's articulation and PhysX system of each scene; a robot that is placed may be rebuilt
        in a new system.
    """

    def __init__(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        variation: Variation | None = None,
        workspace: object = None,
    ) -> None:
        super().__init__(spec, size, first_env, variation, not obstacle())
        self._shapes: dict[int, list[Any]] = {}
        self._frames: list[tuple[Pose, Pose] | None] = []
        self.systems = [self._system(row) for row in range(size)]
        built = [self._build(row, system) for row, system in enumerate(self.systems)]
        # SAPIEN frees a scene's robot with the Python Scene, and then steps an empty world in
        # silence.
        self._scenes, self.robots = map(list, zip(*built, strict=True))
        self._stepped = np.zeros(size, bool)  # robots that did a sim step since they were placed
        self._contents = []
        if spec.build is not None:
            with engine_settings(spec):
                envs = enumerate(self._scenes, start=first_env)
                self._contents = [SceneContent(spec.build, scene, env) for env, scene in envs]
        self._damping = np.array([[joint.damping for joint in self.robots[0].active_joints]])
        self.qf = np.zeros((size, self.dof), np.float32)
        continuous = np.array([joint.continuous for joint in spec.joints], bool)
        self._couple(continuous, None, self.qf)
        is_coupled = self._constraint is not None
        self._joint_qf = np.zeros_like(self.qf) if is_coupled else self.qf
        self._turning = np.flatnonzero(continuous & is_coupled)
        self._bind()
        if variation is not None:
            self.write_joints(None)

    def _system(self, row: int) -> Any:
        """Return a new system for ``row``."""
        spec = self.spec
        gravity = self._variation.gravity
        if gravity is not None:
            spec = replace(spec, gravity=tuple(gravity[row].tolist()))
        return new_system(spec)

    def _build(self, row: int, system: Any) -> tuple[Any, Any]:
        """Return a new scene in ``system`` and the robot in it, for ``row``, with its masses and
        friction.
        """
        scene, robot = build_scene(self.spec, system)
        self._change_masses(robot, row)
        if self._variation.ground_friction is not None:
            owners = *robot.links, *system.rigid_static_components
            self._shapes[row] = [shape for owner in owners for shape in owner.collision_shapes]
            self._change_friction(row)
        return scene, robot

    def _bind(self) -> None:
        """Use the present robots and systems in the next sim steps."""
        self._joints = [joint for robot in self.robots for joint in robot.active_joints]
        self.calls = object()

    def step(self) -> None:
        """Do one sim step of every scene, with constraint efforts on coupled joints."""
        if self._constraint is not None:
            qpos = self.read_qpos()
            self._joint_qf[...] = self._constraint.apply(self.qf, qpos, self.read_qvel())
            self._apply(self._joint_qf)
        self._stepped[...] = True
        for system in self.systems:
            system.step()

    def _apply(self, qf: Float32) -> None:
        """Apply efforts to the joints."""
        for row in np.flatnonzero(~self._suspended):
            self.robots[row].set_qf(qf[row])

    def steps_read_force(self, gravity: bool, coriolis: bool) -> bool:
        return self.spec.fixed_base and self._is_model

    def compiled_step(self, gravity: bool, coriolis: bool, drives: bool = False) -> SapienStep:
        return SapienStep(
            self.robots,
            self.systems,
            {"qf": self._joint_qf, "skip": self._suspended},
            self._stepped,
            self._joints if drives else [],
            gravity=gravity,
            coriolis=coriolis,
            constraint=self._constraint_address,
        )

    @property
    def rigid_tree(self) -> RigidTree:
        return rounded_tree(self.spec)

    def _bias(self) -> Float64:
        return self._own_force(True, True)

    def _renew(self, rows: Sequence[int]) -> None:
        """Rebuild the robots ``rows`` in new systems, in which earlier contacts have no influence
        on the next ones.

        Robots without shapes have no contacts. Scenes with user content stay, because ``build`` is
        called only once.
        """
        used = [row for row in rows if self._stepped[row]]
        has_shapes = any(link.collision_shapes for link in self.robots[0].links)
        if used and has_shapes and not self._contents:
            self._rebuild(used)

    def _rebuild(self, rows: Sequence[int]) -> None:
        """Build the robots ``rows`` again, in new systems, with the drives that they have."""
        drives = [[_read_drive(joint) for joint in self.robots[row].active_joints] for row in rows]
        # First the old robots are freed: new ones in other memory make every later sim step a tenth
        # slower.
        self._joints = []
        self.calls = None
        for row in rows:
            self._scenes[row].clear()
            self._scenes[row] = self.robots[row] = self.systems[row] = None
        for row in rows:
            self.systems[row] = self._system(row)
        for row, settings in zip(rows, drives, strict=True):
            self._scenes[row], robot = self._build(row, self.systems[row])
            for joint, (drive, target, rate, armature) in zip(
                robot.active_joints, settings, strict=True
            ):
                joint.set_drive_properties(*drive)
                joint.set_drive_target(target)
                joint.set_drive_velocity_target(rate)
                joint.set_armature(armature)
            _disable_gravity(robot, bool(self._suspended[row]))
            self.robots[row] = robot
        self._stepped[rows] = False
        self._bind()

    def read_qpos(self) -> Float64:
        return self._table(robot.get_qpos() for robot in self.robots)

    def read_qvel(self) -> Float64:
        return self._table(robot.get_qvel() for robot in self.robots)

    def _own_force(self, gravity: bool, coriolis: bool) -> Float64:
        """Return the passive force by SAPIEN."""
        return self._table(robot.compute_passive_force(gravity, coriolis) for robot in self.robots)

    def _table(self, rows: Iterable[Float32]) -> Float64:
        # After close() there are no rows.
        return np.array([*rows], np.float64).reshape(len(self.robots), self.dof)

    def passive_force(self, gravity: bool, coriolis: bool) -> Float64:
        if self.steps_read_force(gravity, coriolis):
            return self._own_force(gravity, coriolis)
        return self._force(self.force_model, gravity, coriolis)

    def write_qf(self, effort: Rows) -> None:
        self.qf[...] = effort
        if self._constraint is None:
            self._apply(self.qf)

    def strays(self) -> Bool:
        """Return the robots (M,) whose floating base is not finite or beyond FARTHEST."""
        return np.array(~(np.abs(self.read_base()) <= FARTHEST).all(1))

    def read_base(self) -> Float64:
        roots = np.array([read_body(robot.root) for robot in self.robots], np.float64)
        return self._moved_to_origin(range(self.size), roots, -1.0)

    def read_base_motion(self) -> Float64 | None:
        if self.spec.fixed_base:
            return None
        roots = np.array([read_body(robot.root) for robot in self.robots], np.float64)
        turn = matrix_of(roots[:, 3:7])
        parts = np.array(self.spec.gravity), roots[:, 10:]
        return np.concatenate([unrotate(turn, part) for part in parts], axis=1)

    def push(self, rows: Sequence[int], twists: Float64) -> None:
        bases = self.read_base()[rows]
        bases[:, 7:] += twists
        for row, base in zip(
            rows, self._moved_to_origin(rows, bases, 1.0).astype(np.float32), strict=True
        ):
            _, moving, turning = np.split(base, [7, 10])
            self.robots[row].set_root_linear_velocity(moving)
            self.robots[row].set_root_angular_velocity(turning)

    def _moved_to_origin(self, rows: Sequence[int], roots: Float64, sign: float) -> Float64:
        """Return ``roots`` (n, 13) of robots ``rows`` with the velocity of the link's origin for
        that of its center of mass, or back.

        PhysX gives the velocity of the center of mass c: v_c = v + w x (R c), subtracted with
        ``sign`` -1.
        """
        centers = np.array(
            [self.robots[row].links[0].cmass_local_pose.p for row in rows], np.float64
        ).reshape(-1, 3)
        arm = (matrix_of(roots[:, 3:7]) @ centers[..., None])[..., 0]
        velocity = roots[:, 7:10] + sign * np.cross(roots[:, 10:], arm)
        return np.concatenate([roots[:, :7], velocity, roots[:, 10:]], axis=1)

    def take_sensed(self, steps: int) -> dict[str, Rows]:
        """Return the contact forces of the last sim step: the normal forces, which PhysX
        reports.
        """
        sensed = self.spec.contacts or ()
        bodies = self.spec.simulated.links
        forces = np.zeros((self.size, len(sensed), 3))
        for row in np.flatnonzero(self._stepped):
            entities = {link.name: link.entity for link in self.robots[row].links}
            places = {entities[bodies[link].link]: place for place, link in enumerate(sensed)}
            for contact in self.systems[row].get_contacts():
                impulse = np.sum([point.impulse for point in contact.points], axis=0)
                for body, sign in zip(contact.bodies, (1.0, -1.0), strict=True):
                    if (place := places.get(body.entity)) is not None:
                        forces[row, place] += sign * impulse / self.spec.timestep
        return {"contact_force": forces, "touching": np.abs(forces).sum(2)}

    def write_state(
        self,
        rows: Sequence[int],
        qpos: Rows,
        qvel: Rows,
        base: Float64 | None = None,
    ) -> None:
        """Place robots ``rows``: positions and velocities (len(rows), dof), the root at ``base``;
        their efforts become zero, and the content of their scenes is reset.
        """
        bases = (
            np.tile(BASE_AT_REST, (len(rows), 1))
            if base is None
            else self._moved_to_origin(rows, base, 1.0)
        )
        self._place(rows, qpos, qvel, bases.astype(np.float32))
        self.update_constraint(list(rows))  # within a tick, the robots may have failed

    def _place(
        self,
        rows: Sequence[int],
        qpos: Rows,
        qvel: Rows,
        roots: Float32,
    ) -> None:
        """Do :meth:`write_state` with these states of the root (len(rows), 13).

        They are always set, since a robot whose state is NaN has lost its root, too.
        """
        self._renew(rows)
        for row, position, velocity, base in zip(rows, qpos, qvel, roots, strict=True):
            robot = self.robots[row]
            write_root(robot, base)
            robot.set_qpos(position.astype(np.float32))
            robot.set_qvel(velocity.astype(np.float32))
            self.qf[row] = self._stepped[row] = 0.0
            robot.set_qf(self.qf[row])
            if self._contents:
                self._contents[row].reset()
        if self._constraint is not None:
            self._constraint.place(rows, qpos)

    def vary(self, rows: Sequence[int], variation: Variation) -> None:
        self._change(rows, variation)
        if self._variation.gravity is not None:  # a system keeps its gravity
            self._rebuild(rows)
        else:
            for row in rows:
                self._change_masses(self.robots[row], row)
                self._change_friction(row)
        self._change_model(rows)

    def _change_friction(self, row: int) -> None:
        """Set the friction of the robot's shapes and of the ground."""
        if (friction := self._variation.ground_friction) is not None:
            material = physx.PhysxMaterial(friction[row], friction[row], RESTITUTION)
            for shape in self._shapes[row]:
                shape.set_physical_material(material)

    def _change_masses(self, robot: Any, row: int) -> None:
        """Set the masses of a robot, and restore the frames of its joints, which this moves by
        rounding.
        """
        if not self._masses.added:
            return
        if not self._frames:  # as built, before a mass has moved them
            moves = [joint.parent_link is not None for joint in robot.joints]
            pairs = zip(robot.joints, moves, strict=True)
            self._frames = [
                (joint.pose_in_parent, joint.pose_in_child) if move else None
                for joint, move in pairs
            ]
        inertias = self._masses.of_robot(row)
        for link in robot.links:
            if link.name in inertias:
                set_inertia(link, inertias[link.name])
        for joint, frames in zip(robot.joints, self._frames, strict=True):
            if frames is not None:
                joint.set_pose_in_parent(frames[0])
                joint.set_pose_in_child(frames[1])

    def read_state(self) -> Float64:
        """Return the state of each scene (M, values): qpos, qvel, root, positions without jumps of
        coupled continuous joints, content, then NaN.
        """
        rows = []
        for row, robot in enumerate(self.robots):
            content = [scene.read() for scene in self._contents[row : row + 1]]
            turned = (
                [] if self._constraint is None else self._constraint.unwrapped[row, self._turning]
            )
            parts = robot.get_qpos(), robot.get_qvel(), read_body(robot.root), turned, *content
            rows.append(np.concatenate(parts, dtype=np.float64))
        return np.array([*zip_longest(*rows, fillvalue=np.nan)]).T.copy()

    def write_state_rows(self, states: Float64) -> None:
        ends = np.cumsum([self.dof, self.dof, ROOT_SIZE, self._turning.size])
        qpos, qvel, roots, turned, contents = np.split(states.astype(np.float32), ends, axis=1)
        self._place(range(self.size), qpos, qvel, roots)
        if self._constraint is not None:
            self._constraint.unwrapped[:, self._turning] = turned
        for content, row in zip(self._contents, contents, strict=False):
            content.write(row)

    def suspend(self, mask: Bool) -> None:
        if (mask == self._suspended).all():
            return
        for robot, suspended in zip(self.robots, mask, strict=True):
            _disable_gravity(robot, bool(suspended))
        self._suspended = mask.copy()
        self._bind()

    def read_poses(self, names: Sequence[str] | None = None) -> list[Float32]:
        """Return the poses of each scene's watched entities, (watched, 7) each."""
        return [content.poses() for content in self._contents]

    def write_joints(self, actuators: Actuators | None, rows: Sequence[int] | None = None) -> None:
        values = np.broadcast_to(self._add_joints(actuators), self.qf.shape).astype(np.float32)
        for row in range(self.size) if rows is None else rows:
            for joint, value in zip(
                self.robots[row].active_joints, values[row, :, None], strict=True
            ):
                joint.set_armature(value)

    def write_drive(self, stiffness: Rows, damping: Rows, force_limit: Rows) -> None:
        """Set PhysX's internal PD drive of every joint; each argument broadcasts to (M, dof).

        Where the engine simulates the URDF's joint damping, which is drive damping too, it is added
        to ``damping``.
        """
        limit = np.minimum(force_limit, np.finfo(np.float32).max)
        tables = (
            np.broadcast_to(table, self.qf.shape).flat
            for table in (stiffness, damping + self._damping, limit)
        )
        for joint, *values in zip(self._joints, *tables, strict=True):
            joint.set_drive_properties(*map(float, values), "force")

    def write_drive_target(self, position: Rows, velocity: Rows | None = None) -> None:
        rates = np.zeros_like(position) if velocity is None else velocity
        targets = position.ravel().tolist(), rates.ravel().tolist()
        for joint, target, rate in zip(self._joints, *targets, strict=True):
            joint.set_drive_target(target)
            joint.set_drive_velocity_target(rate)

    def close(self) -> None:
        self.robots = []
        self.systems = []
        self._contents = []
        self._scenes = []
        self._bind()


def _read_drive(joint: Any) -> tuple[tuple[Any, ...], float, float, Float32]:
    """Return the drive's properties, targets of position and velocity, and the armature of one of
    SAPIEN's joints.
    """
    properties = joint.stiffness, joint.damping, joint.force_limit, joint.drive_mode
    return properties, joint.drive_target, joint.drive_velocity_target, joint.armature


def _disable_gravity(robot: Any, disabled: bool) -> None:
    for link in robot.links:
        link.disable_gravity = disabled


ENGINE = Engine(
    name="sapien",
    title="SAPIEN",
    capabilities=frozenset({"build", "sapien_dissipation"}),
    physics=PHYSICS,
    group_size=4,
    make_pack=Pack,
    native_obstacle=obstacle,
    refusals=refusals,
    shortfalls=shortfalls,
)
