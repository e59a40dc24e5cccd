"""Simulated links of a robot, their masses and inertias, and its rigid tree.

Links of the URDF that fixed joints connect may be merged.

A link without ``<inertial>`` has the inertia of its collision shapes. Functions take the text of a
sanitised URDF.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Float64
from batchpid.arrays.read_only import read_only
from batchpid.sim.robot.collision_shapes import LinkShape, inertia_of, own_shapes
from batchpid.sim.robot.merging import Merged, Separate, edges_of, merge_fixed_links, place_links
from batchpid.sim.robot.parts import LinkMass, Urdf
from batchpid.sim.robot.xml import numbers
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.rotations import from_rpy, rotate
from batchpid.task_space.spatial_inertia import SpatialInertia, rotation_matrix, total

NO_MASS = 1e-6
"""Mass [kg] and moments of inertia [kg m^2] of a simulated link without mass, in both engines."""


class Part(NamedTuple):
    """Link of the URDF, as a part of a simulated body."""

    inertia: SpatialInertia
    """Inertia of the link in the frame of the body."""
    axes: Float64
    """Axes of the link's frame in the body's frame, as columns (3, 3)."""
    column: int | None
    """Index among the links that vary; None for a link that does not vary."""


class Body(NamedTuple):
    """Links of a simulated body, and the place of the payload in its frame (3,) [m]; None without
    payload.
    """

    parts: list[Part]
    payload: Float64 | None


@lru_cache(maxsize=16)
def simulated(urdf: str, separate: Separate = ()) -> Merged:
    """Return the simulated robot, with its fixed joints merged; its text has the inertia of every
    link.
    """

    def of_shapes(link: str) -> SpatialInertia:
        return inertia_of(own_shapes(urdf)[link])

    return merge_fixed_links(urdf, of_shapes, separate)


def body_inertias(urdf: str, separate: Separate = ()) -> dict[str, SpatialInertia]:
    """Return the inertia of every simulated link, by name, in its frame."""
    parts = _parts(urdf, separate, ())
    return {name: total([part.inertia for part in members]) for name, members in parts.items()}


def center_of_mass(urdf: str, separate: Separate, link: str) -> tuple[str, Float64]:
    """Return the simulated link that contains ``link`` of the URDF, and in its frame the center of
    mass of ``link``.

    For a link without mass that is its origin.
    """
    at, inertia = place_links(urdf, separate)[link], simulated(urdf, separate).inertias.get(link)
    return at.link, at.position if inertia is None else inertia.moved(at.position, at.wxyz).center


def varied_bodies(
    urdf: str, separate: Separate, carrier: str, links: Sequence[str]
) -> dict[str, Body]:
    """Return the simulated links with varying mass, by name: they contain ``links`` or
    ``carrier``.
    """
    loaded, place = center_of_mass(urdf, separate, carrier)
    return {
        body: Body(members, place if body == loaded else None)
        for body, members in _parts(urdf, separate, links).items()
        if body == loaded or any(part.column is not None for part in members)
    }


def _parts(urdf: str, separate: Separate, links: Sequence[str]) -> dict[str, list[Part]]:
    """Return the links with mass of every simulated body; a body without any gets one part of
    ``NO_MASS``.
    """
    placements, inertias = place_links(urdf, separate), simulated(urdf, separate).inertias
    parts: dict[str, list[Part]] = defaultdict(list)
    for name, at in placements.items():
        members = parts[at.link]
        if name in inertias and inertias[name].mass > 0:
            inertia, axes = inertias[name].moved(at.position, at.wxyz), rotation_matrix(at.wxyz)
            members.append(Part(inertia, axes, links.index(name) if name in links else None))
    nothing = Part(SpatialInertia(NO_MASS, np.zeros(3), NO_MASS * np.eye(3)), np.eye(3), None)
    return {name: members or [nothing] for name, members in parts.items()}


_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def link_masses(robot: Urdf) -> dict[str, LinkMass]:
    """Return the mass of every link of the URDF.

    Raises RobotError for a mesh that cannot be read.
    """
    repaired = {each.link for each in robot.repairs if each.code == "inertia"}
    inertias = simulated(robot.urdf).inertias
    shapes = own_shapes(robot.urdf)
    masses = {}
    for link in robot.links:
        if (given := inertias.get(link.name)) is None:
            masses[link.name] = LinkMass(0.0, "none", 0.0, 0.0)
            continue
        inertia = SpatialInertia(given.mass, read_only(given.center), read_only(given.tensor))
        source = (
            "shapes" if not link.inertial else "repaired" if link.name in repaired else "inertial"
        )
        largest = np.linalg.eigvalsh(inertia.tensor)[-1]
        gyration = float(np.sqrt(largest / inertia.mass)) if inertia.mass > 0 else 0.0
        masses[link.name] = LinkMass(
            inertia.mass, source, gyration, _size(shapes[link.name]), inertia
        )
    return masses


def _size(shapes: Sequence[LinkShape]) -> float:
    """Return the diagonal [m] of the box around ``shapes``, 0 without any."""
    corners = []
    for shape in shapes:
        center, half = shape.half_extents
        corners.append(rotate(shape.wxyz, center + half * _CORNERS) + shape.position)
    return float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0))) if corners else 0.0


_EMPTY = SpatialInertia(0.0, np.zeros(3), np.zeros((3, 3)))
_KIND = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


def rigid_tree(urdf: str, inertias: Mapping[str, SpatialInertia], **options: Any) -> RigidTree:
    """Return the tree of a sanitised URDF with ``inertias`` of its links, by name, in the frames of
    the links.

    Links are in breadth-first order, as in SAPIEN. ``options`` are passed to :class:`RigidTree`.
    """
    root = etree.fromstring(urdf.encode())
    joints = edges_of(root)
    (base,) = {link.get("name", "") for link in root.findall("link")} - {
        joint.child for joint in joints
    }
    links = [base, *(joint.child for joint in joints)]
    of_links = [inertias.get(link, _EMPTY) for link in links]
    elements = [joint.element for joint in joints]
    kinds = [_KIND.get(element.get("type"), "fixed") for element in elements]
    return RigidTree(
        links=tuple(links),
        parent=np.array([-1, *(links.index(joint.parent) for joint in joints)]),
        joint_types=("fixed", *kinds),
        joint_names=tuple(
            joint.name for joint, kind in zip(joints, kinds, strict=True) if kind != "fixed"
        ),
        position=np.array([_numbers(each, "origin", "xyz", "0 0 0") for each in (root, *elements)]),
        wxyz=np.array(
            [from_rpy(_numbers(each, "origin", "rpy", "0 0 0")) for each in (root, *elements)]
        ),
        axis=np.array([_numbers(each, "axis", "xyz", "1 0 0") for each in (root, *elements)]),
        mass=np.array([inertia.mass for inertia in of_links]),
        center=np.array([inertia.center for inertia in of_links]),
        inertia=np.array([inertia.tensor for inertia in of_links]),
        **options,
    )


def _numbers(element: etree._Element, tag: str, name: str, default: str) -> tuple[float, ...]:
    return numbers(element.find(tag), name, default, f"joint {element.get('name')!r}")
