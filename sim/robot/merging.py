"""Merging of links that are joined by fixed joints: a robot with one body for each rigid body.

A fixed joint of an articulation costs as much as one that moves, and a frame without mass becomes a
link of 1e-6 kg. A merged body has the frame of the first of its links; shapes, inertias and joints
of the others are placed in it.

The engine numbers joints breadth first, fixed ones counted, so that a merge may change the order of
the joints below it. Such fixed joints are kept.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.arrays.elementwise import read_only
from batchpid.sim.geometry.inertia import LEAST_MASS
from batchpid.sim.geometry.shapes import inertia_of
from batchpid.sim.robot.parts import Joint, Placement
from batchpid.sim.robot.tables import NO_TURN, ORIGIN, Body, Tables
from batchpid.task_space.frames import SpatialInertia, compose, matrix_of, rotate, total

Separate = tuple[str, ...]
"""Links that are not merged into their parents."""
NO_MASS = 1e-6
"""Mass [kg] and moments of inertia [kg m^2] of a simulated body without mass, in both engines."""


@lru_cache(maxsize=16)
def merge_links(tables: Tables, separate: Separate = ()) -> Tables:
    """Return the tables that engines simulate: fixed joints merged, and every body with a mass.

    Links ``separate`` begin a body. Raises RobotError if a mass comes from the volume of a mesh
    that cannot be read.
    """
    links = place_links(tables, separate)
    inertias = link_inertias(tables)
    parts: dict[str, list[SpatialInertia]] = defaultdict(list)
    members: dict[str, int] = defaultdict(int)
    for name, at in links.items():
        members[at.link] += 1
        if name in inertias:
            parts[at.link].append(inertias[name].moved(at.position, at.wxyz))
    bodies = []
    for body in tables.bodies:
        if links[body.name].link != body.name:
            continue
        if body.joint is not None:
            at = links[body.joint.parent_link]
            position, wxyz = _within(at, body.position, body.wxyz)
            joint = replace(body.joint, parent_link=at.link)
            body = body._replace(joint=joint, position=position, wxyz=wxyz)
        # A link alone keeps the axes of its tensor, by which SAPIEN orders the principal ones.
        if members[body.name] > 1 or body.mass <= LEAST_MASS:
            body = _with_inertia(body, parts[body.name])
        bodies.append(body)
    shapes = []
    for shape in tables.shapes:
        at = links[shape.owner]
        position, wxyz = _within(at, shape.position, shape.wxyz)
        shapes.append(shape._replace(body=at.link, position=position, wxyz=wxyz))
    row = {body.name: index for index, body in enumerate(bodies)}
    # Engines number shapes by body, and SAPIEN builds mirrored ones last.
    shapes.sort(key=lambda shape: (row[shape.body], shape.is_mirrored))
    return Tables(tuple(bodies), tuple(shapes), links)


def place_links(tables: Tables, separate: Separate = ()) -> dict[str, Placement]:
    """Return the placement of every link of the file in its body, parents first; links ``separate``
    begin a body.
    """
    merged = _merged_joints(tables.joints, separate)
    links: dict[str, Placement] = {}
    for body in tables.bodies:
        links[body.name] = Placement(body.name, ORIGIN, NO_TURN)
        if body.joint is not None and body.joint.name in merged:
            at = links[body.joint.parent_link]
            links[body.name] = Placement(at.link, *_within(at, body.position, body.wxyz))
    return links


def rigid_bodies(joints: Iterable[Joint]) -> dict[str, str]:
    """Return the rigid body of each link, named after its first link, for ``joints`` in
    breadth-first order. Fixed joints that are not merged hold links of one body, too.
    """
    bodies: dict[str, str] = {}
    for joint in joints:
        body = bodies.setdefault(joint.parent_link, joint.parent_link)
        if joint.moves:
            bodies[joint.child_link] = joint.child_link
        else:
            bodies[joint.child_link] = body
    return bodies


@lru_cache(maxsize=16)
def link_inertias(tables: Tables) -> dict[str, SpatialInertia]:
    """Return the inertia of every link of the file in its frame, or of its collision shapes if the
    file gives none; links without both are left out.
    """
    inertias = {}
    for body in tables.bodies:
        if body.mass:
            inertias[body.name] = body.spatial_inertia
        elif shapes := tables.shapes_of(body.name):
            inertias[body.name] = inertia_of(shapes)
    return inertias


def _with_inertia(body: Body, parts: Sequence[SpatialInertia]) -> Body:
    """Return ``body`` with the sum of inertias in its frame; without mass, with NO_MASS."""
    nothing = SpatialInertia(NO_MASS, np.zeros(3), NO_MASS * np.eye(3))
    if sum(part.mass for part in parts) <= LEAST_MASS * len(parts):
        parts = [nothing]
    mass, center, tensor = total(parts)
    return body._replace(mass=float(mass), center=center, inertia=tensor, inertia_wxyz=NO_TURN)


def _within(at: Placement, position: Float64, wxyz: Float64) -> tuple[Float64, Float64]:
    """Return a pose in the frame of a link as a pose in the frame of its body."""
    place = at.position + rotate(matrix_of(at.wxyz), position)
    return read_only(place), read_only(compose(at.wxyz, wxyz))


def _merged_joints(joints: Sequence[Joint], separate: Separate) -> set[str]:
    """Return the fixed joints to merge: all but the joints of ``separate`` links, and joints whose
    merge would change the order of joints below them.
    """
    order = [joint.name for joint in joints if joint.moves]
    # From the leaves to the root, so that one pass is enough.
    carriers: set[str] = set()  # links with a joint that moves below them
    for joint in reversed(joints):
        if joint.moves or joint.child_link in carriers:
            carriers.add(joint.parent_link)
    fixed = [joint for joint in joints if not joint.moves and joint.child_link not in separate]
    merged = {joint.name for joint in fixed}
    if _moving_order(joints, merged) == order:
        return merged
    # Else joints without motion below them first, then one by one what keeps the order.
    merged = {joint.name for joint in fixed if joint.child_link not in carriers}
    for joint in fixed:
        if _moving_order(joints, merged | {joint.name}) == order:
            merged.add(joint.name)
    return merged


def _moving_order(joints: Sequence[Joint], merged: Collection[str]) -> list[str]:
    """Return the names of the joints that move, breadth first, with some joints merged."""
    body: dict[str, str] = {}
    below: dict[str, list[Joint]] = defaultdict(list)
    for joint in joints:
        parent = body.setdefault(joint.parent_link, joint.parent_link)
        if joint.name in merged:
            body[joint.child_link] = parent
        else:
            body[joint.child_link] = joint.child_link
        if joint.name not in merged:
            below[parent].append(joint)
    ordered = below[joints[0].parent_link].copy()
    for joint in ordered:
        ordered += below[joint.child_link]
    return [joint.name for joint in ordered if joint.moves]
