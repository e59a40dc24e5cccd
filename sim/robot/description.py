"""Description of a robot: its joints, limits and defaults. Nothing here depends on an engine."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Bool, Document, Float64
from batchpid.arrays.digest import digest
from batchpid.arrays.elementwise import read_only
from batchpid.errors import InvalidArgumentError
from batchpid.motors.coupling import Coupling
from batchpid.sim.findings import LIMIT_TOLERANCE, Finding
from batchpid.sim.robot.merging import merge_links, place_links
from batchpid.sim.robot.mimics import coupling_of
from batchpid.sim.robot.parts import (
    DISSIPATION,
    FileDefaults,
    Joint,
    LinkMass,
    MjcfFile,
    Placement,
    Settings,
)
from batchpid.sim.robot.robot_model import RobotModel
from batchpid.sim.robot.self_collision import SelfContact, Srdf, self_contact
from batchpid.sim.robot.simulated_links import link_masses, rigid_tree
from batchpid.sim.robot.tables import Body, Tables
from batchpid.task_space.rigid_tree import RigidTree

GRAVITY_MARGIN = 2.0  # of the effort that holds the joint still
SPEED = 3.0  # [rad/s or m/s], at which the joint's damping is overcome
ACCELERATION = 30.0  # [rad/s^2 or m/s^2] of all joints at once
POSES = 50


def suggested_effort_limit(
    gravity: Float64,
    mass_matrix: Float64,
    friction: ArrayLike,
    damping: ArrayLike,
) -> Float64:
    """Return an effort limit for each joint (dof,) [N m or N], from gravity (n, dof) and M (n, dof,
    dof) at n poses.

    It is 2 (max |g_j| + friction) + damping * 3 rad/s + max sum_k |M_jk| * 30 rad/s^2: twice the
    effort that holds the joint still, plus the effort that accelerates all joints at once, in the
    worst directions.
    """
    still = np.abs(gravity).max(0) + np.asarray(friction)
    inertia = np.abs(mass_matrix).sum(2).max(0)
    efforts: Float64 = GRAVITY_MARGIN * still + SPEED * np.asarray(damping) + ACCELERATION * inertia
    return efforts


@dataclass(frozen=True, eq=False, repr=False)
class RobotDescription:
    """Robot as its file describes it; every array is in the order of ``joint_names``.

    ``tables`` are its bodies and shapes as in the file, after ``repairs``. ``joints`` are the
    degrees of freedom, the moving joints of ``all_joints``. ``settings`` come from a bundled robot,
    ``defaults`` and ``mjcf`` from an MJCF file, else None. ``package_dirs`` are the folders in
    which meshes are looked up first. ``actuators`` are its motors and sensors, None for ideal ones.
    ``base_start`` is the pose (7,) at which the file places a floating base, None if it does not.
    """

    name: str
    tables: Tables
    repairs: tuple[Finding, ...]
    path: Path
    srdf: Srdf
    self_collision: str
    joints: tuple[Joint, ...]
    dissipation: str
    fixed_base: bool
    settings: Settings | None
    package_dirs: tuple[Path, ...] = ()
    actuators: bp.Actuators | None = None
    defaults: FileDefaults | None = None
    mjcf: MjcfFile | None = None
    base_start: tuple[float, ...] | None = None

    def __repr__(self) -> str:
        total = sum(body.mass for body in self.links)
        owners = {shape.owner for shape in self.tables.shapes}
        shaped = sum(not body.mass and body.name in owners for body in self.links)
        mass = f"{total:.4g} kg"
        if shaped:
            by_shapes = f"{shaped} links with the mass of shapes"
            mass = f"{mass} and {by_shapes}" if total else by_shapes
        joints = textwrap.shorten(", ".join(self.joint_names), 100, placeholder=" ...")
        head = (
            f"{type(self).__name__}({self.name!r}, {self.dof} dof, {mass}, path={str(self.path)!r},"
        )
        return f"{head}\n  joints={joints})"

    @property
    def links(self) -> tuple[Body, ...]:
        """Links of the file, with mass and the joint above, breadth first."""
        return self.tables.bodies

    @cached_property
    def all_joints(self) -> tuple[Joint, ...]:
        """All joints, in SAPIEN's order: breadth first, fixed joints counted, joints of one parent
        in the order of the file.
        """
        return self.tables.joints

    @cached_property
    def bodies(self) -> Mapping[str, Placement]:
        """Placement of every link, by name, in its simulated body: links joined by fixed joints are
        one.
        """
        return place_links(self.tables)

    @property
    def dof(self) -> int:
        """Number of degrees of freedom."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the degrees of freedom, in breadth-first order, as in SAPIEN."""
        return tuple(joint.name for joint in self.joints)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the positions, "rad" or "m"."""
        return tuple(joint.unit for joint in self.joints)

    @property
    def lower(self) -> Float64:
        """Lower position limits (dof,) [rad or m]."""
        return np.array([joint.lower for joint in self.joints])

    @property
    def upper(self) -> Float64:
        """Upper position limits (dof,) [rad or m]."""
        return np.array([joint.upper for joint in self.joints])

    @property
    def effort_limit(self) -> Float64:
        """Effort limits (dof,) [N m or N], infinite where the URDF gives none."""
        return np.array([joint.effort_limit for joint in self.joints])

    @cached_property
    def design_effort_limit(self) -> Float64:
        """Effort limits (dof,) [N m or N] of designed and tuned gains.

        They are the URDF's, or :func:`batchpid.sim.robot.description.suggested_effort_limit` where
        it gives none.
        """
        limits = self.effort_limit
        # The dynamics of 50 poses take time that most robots need not spend.
        if np.isfinite(limits).all():
            return read_only(limits)
        qpos = self.sample(POSES)
        mass_matrix = self.coupling.mass_matrix(self.dynamics().mass_matrix(qpos))
        suggested = suggested_effort_limit(
            self.holding_efforts(qpos), mass_matrix, self.friction, self.damping
        )
        return read_only(np.where(np.isfinite(limits), limits, suggested))

    @property
    def velocity_limit(self) -> Float64:
        """Velocity limits (dof,) [rad/s or m/s], infinite where the URDF gives none. No engine
        enforces them.
        """
        return np.array([joint.velocity_limit for joint in self.joints])

    @property
    def continuous(self) -> Bool:
        """Mask (dof,) of the joints whose position wraps at a full turn."""
        return np.array([joint.continuous for joint in self.joints])

    @property
    def damping(self) -> Float64:
        """Viscous damping of the joints (dof,) [N m s/rad or N s/m]."""
        return np.array([joint.damping for joint in self.joints])

    @property
    def friction(self) -> Float64:
        """Coulomb friction of the joints (dof,) [N m or N]; 0 with ``dissipation`` "sapien": PhysX
        has its own.
        """
        return (
            np.array([joint.friction for joint in self.joints])
            * DISSIPATION[self.dissipation].modelled
        )

    @cached_property
    def coupling(self) -> Coupling:
        """Coupling of the mimic joints to their leaders; the identity without mimic joints."""
        return coupling_of(self.joints)

    @property
    def independent(self) -> Bool:
        """Mask (dof,) of the joints that are not followers."""
        return self.coupling.independent

    def coupled(self, qpos: ArrayLike) -> Float64:
        """Return ``qpos`` (..., dof) with the followers moved to match their leaders."""
        positions: Float64 = self.coupling.positions(np.asarray(qpos, np.float64))
        return positions

    @property
    def start(self) -> Float64:
        """Start pose (dof,) [rad or m]: the bundled settings' or the file's, else zero, clipped to
        the joint limits.
        """
        if self.settings is not None:
            return self.settings.start.copy()
        return self.coupled(
            np.clip(0.0 if self.defaults is None else self.defaults.start, self.lower, self.upper)
        )

    @property
    def target(self) -> Float64:
        """Pose (dof,) [rad or m] for a first move, within the limits.

        The target of the bundled settings, else a quarter of the way from the start to the farther
        limit of each joint, at most 0.5 rad or m.
        """
        if self.settings is not None:
            return self.settings.target.copy()
        # Toward the farther limit, so that the move is inside.
        above = self.upper - self.start
        below = self.lower - self.start
        distance = np.where(above >= -below, above, below)
        return self.coupled(self.start + np.clip(0.25 * distance, -0.5, 0.5))

    def params(self, **options: Any) -> bp.PIDParams:
        """Return PID parameters for this robot: :func:`batchpid.make_params` with the robot's
        values filled in.

        Effort limits and continuous joints come from the URDF and, for a bundled robot, kp, ki and
        kd from its settings; anti-windup is "conditional". ``options`` override these and add
        others.

        Raises
        ------
        InvalidArgumentError
            The robot has no gains and ``options`` has no ``kp``.
        """
        defaults: Document = {"joint_names": self.joint_names, "anti_windup": "conditional"}
        if self.continuous.any():
            defaults["continuous"] = self.continuous
        if not {"effort_min", "effort_max"} & set(options):
            defaults["effort_limit"] = self.effort_limit
        if self.settings is not None:
            defaults |= {gain: getattr(self.settings, gain) for gain in ("kp", "ki", "kd")}
        elif "kp" not in options:
            remedy = "pass kp=, ki=, kd= (scalar or per joint), or use robot.designed()"
            raise InvalidArgumentError("kp", f"robot {self.name!r} has no gains", remedy=remedy)
        return bp.make_params(joints=self.dof, **(defaults | options))

    def sample(self, count: int, seed: int = 0) -> Float64:
        """Return seeded poses (count, dof), uniform within the limits and half a turn of the start;
        followers match.
        """
        # A joint without limits would have no range to draw from.
        low = np.maximum(self.lower, self.start - np.pi)
        high = np.minimum(self.upper, self.start + np.pi)
        return self.coupled(np.random.default_rng(seed).uniform(low, high, (count, self.dof)))

    @cached_property
    def rigid_tree(self) -> RigidTree:
        """Tree of every link of the URDF, merged ones included, with the coupling and limits of the
        joints.

        Raises RobotError if a link's mass comes from its shapes, and a mesh cannot be read.
        """
        low, high = np.where(
            self.continuous,
            [[-np.inf], [np.inf]],
            [self.lower, self.upper],
        )
        limits = {"lower": low, "upper": high}
        return rigid_tree(self.tables, coupling=self.coupling, fixed_base=self.fixed_base, **limits)

    def mass_matrix(self, qpos: ArrayLike) -> Float64:
        """Return the joint-space mass matrices (n, dof, dof) [kg m^2 or kg] at ``qpos`` (n, dof),
        on a fixed base.
        """
        return self.dynamics().mass_matrix(np.atleast_2d(np.asarray(qpos, np.float64)))

    def holding_efforts(self, qpos: Float64) -> Float64:
        """Return the efforts (n, dof) [N m or N] that hold ``qpos`` against gravity; leaders hold
        followers.
        """
        still = np.zeros_like(qpos)
        efforts: Float64 = self.coupling.efforts(
            self.dynamics().inverse_dynamics(qpos, still, still)
        )
        return efforts

    def dynamics(self, ground: bool | None = None) -> RobotModel:
        """Return mass matrix, inverse and forward dynamics and contact of this robot on a fixed
        base.

        ``ground``: whether there is a ground at height 0; default :attr:`has_ground`.
        """
        has_ground = self.has_ground if ground is None else ground
        return _model(self, has_ground)

    @cached_property
    def self_contact(self) -> SelfContact:
        """Pairs of links that do not collide, and contact with the ground, computed at the first
        use.
        """
        return self_contact(self)

    @cached_property
    def link_masses(self) -> Mapping[str, LinkMass]:
        """Simulated mass of every link of the URDF, by name, computed at the first use."""
        return link_masses(self.tables, self.repairs)

    @property
    def ignored_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of links that do not collide."""
        return tuple((pair.first, pair.second) for pair in self.self_contact.pairs)

    @property
    def has_ground(self) -> bool:
        """True if scenes have a ground by default; False if a fixed base is so low that links start
        in it.
        """
        return not self.self_contact.reaches_ground

    def describe(self) -> Document:
        """Return a description of the simulated robot as plain values, equal for robots of equal
        content.

        The tables with the collision meshes, the .srdf, and the settings of a bundled robot
        are given by digests. The actuators are left out.
        """
        return {
            "robot": self.name,
            "content": self.digest,
            "srdf": digest(self.srdf.disabled, self.srdf.enabled),
            "settings": digest(self.settings) if self.defaults is None else digest(self.defaults),
            "mjcf": None if self.mjcf is None else digest(replace(self.mjcf, path="")),
            **{
                name: getattr(self, name)
                for name in ("self_collision", "dissipation", "fixed_base")
            },
            "base_start": self.base_start,
        }

    @cached_property
    def digest(self) -> str:
        """Digest of bodies, joints and shapes, with the content of mesh files in place of paths."""
        shapes = [shape._replace(file="") for shape in self.tables.shapes]
        return digest(self.tables.bodies, shapes, self.joints)

    def limit_violations(self, qpos: ArrayLike) -> list[tuple[int, int, float]]:
        """Return the entries of ``qpos`` (dof,) or (envs, dof) outside the joint limits, as (env,
        joint, value).
        """
        rows = np.atleast_2d(np.asarray(qpos, np.float64))
        outside = (rows < self.lower - LIMIT_TOLERANCE) | (rows > self.upper + LIMIT_TOLERANCE)
        return [
            (int(env), int(joint), float(rows[env, joint])) for env, joint in np.argwhere(outside)
        ]


@lru_cache(maxsize=8)
def _model(robot: RobotDescription, ground: bool) -> RobotModel:
    ignored = frozenset(map(frozenset, robot.ignored_pairs))
    # Merged, since the engines simulate merged links, too.
    simulated = merge_links(robot.tables)
    return RobotModel(rigid_tree(simulated), robot.coupling, simulated, ignored, ground)
