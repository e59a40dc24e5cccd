"""Merging of links that are joined by fixed joints: a robot with one link for each rigid body.

A fixed joint of an articulation costs as much as one that moves, and a frame without mass becomes a
link of 1e-6 kg. A merged link has the frame of the first link of its body; shapes, inertias and
joints of the others are placed in it.

The engine numbers joints breadth first, fixed ones counted, so that a merge may change the order of
the joints below it. Such fixed joints are kept.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
from lxml import etree

from batchpid.arrays.read_only import read_only
from batchpid.sim.robot.link_repair import MOMENTS, from_entries
from batchpid.sim.robot.parts import MOVING_TYPES, Placement
from batchpid.sim.robot.xml import number, numbers
from batchpid.task_space.rotations import from_rpy, multiply, rotate, to_rpy
from batchpid.task_space.spatial_inertia import SpatialInertia, total

Separate = tuple[str, ...]
"""Links that are not merged into their parents."""
_IDENTITY = Placement("", read_only(np.zeros(3)), read_only(np.array([1.0, 0.0, 0.0, 0.0])))


class Merged(NamedTuple):
    """Merged robot.

    ``urdf``: its text; ``bodies``: placement of every link of the original; ``inertias``: inertia
        of those links of the
    original that the engine gives one, in their own frames; ``owners``: the original link of each
    collision shape of each link of ``urdf``, in the engine's order: the order of the text, with
    mirrored meshes last.
    """

    urdf: str
    bodies: dict[str, Placement]
    inertias: dict[str, SpatialInertia]
    owners: dict[str, list[str]]


class Edge(NamedTuple):
    """Joint of the tree."""

    name: str
    parent: str
    child: str
    moves: bool
    element: etree._Element


def place_links(urdf: str, separate: Separate = ()) -> dict[str, Placement]:
    """Return the placement of every link of a sanitised URDF in its body; links ``separate`` begin
    a body.
    """
    root = etree.fromstring(urdf.encode())
    return _place(root, _merged_joints(edges_of(root), separate))


def merge_fixed_links(
    urdf: str, inertia_of_shapes: Callable[[str], SpatialInertia], separate: Separate = ()
) -> Merged:
    """Return the robot of a sanitised URDF with its fixed joints merged, and with all inertias
    written.

    ``inertia_of_shapes(link)`` is the inertia of a link with collision shapes but without
    ``<inertial>``, in the frame of that link.
    """
    root = etree.fromstring(urdf.encode())
    edges = edges_of(root)
    merged = _merged_joints(edges, separate)
    bodies = _place(root, merged)
    links = {link.get("name", ""): link for link in root.findall("link")}
    inertias = {
        name: inertia for name, link in links.items() if (inertia := _inertial(link)) is not None
    }
    members: dict[str, list[str]] = defaultdict(list)
    for name, placement in bodies.items():
        members[placement.link].append(name)
    owners = {}
    for kept, names in members.items():
        shapes = [(mirrored, name) for name in names for mirrored in _mirrored(links[name])]
        owners[kept] = [name for _, name in sorted(shapes, key=lambda shape: shape[0])]
        for name in set(owners[kept]) - set(inertias):
            inertias[name] = inertia_of_shapes(name)
        if len(names) > 1:
            _join([links[name] for name in names], [bodies[name] for name in names], inertias)
        elif kept in inertias and links[kept].find("inertial") is None:
            links[kept].append(_write_inertial(inertias[kept]))
    for edge in edges:  # breadth first, which orders the joints of a merged link as before
        root.remove(edge.element)
        if edge.name in merged:
            root.remove(links[edge.child])
            continue
        root.append(edge.element)
        placement = bodies[edge.parent]
        if placement.link != edge.parent:
            _set_origin(edge.element, placement)
            edge.element.find("parent").set("link", placement.link)
    return Merged(etree.tostring(root, encoding="unicode"), bodies, inertias, owners)


def fixed_edges(urdf: str) -> list[tuple[str, str]]:
    """Return parent and child of every fixed joint, breadth first."""
    return [
        (edge.parent, edge.child)
        for edge in edges_of(etree.fromstring(urdf.encode()))
        if not edge.moves
    ]


def edges_of(root: etree._Element) -> list[Edge]:
    """Return the joints breadth first, siblings in the order of the file."""
    below, children = defaultdict(list), set()
    for element in root.findall("joint"):
        parent, child = (
            element.find("parent").get("link", ""),
            element.find("child").get("link", ""),
        )
        edge = Edge(
            element.get("name", ""), parent, child, element.get("type") in MOVING_TYPES, element
        )
        below[parent].append(edge)
        children.add(child)
    edges = [edge for parent in below if parent not in children for edge in below[parent]]
    for edge in edges:
        edges += below[edge.child]
    return edges


def _merged_joints(edges: Sequence[Edge], separate: Separate) -> set[str]:
    """Return the fixed joints to merge: all but the joints of ``separate`` links, and joints whose
    merge would change the order of joints below them.
    """
    wanted = [edge.name for edge in edges if edge.moves]
    carriers: set[str] = set()  # links with a joint that moves below them
    for edge in reversed(edges):
        if edge.moves or edge.child in carriers:
            carriers.add(edge.parent)
    fixed = [edge for edge in edges if not edge.moves and edge.child not in separate]
    merged = {edge.name for edge in fixed}
    if _moving_order(edges, merged) == wanted:
        return merged
    merged = {edge.name for edge in fixed if edge.child not in carriers}
    for edge in fixed:
        if _moving_order(edges, merged | {edge.name}) == wanted:
            merged.add(edge.name)
    return merged


def _moving_order(edges: Sequence[Edge], merged: Collection[str]) -> list[str]:
    """Return the names of the joints that move, breadth first, with some joints merged."""
    body: dict[str, str] = {}
    below: dict[str, list[Edge]] = defaultdict(list)
    for edge in edges:
        parent = body.setdefault(edge.parent, edge.parent)
        body[edge.child] = parent if edge.name in merged else edge.child
        if edge.name not in merged:
            below[parent].append(edge)
    ordered = below[edges[0].parent].copy()
    for edge in ordered:
        ordered += below[edge.child]
    return [edge.name for edge in ordered if edge.moves]


def _place(root: etree._Element, merged: Collection[str]) -> dict[str, Placement]:
    """Return the placement of every link, parents first."""
    edges = edges_of(root)
    children = {edge.child for edge in edges}
    names = [link.get("name", "") for link in root.findall("link")]
    bodies = {name: _IDENTITY._replace(link=name) for name in names if name not in children}
    for edge in edges:
        alone = _IDENTITY._replace(link=edge.child)
        bodies[edge.child] = (
            _composed(bodies[edge.parent], edge.element) if edge.name in merged else alone
        )
    return bodies


def _join(
    links: Sequence[etree._Element],
    placements: Sequence[Placement],
    inertias: dict[str, SpatialInertia],
) -> None:
    """Move the inertia and the collision elements of ``links`` to the first of them."""
    kept, names = links[0], [link.get("name", "") for link in links]
    for link in links:
        for inertial in link.findall("inertial"):
            link.remove(inertial)
    pairs = [
        (inertias[name], at) for name, at in zip(names, placements, strict=True) if name in inertias
    ]
    if pairs:
        kept.append(
            _write_inertial(total([inertia.moved(at.position, at.wxyz) for inertia, at in pairs]))
        )
    for link, placement in zip(links[1:], placements[1:], strict=True):
        for collision in link.findall("collision"):
            _set_origin(collision, placement)
            kept.append(collision)


def _mirrored(link: etree._Element) -> list[bool]:
    """Return whether each collision shape of a link is a mirrored mesh; an element has one shape of
    each kind.
    """
    elements = [
        {shape.tag: shape for shape in each.iterfind("geometry/*")}
        for each in link.findall("collision")
    ]
    shapes = [shape for element in elements for shape in element.values()]
    return [min(numbers(shape, "scale", "1 1 1", "scale")) < 0 for shape in shapes]


def _inertial(link: etree._Element) -> SpatialInertia | None:
    """Return the inertia that ``<inertial>`` gives a link, in the link's frame."""
    element = link.find("inertial")
    if element is None:
        return None
    tensor = from_entries([number(element.find("inertia"), key, "0", "inertia") for key in MOMENTS])
    mass = number(element.find("mass"), "value", "0", "mass")
    at = _composed(_IDENTITY, element)
    return SpatialInertia(mass, np.zeros(3), tensor).moved(at.position, at.wxyz)


def _write_inertial(inertia: SpatialInertia) -> etree._Element:
    element = etree.Element("inertial")
    etree.SubElement(element, "origin", xyz=_text(inertia.center), rpy="0 0 0")
    etree.SubElement(element, "mass", value=repr(float(inertia.mass)))
    entries = zip(MOMENTS, inertia.tensor[np.triu_indices(3)], strict=True)
    etree.SubElement(element, "inertia", {key: repr(float(value)) for key, value in entries})
    return element


def _composed(placement: Placement, element: etree._Element) -> Placement:
    """Return the placement of the ``<origin>`` of an element whose frame is placed at
    ``placement``.
    """
    origin = element.find("origin")
    xyz, rpy = (np.array(numbers(origin, key, "0 0 0", element.tag)) for key in ("xyz", "rpy"))
    position = placement.position + rotate(placement.wxyz, xyz)
    return Placement(
        placement.link, read_only(position), read_only(multiply(placement.wxyz, from_rpy(rpy)))
    )


def _set_origin(element: etree._Element, placement: Placement) -> None:
    """Replace the ``<origin>`` of an element in a frame at ``placement`` by that in the merged
    link.
    """
    at = _composed(placement, element)
    for origin in element.findall("origin"):
        element.remove(origin)
    etree.SubElement(element, "origin", xyz=_text(at.position), rpy=_text(to_rpy(at.wxyz)))


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
