"""What is simulated of a robot's tables: merged bodies with their masses and their rigid tree, and
coupled joints.

A fixed joint of an articulation costs as much as one that moves, and a frame without mass becomes a
link of 1e-6 kg. So links that fixed joints connect are one body, with the frame of the first of its
links; shapes, inertias and joints of the others are placed in it. A link without ``<inertial>`` has
the inertia of its collision shapes.

The engine numbers joints breadth first, fixed ones counted, so that a merge may change the order of
the joints below it. In such a robot only fixed joints without motion below them are merged.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Document, Float64
from batchpid.arrays.elementwise import read_only
from batchpid.motors.coupling import Coupling, Follower
from batchpid.sim.description.tables import NO_TURN, ORIGIN, Body, Joint, Placement, Tables
from batchpid.sim.geometry.shapes import LEAST_MASS, inertia_of
from batchpid.task_space.frames import SpatialInertia, compose, matrix_of, rotate, total
from batchpid.task_space.rigid_tree import GRAVITY, RigidTree

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
            body = body._replace(
                joint=joint,
                position=position,
                wxyz=wxyz,
            )
        # A link alone keeps the axes of its tensor, by which SAPIEN orders the principal ones.
        if members[body.name] > 1 or body.mass <= LEAST_MASS:
            body = _with_inertia(body, parts[body.name])
        bodies.append(body)
    shapes = []
    for shape in tables.shapes:
        at = links[shape.owner]
        position, wxyz = _within(at, shape.position, shape.wxyz)
        shapes.append(
            shape._replace(
                body=at.link,
                position=position,
                wxyz=wxyz,
            )
        )
    row = {body.name: index for index, body in enumerate(bodies)}
    # Engines number shapes by body.
    shapes.sort(key=lambda shape: row[shape.body])
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
    return body._replace(
        mass=float(mass),
        center=center,
        inertia=tensor,
        inertia_wxyz=NO_TURN,
    )


def _within(at: Placement, position: Float64, wxyz: Float64) -> tuple[Float64, Float64]:
    """Return a pose in the frame of a link as a pose in the frame of its body."""
    place = at.position + rotate(matrix_of(at.wxyz), position)
    return read_only(place), read_only(compose(at.wxyz, wxyz))


def _merged_joints(joints: Sequence[Joint], separate: Separate) -> set[str]:
    """Return the fixed joints to merge, without those of ``separate`` links: all, or, if that would
    change the order of joints, all without motion below them.
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
    # Else the joints without motion below them.
    return {joint.name for joint in fixed if joint.child_link not in carriers}


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
            below[parent].append(joint)
    ordered = below[joints[0].parent_link].copy()
    for joint in ordered:
        ordered += below[joint.child_link]
    return [joint.name for joint in ordered if joint.moves]


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


class Part(NamedTuple):
    """Link of the URDF, as a part of a simulated body."""

    inertia: SpatialInertia
    """Inertia of the link in the frame of the body."""
    axes: Float64
    """Axes of the link's frame in the body's frame, as columns (3, 3)."""
    column: int | None
    """Index among the links that vary; None for a link that does not vary."""


def varied_bodies(
    tables: Tables,
    separate: Separate,
    carrier: str,
    links: Sequence[str],
) -> dict[str, list[Part]]:
    """Return the parts of the simulated bodies with varying mass, by name: they contain ``links``
    or ``carrier``.
    """
    placements = place_links(tables, separate)
    inertias = link_inertias(tables)
    parts: dict[str, list[Part]] = defaultdict(list)
    for name, at in placements.items():
        if name in inertias:
            inertia = inertias[name].moved(at.position, at.wxyz)
            column = links.index(name) if name in links else None
            parts[at.link].append(Part(inertia, matrix_of(at.wxyz), column))
    varied = {}
    for body in merge_links(tables, separate).bodies:
        # A body without mass of its links varies as it is simulated.
        members = parts[body.name] or [Part(body.spatial_inertia, np.eye(3), None)]
        is_carrier = body.name == placements[carrier].link
        if is_carrier or any(part.column is not None for part in members):
            varied[body.name] = members
    return varied


def payload_place(tables: Tables, separate: Separate, carrier: str) -> Placement:
    """Return body and place of a payload: the center of mass of its carrier, or the origin of one
    without mass.
    """
    at = place_links(tables, separate)[carrier]
    inertia = link_inertias(tables).get(carrier)
    if inertia is None:
        return at
    return at._replace(position=inertia.moved(at.position, at.wxyz).center)


_COUPLED = (
    "lower",
    "soft_lower",
    "upper",
    "soft_upper",
    "velocity_limit",
    "acceleration_limit",
    "friction",
    "damping",
)
"""Fields of a joint that :func:`couple` changes."""


@lru_cache(maxsize=32)
def coupling_of(joints: tuple[Joint, ...]) -> Coupling:
    """Return the coupling of the degrees of freedom ``joints``; the identity without mimic
    joints.
    """
    indices = {joint.name: index for index, joint in enumerate(joints)}
    followers = [
        Follower(index, indices[joint.mimic.joint], joint.mimic.multiplier, joint.mimic.offset)
        for index, joint in enumerate(joints)
        if joint.mimic is not None
    ]
    return Coupling.of(len(joints), followers)


def couple(joints: Sequence[Joint]) -> tuple[Joint, ...]:
    """Return ``joints`` with the leaders' limits, friction and damping adapted to their followers.

    A follower's position limits and soft limits narrow the leader's, unless that would leave no
    range; the follower then gets the leader's limits, multiplied. Its limits of velocity and
    acceleration, divided by |m|, hold for the leader. Its friction and damping act on the leader as
    |m| F and m^2 B, which is equivalent in the coupled motion.
    """
    coupling = coupling_of(tuple(joints))

    def columns(*names: str) -> Float64:
        return np.array([[getattr(joint, name) for joint in joints] for name in names])

    lower, upper = columns("lower", "soft_lower"), columns("upper", "soft_upper")
    for follower in coupling.followers.tolist():
        leader = coupling.leader[follower]
        ends = np.stack([lower[:, follower], upper[:, follower]]) - coupling.offset[follower]
        ends = ends / coupling.multiplier[follower]
        low = np.maximum(lower[:, leader], ends.min(0))
        high = np.minimum(upper[:, leader], ends.max(0))
        fits = low < high
        lower[:, leader] = np.where(fits, low, lower[:, leader])
        upper[:, leader] = np.where(fits, high, upper[:, leader])
    # Followers get the images of the limits of their leaders.
    ends = np.stack([lower, upper])[..., coupling.leader] * coupling.multiplier + coupling.offset
    lower = np.where(coupling.independent, lower, ends.min(0))
    upper = np.where(coupling.independent, upper, ends.max(0))
    share = np.abs(coupling.multiplier)
    rates = columns("velocity_limit", "acceleration_limit")
    np.minimum.at(rates.T, coupling.leader, (rates / share).T)
    friction, damping = np.zeros((2, len(joints)))
    np.add.at(friction, coupling.leader, share * columns("friction")[0])
    np.add.at(damping, coupling.leader, share**2 * columns("damping")[0])
    fields = [*lower, *upper, *rates, friction, damping]
    coupled = []
    for index, joint in enumerate(joints):
        numbers = [float(values[index]) for values in fields]
        changes: Document = dict(zip(_COUPLED, numbers, strict=True))
        coupled.append(replace(joint, **changes))
    return tuple(coupled)
