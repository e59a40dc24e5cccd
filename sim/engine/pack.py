"""A pack of scenes in one process, read and written as arrays.

A pack is M scenes, one robot each, in step with each other, some of them to a PhysX system. All stand at the origin;
the shapes of each scene carry a collision group of their own, so that scenes never meet. That is bit-identical to one
system per scene, and a fifth to a third cheaper. A robot gets a system of its own before something touches it
(:mod:`sim.engine.contact_prediction`).

The loop needs a dozen calls and no more (:class:`Pack`); another gateway to the engine has only these to provide.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import physx
from sapien.wrapper.articulation_builder import ArticulationBuilder

from sim.engine.building import SceneSpec, bare_scene, build_robot, engine_settings, link_extents, separate
from sim.engine.contact_prediction import WORLD, ContactPredictor, Gap
from sim.engine.dynamics import scene_dynamics
from sim.engine.user_content import Content

_ORIGIN = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], np.float32)

Float32 = NDArray[np.float32]


class Pack:
    """M scenes of one robot, ``system_size`` to a PhysX system. Arrays are (M, dof), in SAPIEN's order, SI units.

    ``isolated`` (M,) tells which robots have got a system of their own; none do with ``isolates`` False.
    """

    def __init__(
        self,
        builder: ArticulationBuilder,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        system_size: int = 8,
        isolates: bool = True,
    ) -> None:
        self._builder, self._spec = builder, spec
        # A robot that stands on the ground is touched from the start, and so are free bodies.
        shares = spec.fixed_base and spec.build is None
        shared, self._isolates = system_size if shares else 1, shares and isolates
        systems = [_system(spec) for _ in range(-(-size // shared))]
        self._homes = [systems[row // shared] for row in range(size)]
        self._systems = list(self._homes)
        with engine_settings(spec):
            built = [self._build(row, system) for row, system in enumerate(self._homes)]
            # SAPIEN frees a scene's robot with the Python Scene, and then steps an empty world in silence.
            self._scenes, self._robots = map(list, zip(*built, strict=True))
            build = spec.build
            self._contents = (
                []
                if build is None
                else [Content(build, scene, env) for env, scene in enumerate(self._scenes, start=first_env)]
            )
        for row, scene in enumerate(self._scenes):
            separate(scene, row + 1)
        self.size, self.dof = size, self._robots[0].dof
        self.isolated = np.zeros(size, bool)
        self._contact_predictor = ContactPredictor(link_extents(self._robots[0]), self.dof, spec.timestep)
        self._damping = np.array([[joint.damping for joint in self._robots[0].active_joints]])
        self._qf = np.zeros((size, self.dof), np.float32)
        self._suspended: NDArray[np.bool_] = np.zeros(size, bool)
        self._bind()

    def _build(self, row: int, system: Any) -> tuple[Any, Any]:
        """A scene in ``system`` and the robot in it, for ``row``."""
        scene = bare_scene(system)
        robot = build_robot(self._builder, scene, self._spec)
        if self._spec.ground:
            scene.add_ground(0.0, render=False)
        return scene, robot

    def _bind(self) -> None:
        """Keep the calls that every sim step makes, which is cheaper than to look them up."""
        robots = self._robots
        self._joints = [robot.active_joints for robot in robots]
        self._get_qpos = [robot.get_qpos for robot in robots]
        self._get_qvel = [robot.get_qvel for robot in robots]
        self._passive = [robot.compute_passive_force for robot in robots]
        # set_qf from a kept row view costs half of what a fresh one does.
        rows = zip(robots, self._qf, self._suspended, strict=True)
        self._set_qf = [(robot.set_qf, row) for robot, row, held in rows if not held]
        self._steps = [system.step for system in dict.fromkeys(self._systems)]
        shared = [row for row in range(self.size) if self._isolates and not self.isolated[row]]
        self._get_contacts = [s.get_contacts for s in dict.fromkeys(self._systems[row] for row in shared)]
        self._links = {link: (row, i) for row in shared for i, link in enumerate(robots[row].links)}

    def step(self) -> None:
        """One sim step of every scene."""
        for step in self._steps:
            step()
        for get_contacts in self._get_contacts:
            contacts = get_contacts()
            if contacts:
                self.isolate(self._about_to_touch(contacts))

    def _about_to_touch(self, contacts: Iterable[Any]) -> list[int]:
        """Robots that share a system and may be touched in the next step."""
        near: dict[int, list[tuple[int, int, Any]]] = {}
        nobody = (None, WORLD)
        for contact in contacts:
            first, second = (self._links.get(body, nobody) for body in contact.bodies)
            row = second[0] if first[0] is None else first[0]
            if row is not None and not self._suspended[row]:
                near.setdefault(row, []).append((first[1], second[1], contact.points))
        return [
            row
            for row, pairs in near.items()
            if self._contact_predictor.predicts_contact(
                [Gap(a, b, min(point.separation for point in points)) for a, b, points in pairs],
                self._get_qvel[row](),
            )
        ]

    def isolate(self, rows: Iterable[int]) -> None:
        """Give each robot of ``rows`` that shares a system one of its own, in the state in which it is."""
        self._move({row: _system(self._spec) for row in rows if self._isolates and not self.isolated[row]})

    def _start_over(self, rows: Sequence[int], qpos: NDArray[Any], qvel: NDArray[Any]) -> None:
        """Let robots that were placed anew share a system again, or start in a new one of their own where they touch.

        So nothing that touched a robot before matters any more.
        """
        model, touching = scene_dynamics(self._spec), dict[bytes, bool]()
        systems = {}
        for row, position, velocity in zip(rows, qpos, qvel, strict=True):
            state = position.tobytes() + velocity.tobytes()
            if state not in touching:
                touching[state] = self._contact_predictor.predicts_contact(model.gaps(position), velocity)
            if touching[state]:
                systems[row] = _system(self._spec)
            elif self.isolated[row]:
                systems[row] = self._homes[row]
        self._move(systems)

    def _move(self, systems: dict[int, Any]) -> None:
        """Build the robots of some rows anew in these systems, in the state in which they are."""
        for row, system in systems.items():
            old, past = self._robots[row], self._scenes[row]
            with engine_settings(self._spec):
                scene, new = self._build(row, system)
            separate(scene, row + 1)
            new.set_qpos(old.get_qpos())
            new.set_qvel(old.get_qvel())
            new.set_qf(self._qf[row])
            for ours, theirs in zip(new.active_joints, old.active_joints, strict=True):
                gains = theirs.stiffness, theirs.damping, theirs.force_limit, theirs.drive_mode
                ours.set_drive_properties(*gains)
                ours.set_drive_target(theirs.drive_target)
                ours.set_drive_velocity_target(theirs.drive_velocity_target)
            if self._suspended[row]:
                _disable_gravity(new, True)
            past.clear()
            self._systems[row], self._scenes[row], self._robots[row] = system, scene, new
            self.isolated[row] = system is not self._homes[row]
        if systems:
            self._bind()

    def read_qpos(self, dtype: Any = np.float64) -> NDArray[Any]:
        """Joint positions [rad or m], a new array."""
        return np.concatenate([get() for get in self._get_qpos], dtype=dtype).reshape(self.size, self.dof)

    def read_qvel(self, dtype: Any = np.float64) -> NDArray[Any]:
        """Joint velocities [rad/s or m/s], a new array."""
        return np.concatenate([get() for get in self._get_qvel], dtype=dtype).reshape(self.size, self.dof)

    def passive_force(self, gravity: bool, coriolis: bool, dtype: Any = np.float64) -> NDArray[Any]:
        """Joint efforts that cancel gravity and Coriolis and centrifugal forces [N m or N], a new array."""
        forces = [compute(gravity, coriolis) for compute in self._passive]
        return np.concatenate(forces, dtype=dtype).reshape(self.size, self.dof)

    def write_qf(self, effort: NDArray[Any]) -> None:
        """Apply joint efforts [N m or N]. They persist until written again."""
        self._qf[...] = effort
        for set_qf, row in self._set_qf:
            set_qf(row)

    @property
    def qf(self) -> Float32:
        """The efforts last written, as the engine received them (a view)."""
        return self._qf

    def write_state(
        self, rows: Sequence[int], qpos: NDArray[Any], qvel: NDArray[Any], root: NDArray[Any] | None = None
    ) -> None:
        """Place robots ``rows``: positions and velocities (len(rows), dof); their efforts become zero.

        ``root`` (len(rows), 13), as :meth:`read_root` gives it, is by default the origin, at rest. Also the way back
        from NaN, which is why the root is placed too.
        """
        roots = np.tile(_ORIGIN, (len(rows), 1)) if root is None else root
        for row, position, velocity, base in zip(rows, qpos, qvel, roots, strict=True):
            robot = self._robots[row]
            robot.set_root_pose(sapien.Pose(base[:3], base[3:7]))
            robot.set_root_linear_velocity(base[7:10])
            robot.set_root_angular_velocity(base[10:])
            robot.set_qpos(position.astype(np.float32))
            robot.set_qvel(velocity.astype(np.float32))
            self._qf[row] = 0.0
            robot.set_qf(self._qf[row])
            if self._contents:
                self._contents[row].reset()
        if self._isolates:
            self._start_over(rows, qpos, qvel)

    def read_root(self) -> Float32:
        """Each robot's root link (M, 13): position, quaternion w, x, y, z, linear and angular velocity."""
        rows = [
            np.concatenate([pose.p, pose.q, robot.get_root_linear_velocity(), robot.get_root_angular_velocity()])
            for robot, pose in ((robot, robot.get_root_pose()) for robot in self._robots)
        ]
        return np.array(rows, np.float32)

    def read_content(self) -> Float32:
        """State of each scene's own content (M, numbers), NaN where a scene has less of it than another."""
        rows = [content.read() for content in self._contents] or [np.zeros(0, np.float32)] * self.size
        table = np.full((self.size, max(map(len, rows))), np.nan, np.float32)
        for line, row in zip(table, rows, strict=True):
            line[: len(row)] = row
        return table

    def content_sizes(self) -> list[int]:
        """How many of a scene's numbers in :meth:`read_content` are its own (M,)."""
        return [content.size for content in self._contents] or [0] * self.size

    def write_content(self, table: NDArray[Any]) -> None:
        """Put each scene's own content into the state that :meth:`read_content` gave."""
        for content, row in zip(self._contents, table, strict=False):
            content.write(row)

    def suspend(self, mask: NDArray[np.bool_]) -> None:
        """Let go of the robots of ``mask`` (M,): no effort reaches them, and no gravity. The others are in the loop."""
        if (mask == self._suspended).all():
            return
        for robot, held in zip(self._robots, mask, strict=True):
            _disable_gravity(robot, bool(held))
        self._suspended = mask.copy()
        self._bind()

    def read_poses(self) -> list[Float32]:
        """Poses of each scene's watched entities, (watched, 7) each."""
        return [content.poses() for content in self._contents]

    def write_drive(self, stiffness: NDArray[Any], damping: NDArray[Any], force_limit: NDArray[Any]) -> None:
        """Set PhysX's internal PD drive of every joint; each argument broadcasts to (M, dof).

        The URDF's joint damping, which SAPIEN also realises as drive damping, is added to ``damping``.
        """
        shape = (self.size, self.dof)
        damping = damping + self._damping
        limits = np.minimum(np.broadcast_to(force_limit, shape), np.finfo(np.float32).max)
        table = (np.broadcast_to(stiffness, shape), np.broadcast_to(damping, shape), limits)
        for joints, *rows in zip(self._joints, *table, strict=True):
            for joint, stiff, damp, limit in zip(joints, *rows, strict=True):
                joint.set_drive_properties(float(stiff), float(damp), float(limit), "force")

    def write_drive_target(self, position: NDArray[Any], velocity: NDArray[Any] | None = None) -> None:
        """Set the drives' targets (M, dof): position [rad or m] and velocity [rad/s or m/s]."""
        for joints, row in zip(self._joints, position.tolist(), strict=True):
            for joint, target in zip(joints, row, strict=True):
                joint.set_drive_target(target)
        if velocity is not None:
            for joints, row in zip(self._joints, velocity.tolist(), strict=True):
                for joint, target in zip(joints, row, strict=True):
                    joint.set_drive_velocity_target(target)

    def close(self) -> None:
        """Free the scenes. The pack cannot be used afterwards."""
        self._set_qf, self._get_qpos, self._get_qvel, self._passive = [], [], [], []
        self._get_contacts, self._links = [], {}
        self._joints, self._robots, self._contents = [], [], []
        self._scenes, self._systems, self._homes, self._steps = [], [], [], []


def _disable_gravity(robot: Any, floats: bool) -> None:
    for link in robot.links:
        link.disable_gravity = floats


def _system(spec: SceneSpec) -> Any:
    with engine_settings(spec):  # the solver and gravity are the system's
        system = physx.PhysxCpuSystem()
    system.timestep = spec.timestep
    return system
