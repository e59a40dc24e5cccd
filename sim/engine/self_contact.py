"""Self-contact of a robot, from its contacts at rest and at sampled poses."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import combinations, product

from sim.engine.building import SceneSpec, link_groups
from sim.engine.dynamics import Dynamics
from sim.engine.physics import PHYSICS
from sim.robot.description import Joint, RobotDescription
from sim.robot.self_collision import (
    PENETRATION,
    SAMPLES,
    DisabledPair,
    SelfContact,
    disabled_pairs,
)


def self_contact(robot: RobotDescription) -> SelfContact:
    """Return the pairs of links of ``robot`` that do not collide under its option ``self_collision`` and its .srdf.

    Deterministic: the poses are seeded.
    """
    spec = SceneSpec(robot.urdf, (), robot.joints, 1e-3, PHYSICS["fast"], ground=False, merge_fixed=robot.merge_fixed)
    dynamics = Dynamics(spec)
    solid = [link.name for link in robot.links if link.collisions]
    computed: tuple[DisabledPair, ...] = ()
    if robot.self_collision == "none":
        computed = tuple(DisabledPair(*pair, "User") for pair in combinations(solid, 2))
    elif robot.self_collision == "auto":
        rest = [pair for pair, distance in dynamics.link_distances(robot.start).items() if distance < -PENETRATION]
        poses = map(dynamics.link_distances, robot.sample(SAMPLES, seed=0))
        samples = [[pair for pair, distance in distances.items() if distance < 0] for distances in poses]
        computed = disabled_pairs(solid, _adjacent_links(robot.all_joints, solid), rest, samples)
    listed = {pair.links: pair for pair in (*computed, *robot.srdf.disabled)}
    pairs = [pair for links, pair in listed.items() if links not in robot.srdf.enabled and links <= set(solid)]
    left_over = link_groups(replace(spec, ignored=tuple((pair.first, pair.second) for pair in pairs))).left_over
    return SelfContact(
        pairs=tuple(pair for pair in pairs if pair.links not in left_over),
        left_over=tuple(pair for pair in pairs if pair.links in left_over),
        reaches_ground=robot.fixed_base and dynamics.height(robot.start) < PENETRATION,
    )


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
