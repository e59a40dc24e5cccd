"""Self-contact of a robot, from its contacts at rest and at sampled poses."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.sapien.building import link_groups
from batchpid.sim.engine.sapien.collision_groups import Pair
from batchpid.sim.engine.sapien.contacts import Contacts
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.sapien.trial import in_child
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.parts import Joint
from batchpid.sim.robot.self_collision import (
    GAP,
    PENETRATION,
    SAMPLES,
    DisabledPair,
    SelfContact,
    disabled_pairs,
)


class _Measured(NamedTuple):
    """Distances [m] of the links near each other at each pose, and the height [m] of the moving links at the first."""

    distances: list[dict[Pair, float]]
    height: float


def self_contact(robot: RobotDescription) -> SelfContact:
    """Return the pairs of links of ``robot`` that do not collide under its option ``self_collision`` and its .srdf.

    Deterministic: the poses are seeded. Poses at which links of a foreign robot may touch are tried in a child process.
    Raises RobotError if SAPIEN cannot build the robot, or crashes at one of the poses.
    """
    spec = SceneSpec(robot.urdf, (), robot.joints, 1e-3, PHYSICS["fast"], ground=False, merge_fixed=robot.merge_fixed)
    solid = [link.name for link in robot.links if link.collisions]
    bodies = _rigid_bodies(robot.all_joints)
    touching = robot.self_collision == "auto" and len({bodies[link] for link in solid}) > 1
    poses = robot.sample(SAMPLES, seed=0) if touching else np.empty((0, robot.dof))
    if touching and robot.settings is None:
        measured = in_child(_measure, spec, robot.start, poses)
    else:
        measured = _measure(spec, robot.start, poses)
    computed: tuple[DisabledPair, ...] = ()
    if robot.self_collision == "none":
        computed = tuple(DisabledPair(*pair, "User") for pair in combinations(solid, 2))
    elif touching:
        at_rest, *samples = measured.distances
        rest = [pair for pair, distance in at_rest.items() if distance < -PENETRATION]
        contacts = [[pair for pair, distance in sample.items() if distance < GAP] for sample in samples]
        computed = disabled_pairs(solid, _adjacent_links(robot.all_joints, solid), rest, contacts)
    listed = {pair.links: pair for pair in (*computed, *robot.srdf.disabled)}
    pairs = [pair for links, pair in listed.items() if links not in robot.srdf.enabled and links <= set(solid)]
    left_over = link_groups(replace(spec, ignored=tuple((pair.first, pair.second) for pair in pairs))).left_over
    return SelfContact(
        pairs=tuple(pair for pair in pairs if pair.links not in left_over),
        left_over=tuple(pair for pair in pairs if pair.links in left_over),
        reaches_ground=robot.fixed_base and measured.height < PENETRATION,
    )


def _measure(spec: SceneSpec, rest: NDArray[np.float64], poses: NDArray[np.float64]) -> _Measured:
    """Return the distances at ``rest`` and at ``poses``, none without poses."""
    contacts = Contacts(spec)
    distances = [contacts.link_distances(qpos) for qpos in (rest, *poses)] if len(poses) else []
    return _Measured(distances, contacts.height(rest))


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
