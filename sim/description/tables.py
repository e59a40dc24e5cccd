"""Record of a robot: bodies with their joints, and shapes, as rows of arrays and names.

A :class:`Tables` is made once, by the reader of a URDF (:mod:`batchpid.sim.description.urdf`) or of
an MJCF file (:mod:`batchpid.sim.description.mjcf`). Everything else reads it: engines, rigid trees,
distances, exports and pictures.

:func:`batchpid.sim.description.merging.merge_links` makes the tables that engines simulate, with
one body for all links that fixed joints hold together. ``SceneSpec.tables``
(:class:`batchpid.sim.engine.scene_spec.SceneSpec`) has a row for each link of the file,
``SceneSpec.simulated`` the merged rows.

Limits, damping and friction are those of the file. The degrees of freedom of a robot,
``SceneSpec.joints``, are the same joints with limits, friction and damping of followers moved to
their leaders. Reflected inertia of motors is in the robot's actuators.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import read_only
from batchpid.arrays.trees import digest, mapped
from batchpid.motors import Actuators
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.shapes import LEAST_MASS, Shape, possible_inertia
from batchpid.task_space.frames import SpatialInertia, matrix_of

CONTACT_FRICTION = 0.3
"""Coefficient of sliding friction of every shape and of the ground: SAPIEN's default material."""
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


class Placement(NamedTuple):
    """Frame of a link in the simulated ``link`` that it is part of: ``position`` (3,) [m], ``wxyz``
    (4,).
    """

    link: str
    position: Float64
    wxyz: Float64


ORIGIN = read_only(np.zeros(3))
NO_TURN = read_only(np.array([1.0, 0.0, 0.0, 0.0]))
NO_INERTIA = read_only(np.zeros((3, 3)))


class Body(NamedTuple):
    """Rigid body, and the joint above it. Its frame is the frame of the joint at position 0."""

    name: str
    joint: Joint | None
    """Joint between the parent and this body: type, axis in the frame of the joint (not
    normalised), limits, damping, friction, mimic; ``joint.parent_link`` names the parent. None for
    the base.
    """
    position: Float64 = ORIGIN
    """Origin of the joint in the frame of the parent (3,) [m]."""
    wxyz: Float64 = NO_TURN
    """Orientation of the joint in the frame of the parent (4,)."""
    mass: float = 0.0
    """Mass [kg]. 0 in a row of the file without ``<inertial>``; merged rows have a positive mass."""
    center: Float64 = ORIGIN
    """Center of mass in the frame of the body (3,) [m]."""
    inertia: Float64 = NO_INERTIA
    """Inertia tensor about the center of mass (3, 3) [kg m^2], in the axes of ``inertia_wxyz``."""
    inertia_wxyz: Float64 = NO_TURN
    """Orientation of the axes of ``inertia`` in the frame of the body (4,)."""

    @property
    def spatial_inertia(self) -> SpatialInertia:
        """Inertia of the body in its frame."""
        turn = matrix_of(self.inertia_wxyz)
        return SpatialInertia(self.mass, self.center, read_only(turn @ self.inertia @ turn.T))


class Visual(NamedTuple):
    """Shape that is drawn."""

    shape: Shape | None
    """Shape, with the path of its mesh; None where it cannot be read."""
    rgba: tuple[float, ...] | None = None
    """Colour, None where the file gives none."""
    problem: str | None = None
    """Reason for which it cannot be read."""


@dataclass(frozen=True, eq=False)
class Tables:
    """Tables of a robot. Equal content makes them equal, in any process; they can be pickled."""

    bodies: tuple[Body, ...]
    """Breadth first from the base, siblings in the order of the file."""
    shapes: tuple[Shape, ...]
    """In the order of the bodies and of the file."""
    links: Mapping[str, Placement]
    """Body and place in it of each link of the file, in the order of the file's rows."""
    visuals: Mapping[str, tuple[Visual, ...]] = field(default_factory=dict)
    """Drawn shapes by link; they are no part of the digest. Merged tables have none."""

    def __post_init__(self) -> None:
        # Frozen, so that caches and processes can share them.
        vars(self).update(
            bodies=tuple(Body._make(map(read_only, body)) for body in self.bodies),
            shapes=tuple(Shape._make(map(read_only, shape)) for shape in self.shapes),
            visuals={link: mapped(read_only, rows) for link, rows in self.visuals.items()},
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tables) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @cached_property
    def digest(self) -> str:
        """Digest of the content, with the paths of mesh files."""
        return digest(self.bodies, self.shapes, self.links)

    def shapes_of(self, link: str) -> list[Shape]:
        """Return the shapes of a link of the file."""
        return [shape for shape in self.shapes if shape.owner == link]

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Joints of all bodies but the base, in their order."""
        return tuple(body.joint for body in self.bodies if body.joint is not None)


def unique(name: str, names: set[str]) -> str:
    """Return ``name``, with a number if it is one of ``names``, and add it to them."""
    new = name
    number = 2
    while new in names:
        new = f"{name}_{number}"
        number += 1
    names.add(new)
    return new


def with_mass(
    body: Body,
    mass: float,
    center: Float64,
    inertia: Float64,
    wxyz: Float64,
    findings: list[Finding],
) -> Body:
    """Return ``body`` with a mass [kg] and an inertia that a body can have. If that is another one
    than ``inertia``, a finding is added.
    """
    inertia, repair = possible_inertia(mass, inertia)
    if repair is not None:
        text, detail = repair
        remedy = "correct <inertia>"
        findings.append(Finding("inertia", text, remedy, link=body.name, detail=detail))
    return body._replace(
        mass=mass,
        center=center,
        inertia=inertia,
        inertia_wxyz=wxyz,
    )


def without_mass(body: Body) -> Body:
    """Return ``body`` with next to no mass, in place of that of its shapes."""
    tensor = 1e-3 * LEAST_MASS * np.eye(3)
    return body._replace(
        mass=LEAST_MASS,
        center=ORIGIN,
        inertia=tensor,
        inertia_wxyz=NO_TURN,
    )


def breadth_first(
    bodies: Iterable[Body],
    shapes: Iterable[Shape],
    visuals: Mapping[str, tuple[Visual, ...]] | None = None,
) -> Tables:
    """Return the tables of the base, which has no joint, and all bodies below it, breadth first."""
    below: dict[str, list[Body]] = defaultdict(list)
    ordered = []
    for body in bodies:
        if body.joint is None:
            ordered.append(body)
        else:
            below[body.joint.parent_link].append(body)
    # The list grows while it is read, which is breadth first.
    for body in ordered:
        ordered += below[body.name]
    row = {body.name: index for index, body in enumerate(ordered)}
    links = {name: Placement(name, ORIGIN, NO_TURN) for name in row}
    of_rows = [shape for shape in shapes if shape.body in row]
    of_rows.sort(key=lambda shape: row[shape.body])
    return Tables(tuple(ordered), tuple(of_rows), links, visuals or {})


@dataclass(frozen=True)
class Settings:
    """Tutorial's poses and gains of a bundled robot, in joint order.

    ``start``, ``target``: (dof,) [rad or m]; ``kp``, ``ki``, ``kd``: (dof,) of the PID;
    ``drive_stiffness`` and ``drive_damping`` of PhysX's internal drive; ``rate_hz``: control and
    simulation rate; ``notes``: differences from the tutorial, in words.
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
class MjcfFile:
    """MJCF file that MuJoCo simulates itself, with everything in it besides the robot.

    ``content`` is the digest of the model. ``bodies`` are the names of all bodies, ``falling`` the
    names of bodies on free joints other than the robot's. ``loops`` are the equality constraints
    that close loops of the robot's links. ``lost`` describes the content that is missing in an
    engine which does not simulate the file. ``is_alone`` is False if more than the robot moves.
    ``has_floor`` is True if planes of the world can collide, unless the root is fixed to the origin
    in place of its free joint. ``friction`` is the coefficient of its ground, the first of these
    planes.
    """

    path: str
    content: str
    bodies: tuple[str, ...]
    falling: tuple[str, ...] = ()
    loops: tuple[str, ...] = ()
    lost: str = ""
    is_alone: bool = True
    has_floor: bool = False
    friction: float = 1.0


class Source(NamedTuple):
    """Robot as its file gives it, and how the file was read."""

    path: Path
    name: str
    tables: Tables
    repairs: tuple[Finding, ...]
    """Findings, one for each change that the simulation needs."""
    fixed_base: bool
    base_start: tuple[float, ...] | None
    """Pose (7,) at which the file places a floating base, None if it does not."""
    start: Float64 | None = None
    """Start pose (dof,) [rad or m] of the file, None if it has none."""
    gains: Mapping[str, Float64] | None = None
    """Gains ``kp`` and ``kd`` of the servos of an MJCF file (dof,); None without servos."""
    mjcf: MjcfFile | None = None
    actuators: Actuators | None = None
    disabled: tuple[DisabledPair, ...] = ()
    """Pairs of links that do not collide, by the file or its .srdf."""
    enabled: frozenset[frozenset[str]] = frozenset()
    """Pairs of links that an .srdf enables."""
    self_collision: str = "auto"
    dissipation: str = "urdf"
