"""Record of a robot: bodies with their joints, and collision shapes, as rows of arrays and names.

A :class:`Tables` is made once, by the reader of a URDF (:mod:`batchpid.sim.robot.urdf`) or of an
MJCF file (:mod:`batchpid.sim.robot.mjcf.reader`). Everything else reads it: engines, rigid
trees, distances and exports.

:func:`batchpid.sim.robot.merging.merge_links` makes the tables that engines simulate, with one body
for all links that fixed joints hold together. :attr:`batchpid.sim.engine.scene_spec.SceneSpec.tables`
has a row for each link of the file, ``SceneSpec.simulated`` the merged rows.

Limits, damping and friction are those of the file. The degrees of freedom of a robot,
``SceneSpec.joints``, are the same joints with limits, friction and damping of followers moved to
their leaders. Reflected inertia of motors is in the robot's actuators.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.digest import digest
from batchpid.arrays.elementwise import read_only
from batchpid.motors import Actuators
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.inertia import LEAST_MASS
from batchpid.sim.geometry.shapes import Shape
from batchpid.sim.robot.parts import DisabledPair, FileDefaults, Joint, MjcfFile, Placement
from batchpid.task_space.frames import SpatialInertia, matrix_of

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


@dataclass(frozen=True, eq=False)
class Tables:
    """Tables of a robot. Equal content makes them equal, in any process; they can be pickled."""

    bodies: tuple[Body, ...]
    """Breadth first from the base, siblings in the order of the file."""
    shapes: tuple[Shape, ...]
    """In the order of the bodies and of the file; after a merge the mirrored shapes of a body are its
    last.
    """
    links: Mapping[str, Placement]
    """Body and place in it of each link of the file, in the order of the file's rows."""

    def __post_init__(self) -> None:
        # Frozen, so that caches and processes can share them.
        vars(self).update(
            bodies=tuple(Body._make(map(read_only, body)) for body in self.bodies),
            shapes=tuple(Shape._make(map(read_only, shape)) for shape in self.shapes),
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


def without_mass(body: Body) -> Body:
    """Return ``body`` with next to no mass, in place of that of its shapes."""
    tensor = 1e-3 * LEAST_MASS * np.eye(3)
    return body._replace(mass=LEAST_MASS, center=ORIGIN, inertia=tensor, inertia_wxyz=NO_TURN)


def breadth_first(bodies: Iterable[Body], shapes: Iterable[Shape]) -> Tables:
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
    return Tables(tuple(ordered), tuple(of_rows), links)


class Source(NamedTuple):
    """Robot as its file gives it.

    ``repairs`` are findings, one for each change that the simulation needs. ``base_start`` is the
    pose (7,) at which the file places a floating base.
    """

    name: str
    tables: Tables
    repairs: tuple[Finding, ...]
    fixed_base: bool
    base_start: tuple[float, ...] | None
    mjcf: MjcfFile | None = None
    pairs: tuple[DisabledPair, ...] = ()
    """Pairs of links that do not collide."""
    defaults: FileDefaults | None = None
    actuators: Actuators | None = None
