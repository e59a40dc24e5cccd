"""A pack of scenes in one process, read and written as arrays. The only module that touches SAPIEN.

A pack is M scenes, one robot each, in step with each other, some of them to a PhysX system. All stand at the origin;
the shapes of each scene carry a collision group of their own, so that scenes never meet. That is bit-identical to one
system per scene, and a fifth to a third cheaper.

The loop needs a dozen calls and no more (:class:`Pack`); another gateway to the engine has only these to provide.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import RobotError

from .content import Build, Content, HeadlessScene
from .physics import DISSIPATION, Physics
from .urdf import Joint

with warnings.catch_warnings():
    # Without a system Vulkan SAPIEN warns that it falls back to its own; nothing here renders.
    warnings.filterwarnings("ignore", message=".*libvulkan.*")
    warnings.filterwarnings("ignore", message=".*pkg_resources.*")
    import sapien
    from sapien import physx
    from sapien.wrapper.articulation_builder import ArticulationBuilder

GRAVITY = (0.0, 0.0, -9.81)

_ORIGIN = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], np.float32)

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class SceneSpec:
    """Everything that decides how a scene is built, picklable.

    ``urdf`` is sanitised text (see :mod:`sim.urdf`); ``joints`` the degrees of freedom in SAPIEN's order.
    """

    urdf: str
    srdf: str | None
    joints: tuple[Joint, ...]
    timestep: float
    physics: Physics
    dissipation: str = "urdf"
    ground: bool = True
    fixed_base: bool = True
    build: Build | None = None
    gravity: tuple[float, float, float] = GRAVITY


def parse(spec: SceneSpec) -> ArticulationBuilder:
    """Parse the robot once; the builder makes any number of copies.

    Raises
    ------
    RobotError
        SAPIEN's loader refuses the description, or numbers its joints in another order than ours.
    """
    loader = _bare_scene(physx.PhysxCpuSystem()).create_urdf_loader()
    loader.fix_root_link = spec.fixed_base
    with _in_memory(spec.urdf) as urdf, _in_memory(spec.srdf) as srdf:
        try:
            builders, actors, _ = loader.parse(urdf, srdf)
        except Exception as error:
            raise RobotError(f"SAPIEN cannot load the robot: {error}; correct the URDF") from error
    if len(builders) != 1 or actors:
        raise RobotError(
            "the URDF does not describe one articulated robot; it needs at least one moving joint"
        )
    _part(builders[0])
    return builders[0]


def _part(builder: ArticulationBuilder) -> None:
    """Let links that fixed joints tie together not touch: they cannot move apart, and the solver would shake them.

    PhysX leaves out a parent and its child only, not a hand whose flange is a link of its own. Shapes that share a bit
    of the third word never touch; each such group is given one that no pair of the .srdf uses, while there are any.
    """
    body: dict[str, str] = {}
    groups: dict[str, list[Any]] = {}
    for link in builder.link_builders:
        tied = link.parent is not None and link.joint_record.joint_type == "fixed"
        body[link.name] = body[link.parent.name] if tied else link.name
        groups.setdefault(body[link.name], []).append(link)
    used = 0
    for link in builder.link_builders:
        used |= link.collision_groups[2]
    free = (1 << bit for bit in range(32) if not used >> bit & 1)
    for links in groups.values():
        solid = [link for link in links if link.collision_records]
        if len(links) > 2 and len(solid) > 1:
            bit = next(free, 0)
            for link in solid:
                link.collision_groups[2] |= bit


@contextmanager
def _in_memory(text: str | None) -> Iterator[str]:
    """Path of a file that holds ``text``, for a loader that takes no text; whoever is killed leaves none behind."""
    if text is None:
        yield ""
        return
    with open(os.memfd_create("batchpid-text"), "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield f"/proc/self/fd/{file.fileno()}"


class Probe:
    """One robot by itself on a fixed base, asked about poses qpos (n, dof); nothing of it moves in time.

    The dynamics are Pinocchio's, on the model that SAPIEN derives.
    """

    def __init__(self, spec: SceneSpec) -> None:
        with _global_config(spec):
            self._system = physx.PhysxCpuSystem()
            self._system.timestep = 1e-6
            self._scene = _bare_scene(self._system)
            self._robot = _build_robot(parse(spec), self._scene, spec)
            if spec.ground:
                self._scene.add_ground(0.0, render=False)
        self._dof = self._robot.dof
        self._model = self._robot.create_pinocchio_model()
        # Links that fixed joints tie together are one body; its number, per link name. The base and the ground are 0.
        self._body: dict[str, int] = {}
        for number, link in enumerate(self._robot.links):
            tied = link.parent is not None and link.joint.type == "fixed"
            self._body[link.name] = self._body[link.parent.name] if tied else number

    def mass_matrix(self, qpos: NDArray[Any]) -> NDArray[np.float64]:
        """Joint-space mass matrices (n, dof, dof) [kg m^2 or kg]."""
        matrices = np.empty((len(qpos), self._dof, self._dof))
        for matrix, row in zip(matrices, np.asarray(qpos, np.float64), strict=True):
            matrix[...] = self._model.compute_generalized_mass_matrix(row)
        return matrices

    def inverse_dynamics(
        self, qpos: NDArray[Any], qvel: NDArray[Any], qacc: NDArray[Any]
    ) -> NDArray[np.float64]:
        """Efforts (n, dof) [N m or N] of a motion, gravity included, friction and damping left out."""
        rows = zip(*(np.asarray(table, np.float64) for table in (qpos, qvel, qacc)), strict=True)
        return np.array([self._model.compute_inverse_dynamics(*row) for row in rows])

    def forward_dynamics(
        self, qpos: NDArray[Any], qvel: NDArray[Any], effort: NDArray[Any]
    ) -> NDArray[np.float64]:
        """Accelerations (n, dof) [rad/s^2 or m/s^2] under ``effort`` [N m or N], gravity included, damping left out."""
        rows = zip(*(np.asarray(table, np.float64) for table in (qpos, qvel, effort)), strict=True)
        return np.array([self._model.compute_forward_dynamics(*row) for row in rows])

    def touches(self, qpos: NDArray[Any], clearance: float = 0.0) -> NDArray[np.bool_]:
        """Whether links come nearer than ``clearance`` [m] to each other or to the ground (n,).

        Links that fixed joints tie together do not count, nor the base and what is tied to it with the ground.
        """
        return np.array([self._touches(row.astype(np.float32), clearance) for row in np.asarray(qpos)])

    def _touches(self, qpos: Float32, clearance: float) -> bool:
        self._robot.set_qpos(qpos)
        self._robot.set_qvel(np.zeros_like(qpos))
        self._system.step()
        for contact in self._system.get_contacts():
            if len({self._body.get(body.entity.name, 0) for body in contact.bodies}) == 1:
                continue
            if any(point.separation < clearance for point in contact.points):
                return True
        return False


@lru_cache(maxsize=8)
def probe(spec: SceneSpec) -> Probe:
    """Return the probe of this scene, built at most once."""
    return Probe(spec)


class Pack:
    """M scenes of one robot, ``system_size`` to a PhysX system. Arrays are (M, dof), in SAPIEN's order, SI units."""

    def __init__(
        self,
        builder: ArticulationBuilder,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        system_size: int = 8,
    ) -> None:
        with _global_config(spec):
            # PhysX solves the contacts of free bodies in an order that depends on what else its system holds, so
            # scenes with content of their own do not share one: that would cost the last bits.
            shared = system_size if spec.build is None else 1
            self._systems = [physx.PhysxCpuSystem() for _ in range(-(-size // shared))]
            for system in self._systems:
                system.timestep = spec.timestep
            # SAPIEN frees a scene's robot with the Python Scene, and then steps an empty world in silence.
            self._scenes = [_bare_scene(self._systems[index // shared]) for index in range(size)]
            self._robots = [_build_robot(builder, scene, spec) for scene in self._scenes]
            if spec.ground:
                for scene in self._scenes:
                    scene.add_ground(0.0, render=False)
            build = spec.build
            self._contents = (
                []
                if build is None
                else [Content(build, scene, env) for env, scene in enumerate(self._scenes, start=first_env)]
            )
        for group, scene in enumerate(self._scenes, start=1):
            _separate(scene, group)
        self.size, self.dof = size, self._robots[0].dof
        self._joints = [robot.active_joints for robot in self._robots]
        self._damping = np.array([[joint.damping for joint in self._joints[0]]])
        self._get_qpos = [robot.get_qpos for robot in self._robots]
        self._get_qvel = [robot.get_qvel for robot in self._robots]
        self._passive = [robot.compute_passive_force for robot in self._robots]
        # set_qf from a kept row view costs half of what a fresh one does.
        self._qf = np.zeros((size, self.dof), np.float32)
        self._set_qf = [(robot.set_qf, row) for robot, row in zip(self._robots, self._qf, strict=True)]
        self._held: NDArray[np.bool_] = np.zeros(size, bool)
        self._steps = [system.step for system in self._systems]

    def step(self) -> None:
        """One sim step of every scene."""
        for step in self._steps:
            step()

    def alter(self, row: int, link: str, mass: float, friction: float) -> None:
        """Add ``mass`` [kg] to a link of robot ``row``, and ``friction`` to each of its joints."""
        robot = self._robots[row]
        for body in robot.links:
            if body.name == link:
                body.set_mass(body.mass + mass)
        for joint in robot.active_joints:
            joint.set_friction(joint.friction + friction)

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

    def read_root(self) -> Float32:
        """Each robot's root link (M, 13): position, quaternion w, x, y, z, linear and angular velocity."""
        rows = [
            np.concatenate(
                [pose.p, pose.q, robot.get_root_linear_velocity(), robot.get_root_angular_velocity()]
            )
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

    def hold(self, mask: NDArray[np.bool_]) -> None:
        """Let go of the robots of ``mask`` (M,): no effort reaches them, and no gravity. The others are in the loop."""
        if (mask == self._held).all():
            return
        for robot, held in zip(self._robots, mask, strict=True):
            for link in robot.links:
                link.disable_gravity = bool(held)
        self._held = mask.copy()
        rows = zip(self._robots, self._qf, mask, strict=True)
        self._set_qf = [(robot.set_qf, row) for robot, row, held in rows if not held]

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
        self._joints, self._robots, self._contents = [], [], []
        self._scenes, self._systems, self._steps = [], [], []


def _bare_scene(system: Any) -> Any:
    # sapien.Scene() would build a render system, which fails (and can crash the process) without a device.
    return HeadlessScene([system])


@contextmanager
def _global_config(spec: SceneSpec) -> Iterator[None]:
    """SAPIEN's process-wide settings, ours while a pack is built, then the caller's again.

    Every setting is given, so that a result depends on nothing that the caller's process did before.
    """
    scene, body = physx.get_scene_config(), physx.get_body_config()
    shape, material = physx.get_shape_config(), physx.get_default_material()
    physx.set_scene_config(
        gravity=np.array(spec.gravity, np.float32),
        bounce_threshold=2.0,
        enable_pcm=True,
        enable_tgs=spec.physics.solver == "TGS",
        enable_ccd=False,
        enable_enhanced_determinism=False,
        enable_friction_every_iteration=True,
        cpu_workers=0,
    )
    physx.set_body_config(
        solver_position_iterations=spec.physics.position_iterations,
        solver_velocity_iterations=spec.physics.velocity_iterations,
        sleep_threshold=0.0,
    )
    physx.set_shape_config(contact_offset=0.01, rest_offset=0.0)
    physx.set_default_material(0.3, 0.3, 0.1)
    try:
        yield
    finally:
        physx.set_scene_config(scene)
        physx.set_body_config(body)
        physx.set_shape_config(shape)
        physx.set_default_material(material.static_friction, material.dynamic_friction, material.restitution)


def _build_robot(builder: ArticulationBuilder, scene: Any, spec: SceneSpec) -> Any:
    builder.set_scene(scene)
    robot = builder.build()
    names = [joint.name for joint in robot.active_joints]
    if names != [joint.name for joint in spec.joints]:
        raise RobotError(f"SAPIEN numbers the joints {names}, not {[joint.name for joint in spec.joints]}")
    robot.set_sleep_threshold(0.0)
    dissipation = DISSIPATION[spec.dissipation]
    for link in robot.links:
        link.set_linear_damping(dissipation.link_damping)
        link.set_angular_damping(dissipation.link_damping)
    for joint, ours in zip(robot.active_joints, spec.joints, strict=True):
        # SAPIEN parses <dynamics friction> and never applies it.
        friction = dissipation.joint_friction
        joint.set_friction(ours.friction if friction is None else friction)
    return robot


def _separate(scene: Any, group: int) -> None:
    """Give every shape of ``scene`` the collision group ``group``: shapes of different groups never touch.

    PhysX's filter, as SAPIEN sets it up, compares the upper 16 bits of the fourth word.
    """
    for entity in scene.entities:
        for component in entity.components:
            if isinstance(component, physx.PhysxRigidBaseComponent):
                for shape in component.collision_shapes:
                    words = list(shape.get_collision_groups())
                    words[3] = (words[3] & 0xFFFF) | (group << 16)
                    shape.set_collision_groups(words)
