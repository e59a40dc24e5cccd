"""Masses of a robot's links and bodies, and its rigid tree, from its tables.

A link without ``<inertial>`` has the inertia of its collision shapes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import read_only
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.shapes import Shape, half_extents
from batchpid.sim.robot.merging import Separate, link_inertias, merge_links, place_links
from batchpid.sim.robot.parts import LinkMass
from batchpid.sim.robot.tables import Tables
from batchpid.task_space.frames import SpatialInertia, matrix_of, rotate
from batchpid.task_space.rigid_tree import GRAVITY, RigidTree


class Part(NamedTuple):
    """Link of the URDF, as a part of a simulated body."""

    inertia: SpatialInertia
    """Inertia of the link in the frame of the body."""
    axes: Float64
    """Axes of the link's frame in the body's frame, as columns (3, 3)."""
    column: int | None
    """Index among the links that vary; None for a link that does not vary."""


class BodyParts(NamedTuple):
    """Links with mass of a simulated body, and the place of the payload in its frame (3,) [m]; None
    without payload.
    """

    parts: list[Part]
    payload: Float64 | None


def varied_bodies(
    tables: Tables,
    separate: Separate,
    carrier: str,
    links: Sequence[str],
) -> dict[str, BodyParts]:
    """Return the simulated bodies with varying mass, by name: they contain ``links`` or
    ``carrier``.
    """
    placements = place_links(tables, separate)
    inertias = link_inertias(tables)
    parts: dict[str, list[Part]] = defaultdict(list)
    for name, at in placements.items():
        if name in inertias:
            inertia = inertias[name].moved(at.position, at.wxyz)
            column = links.index(name) if name in links else None
            parts[at.link].append(Part(inertia, matrix_of(at.wxyz), column))
    # The payload is at the center of mass of its carrier, or at the origin of one without mass.
    at = placements[carrier]
    place = at.position
    if carrier in inertias:
        place = inertias[carrier].moved(at.position, at.wxyz).center
    varied = {}
    for body in merge_links(tables, separate).bodies:
        # A body without mass of its links varies as it is simulated.
        members = parts[body.name] or [Part(body.spatial_inertia, np.eye(3), None)]
        if body.name == at.link or any(part.column is not None for part in members):
            varied[body.name] = BodyParts(members, place if body.name == at.link else None)
    return varied


_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def link_masses(tables: Tables, repairs: Iterable[Finding]) -> dict[str, LinkMass]:
    """Return the mass of every link of the file, of which ``repairs`` are findings.

    Raises RobotError for a mesh that cannot be read.
    """
    repaired = {finding.link for finding in repairs if finding.code == "inertia"}
    inertias = link_inertias(tables)
    masses = {}
    for body in tables.bodies:
        inertia = inertias.get(body.name)
        if inertia is None:
            masses[body.name] = LinkMass(0.0, "none", 0.0, 0.0)
            continue
        source = "shapes"
        if body.mass:
            if body.name in repaired:
                source = "repaired"
            else:
                source = "inertial"
        gyration = float(np.sqrt(np.linalg.eigvalsh(inertia.tensor)[-1] / inertia.mass))
        size = _size(tables.shapes_of(body.name))
        center = read_only(inertia.center)
        tensor = read_only(inertia.tensor)
        frozen_inertia = SpatialInertia(inertia.mass, center, tensor)
        masses[body.name] = LinkMass(inertia.mass, source, gyration, size, frozen_inertia)
    return masses


def _size(shapes: Sequence[Shape]) -> float:
    """Return the diagonal [m] of the box around ``shapes``, 0 without any."""
    corners = []
    for shape in shapes:
        center, half = half_extents(shape)
        corners.append(rotate(matrix_of(shape.wxyz), center + half * _CORNERS) + shape.position)
    if corners:
        return float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0)))
    return 0.0


_EMPTY = SpatialInertia(0.0, np.zeros(3), np.zeros((3, 3)))


@lru_cache(maxsize=64)
def body_tree(
    tables: Tables, fixed_base: bool = True, gravity: tuple[float, ...] = GRAVITY
) -> RigidTree:
    """Return the rigid tree of all bodies, all joints independent; the same object for tables of
    equal content.

    Links are in breadth-first order, as in SAPIEN. Raises RobotError if a mass comes from the
    volume of a mesh that cannot be read.
    """
    bodies, joints = tables.bodies, tables.joints
    names = [body.name for body in bodies]
    inertias = link_inertias(tables)
    of_bodies = [inertias.get(name, _EMPTY) for name in names]
    kinds = ["revolute" if joint.continuous else joint.type for joint in joints]
    return RigidTree(
        links=tuple(names),
        parent=np.array([-1, *(names.index(joint.parent_link) for joint in joints)]),
        joint_types=("fixed", *kinds),
        joint_names=tuple(joint.name for joint in joints if joint.moves),
        position=np.array([body.position for body in bodies]),
        wxyz=np.array([body.wxyz for body in bodies]),
        axis=np.array([(1.0, 0.0, 0.0), *(joint.axis for joint in joints)]),
        mass=np.array([inertia.mass for inertia in of_bodies]),
        center=np.array([inertia.center for inertia in of_bodies]),
        inertia=np.array([inertia.tensor for inertia in of_bodies]),
        fixed_base=fixed_base,
        gravity=gravity,
    )
