"""Self-contact of a robot, from the distances of its links at rest and at sampled poses."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from itertools import combinations, product
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.robot.collision_groups import link_groups
from batchpid.sim.robot.collision_shapes import link_shapes
from batchpid.sim.robot.contacts import Contacts
from batchpid.sim.robot.parts import Joint
from batchpid.sim.robot.self_collision import (
    GAP,
    PENETRATION,
    SAMPLES,
    DisabledPair,
    SelfContact,
    disabled_pairs,
)


def self_contact(robot: Any) -> SelfContact:
    """Return the pairs of links of a :class:`.description.RobotDescription` that do not collide, under its option
    ``self_collision`` and its .srdf.

    Deterministic: the poses are seeded. Raises RobotError for a mesh that cannot be read.
    """
    solid = [link.name for link in robot.links if link.num_shapes]
    bodies = _rigid_bodies(robot.all_joints)
    shapes, tree = link_shapes(robot.urdf, robot.merge_fixed), robot.simulated_tree
    contacts = Contacts(tree, shapes, frozenset(), ground=False)
    computed: tuple[DisabledPair, ...] = ()
    if robot.self_collision == "none":
        computed = tuple(DisabledPair(*pair, "User") for pair in combinations(solid, 2))
    elif robot.self_collision == "auto" and len({bodies[link] for link in solid}) > 1:
        at_rest, *samples = [_distances(contacts, qpos) for qpos in (robot.start, *robot.sample(SAMPLES, seed=0))]
        rest = [pair for pair, distance in at_rest.items() if distance < -PENETRATION]
        close = [[pair for pair, distance in sample.items() if distance < GAP] for sample in samples]
        computed = disabled_pairs(solid, _adjacent_links(robot.all_joints, solid), rest, close)
    listed = {pair.links: pair for pair in (*computed, *robot.srdf.disabled)}
    pairs = [pair for links, pair in listed.items() if links not in robot.srdf.enabled and links <= set(solid)]
    ignored = [pair.links for pair in pairs]
    left_over = link_groups(robot.urdf, robot.merge_fixed, robot.fixed_base, robot.joints, ignored).left_over
    return SelfContact(
        pairs=tuple(pair for pair in pairs if pair.links not in left_over),
        left_over=tuple(pair for pair in pairs if pair.links in left_over),
        reaches_ground=robot.fixed_base and contacts.height(robot.start) < PENETRATION,
    )


def _distances(contacts: Contacts, qpos: Float64) -> dict[frozenset[str], float]:
    """Return the distances [m] of the pairs of links that are near each other, at one pose (dof,)."""
    distances: dict[frozenset[str], float] = {}
    for near in contacts.near(qpos):
        pair = frozenset(near[:2])
        distances[pair] = min(near.distance, distances.get(pair, np.inf))
    return distances


def _rigid_bodies(joints: Iterable[Joint]) -> dict[str, str]:
    """Return the rigid body of each link, named after its first link, for ``joints`` in breadth-first order."""
    bodies: dict[str, str] = {}
    for joint in joints:
        body = bodies.setdefault(joint.parent_link, joint.parent_link)
        bodies[joint.child_link] = joint.child_link if joint.moves else body
    return bodies


def _adjacent_links(joints: Iterable[Joint], solid: Collection[str]) -> list[frozenset[str]]:
    """Return the pairs of links with shapes, ``solid``, whose rigid bodies are neighbours.

    Neighbours are connected by a joint, or by a chain of joints and bodies without shapes.
    """
    joints = list(joints)
    bodies = _rigid_bodies(joints)
    parents = {joint.child_link: bodies[joint.parent_link] for joint in joints if joint.moves}
    members = defaultdict(list)
    for link, body in bodies.items():
        if link in solid:
            members[body].append(link)
    pairs = []
    for body, links in members.items():
        parent = parents.get(body)
        while parent is not None and parent not in members:
            parent = parents.get(parent)
        pairs += [frozenset(pair) for pair in product(links, members.get(parent or "", ()))]
    return pairs
