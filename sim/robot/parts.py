"""Parts of a robot's description: joints, dissipation, settings of bundled robots and of MJCF files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from batchpid.arrays.array_types import Float64
from batchpid.sim.findings import Finding
from batchpid.task_space.frames import SpatialInertia

MOVING_TYPES = ("revolute", "continuous", "prismatic")
"""URDF joint types that are degrees of freedom."""


@dataclass(frozen=True)
class Mimic:
    """Coupling of a joint's position to another's: ``q = multiplier * q_of_joint + offset``."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """Joint of a URDF. Units: rad, N m, rad/s (revolute) or m, N, m/s (prismatic).

    Limits that the URDF leaves out are infinite. ``axis`` is a direction in the joint's frame, not
    normalised.
    """

    name: str
    type: str
    parent_link: str
    child_link: str
    lower: float = -math.inf
    upper: float = math.inf
    effort_limit: float = math.inf
    velocity_limit: float = math.inf
    acceleration_limit: float = math.inf
    soft_lower: float = -math.inf
    soft_upper: float = math.inf
    damping: float = 0.0
    friction: float = 0.0
    mimic: Mimic | None = None
    axis: tuple[float, ...] = (1.0, 0.0, 0.0)
    has_motor: bool = True
    """False where an MJCF file has actuators, and none for this joint."""

    @property
    def moves(self) -> bool:
        """True if the joint is a degree of freedom."""
        return self.type in MOVING_TYPES

    @property
    def continuous(self) -> bool:
        """True if positions wrap at a full turn (URDF type ``continuous``)."""
        return self.type == "continuous"

    @property
    def unit(self) -> str:
        """Unit of position: ``"m"`` for a prismatic joint, else ``"rad"``."""
        if self.type == "prismatic":
            return "m"
        return "rad"

    @property
    def effort_unit(self) -> str:
        """Unit of effort: ``"N"`` for a prismatic joint, else ``"N m"``."""
        return {"rad": "N m", "m": "N"}[self.unit]


class DisabledPair(NamedTuple):
    """Two links that do not collide.

    ``reason`` is one of MoveIt's: "Adjacent" (neighbours), "Default" (in contact at the start
    pose), "Always" (in nearly every sampled pose), "Never" or "User" (in an .srdf).
    """

    first: str
    second: str
    reason: str

    @property
    def links(self) -> frozenset[str]:
        """Names of the links."""
        return frozenset((self.first, self.second))


class Srdf(NamedTuple):
    """Pairs that an .srdf disables and enables, and findings about it."""

    disabled: tuple[DisabledPair, ...] = ()
    enabled: frozenset[frozenset[str]] = frozenset()
    findings: tuple[Finding, ...] = ()


class LinkMass(NamedTuple):
    """Simulated mass of a link of the URDF.

    ``mass`` [kg]; ``source``: "inertial", "repaired", "shapes" (the collision shapes, at SAPIEN's
    density) or "none"; ``gyration``: largest radius of gyration about the center of mass [m],
    sqrt(I/m); ``size``: diagonal [m] of the box around its collision shapes, 0 without;
    ``inertia``: in the link's frame, None without mass.
    """

    mass: float
    source: str
    gyration: float
    size: float
    inertia: SpatialInertia | None = None


class Placement(NamedTuple):
    """Frame of a link in the simulated ``link`` that it is part of: ``position`` (3,) [m], ``wxyz``
    (4,).
    """

    link: str
    position: Float64
    wxyz: Float64


@dataclass(frozen=True)
class Settings:
    """Tutorial's poses and gains of a bundled robot, in joint order.

    ``start``, ``target``: (dof,) [rad or m]; ``kp``, ``ki``, ``kd``: (dof,) of the PID;
        ``drive_stiffness`` and
    ``drive_damping`` of PhysX's internal drive; ``rate_hz``: control and simulation rate;
    ``notes``: differences from the tutorial, in words.
    """

    start: Float64
    target: Float64
    kp: Float64
    ki: Float64
    kd: Float64
    drive_stiffness: float
    drive_damping: float
    rate_hz: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class FileDefaults:
    """Start pose (dof,) [rad or m] of an MJCF file, and the gains (dof,) of its servos with the
    limits of their integrals [N m or N]; None without servos.
    """

    start: Float64
    kp: Float64 | None = None
    ki: Float64 | None = None
    kd: Float64 | None = None
    integral_limit: Float64 | None = None


class Reading(NamedTuple):
    """How a file was read, and what it says besides bodies, shapes and joints.

    ``package_dirs`` are the folders in which meshes are looked up first. ``defaults`` come from an
    MJCF file. ``base_start`` is the pose (7,) at which the file places a floating base, None if it
    does not.
    """

    self_collision: str
    srdf: Srdf
    package_dirs: tuple[Path, ...]
    defaults: FileDefaults | None
    base_start: tuple[float, ...] | None


@dataclass(frozen=True)
class MjcfFile:
    """MJCF file that MuJoCo simulates itself, with everything in it besides the robot.

    ``is_whole`` says whether all of it is compiled
    (:func:`batchpid.sim.robot.mjcf.model.compile_scene`), and ``content`` is the digest of the
    model. ``bodies`` are the names of all bodies, ``falling`` the names of bodies on free joints
    other than the robot's. ``loops`` are the equality constraints that close loops of the robot's
    links. ``losses`` are findings of what is lost in an engine that does not simulate the file.
    ``is_alone`` is False if more than the robot moves. ``has_floor`` is True if planes of
    the world can collide, unless the root is fixed to the origin in place of its free joint.
    ``friction`` is the coefficient of its ground, the first of these planes.
    """

    path: str
    is_whole: bool
    content: str
    bodies: tuple[str, ...]
    falling: tuple[str, ...] = ()
    loops: tuple[str, ...] = ()
    losses: tuple[Finding, ...] = ()
    is_alone: bool = True
    has_floor: bool = False
    friction: float = 1.0


JOINT_HEADERS = (
    "",
    "joint",
    "type",
    "limits",
    "effort",
    "velocity",
    "damping",
    "friction",
    "parent > child link",
)


def joint_rows(joints: Iterable[Joint]) -> Iterator[list[str]]:
    """Yield the cells of each joint under :data:`JOINT_HEADERS`. Moving joints are numbered as in
    qpos.
    """
    index = 0
    for joint in joints:
        links = f"{joint.parent_link} > {joint.child_link}"
        if not joint.moves:
            yield ["-", joint.name, joint.type, *"-----", links]
            continue
        yield [
            str(index),
            joint.name,
            joint.type,
            _range(joint),
            _bound(joint.effort_limit, f" {joint.effort_unit}"),
            _bound(joint.velocity_limit, f" {joint.unit}/s"),
            f"{joint.damping:g}",
            f"{joint.friction:g}",
            links,
        ]
        index += 1


def _range(joint: Joint) -> str:
    limits = joint.lower, joint.upper
    if any(map(math.isfinite, limits)):
        return f"{_bound(limits[0])} to {_bound(limits[1])} {joint.unit}"
    return "none"


def _bound(value: float, unit: str = "") -> str:
    if math.isfinite(value):
        return f"{value:.5g}{unit}"
    return "none"


CONTACT_FRICTION = 0.3
"""Coefficient of sliding friction of every shape and of the ground: SAPIEN's default material."""


class Dissipation(NamedTuple):
    """Friction and damping in the engine.

    ``joint_friction``: PhysX's dimensionless coefficient of every joint; ``link_damping``: damping
        of every link [1/s];
    ``modelled``: whether :mod:`batchpid.motors.friction` computes the joints' friction and damping,
        in the URDF's
    units, instead of the engine.
    """

    joint_friction: float
    link_damping: float
    modelled: bool


DISSIPATION = {
    "urdf": Dissipation(joint_friction=0.0, link_damping=0.0, modelled=True),
    "sapien": Dissipation(
        joint_friction=0.05, link_damping=0.05, modelled=False
    ),  # SAPIEN 3's defaults
}
"""Values of the option ``dissipation`` of :meth:`batchpid.sim.Robot.load`."""
