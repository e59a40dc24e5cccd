"""Self-collision: pairs of links that do not collide, from an .srdf, or from their distances at
sampled poses.

MoveIt's setup assistant finds the pairs that its planners leave out of collision checks in this way
(D. Coleman et al., "Reducing the barrier to entry of complex robotic software: a MoveIt! case
study", J. Softw. Eng. Robotics 5, 2014).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

from batchpid.sim.findings import Finding
from batchpid.sim.geometry.distances import Contacts
from batchpid.sim.robot.merging import merge_links, rigid_bodies
from batchpid.sim.robot.parts import DisabledPair, Joint, Srdf
from batchpid.sim.robot.simulated_links import body_tree
from batchpid.sim.robot.xml import parse_xml

SELF_COLLISION = ("auto", "urdf", "none")
"""Values of the option ``self_collision`` of :meth:`batchpid.sim.Robot.load`."""
ALWAYS = 0.95
"""Share of sampled poses beyond which a pair counts as always in contact; MoveIt's."""
GAP = 1e-3
"""Distance [m] that counts as contact: links built to glide along each other never come apart, and
PhysX pushes links apart that just touch at the start.
"""
SAMPLES = 200
"""Number of sampled poses; MoveIt's."""


class SelfContact(NamedTuple):
    """Contact of a robot's links with each other and with the ground.

    ``pairs`` do not collide. ``reaches_ground`` is True if a link other than the base touches the
    ground at the start pose.
    """

    pairs: tuple[DisabledPair, ...]
    reaches_ground: bool


def read_srdf(path: Path, links: Iterable[str]) -> Srdf:
    """Return the pairs in the .srdf at ``path``, for any reason; a pair without reason gets "User".

    Pairs that name a link twice or an unknown link are left out, as in MoveIt, with a finding.
    Raises RobotError for what :func:`batchpid.sim.robot.xml.parse_xml` refuses.
    """
    names = set(links)
    disabled = list[DisabledPair]()
    enabled = set[frozenset[str]]()
    findings = list[Finding]()
    for element in parse_xml(path).iterchildren("disable_collisions", "enable_collisions"):
        pair = element.get("link1", ""), element.get("link2", "")
        if len(names.intersection(pair)) != 2:
            text = (
                f"{path.name}: <{element.tag} link1={pair[0]!r} link2={pair[1]!r}> does not name"
                " two links of the robot"
            )
            findings.append(Finding("self-collision", text, "correct the names; now left out"))
        elif element.tag == "enable_collisions":
            enabled.add(frozenset(pair))
        else:
            disabled.append(DisabledPair(*pair, element.get("reason") or "User"))
    return Srdf(tuple(disabled), frozenset(enabled), tuple(findings))


def disabled_pairs(
    order: Sequence[str],
    adjacent: Iterable[frozenset[str]],
    rest: Iterable[frozenset[str]],
    samples: Sequence[Collection[frozenset[str]]],
) -> tuple[DisabledPair, ...]:
    """Return the pairs that do not collide, each with the first of its reasons, in ``order`` of the
    links.

    ``adjacent`` are neighbours, ``rest`` the pairs in contact at rest, ``samples`` those in contact
    at each pose.
    """
    touches = Counter(pair for sample in samples for pair in sample)
    always = (pair for pair, count in touches.items() if count > ALWAYS * len(samples))
    reasons: dict[frozenset[str], str] = {}
    for reason, pairs in (("Adjacent", adjacent), ("Default", rest), ("Always", always)):
        for pair in pairs:
            reasons.setdefault(pair, reason)
    number = {link: index for index, link in enumerate(order)}
    ordered = ((sorted(pair, key=number.__getitem__), reason) for pair, reason in reasons.items())
    listed = [DisabledPair(first, second, reason) for (first, second), reason in ordered]
    return tuple(sorted(listed, key=lambda pair: (number[pair.first], number[pair.second])))


def self_contact(robot: Any) -> SelfContact:
    """Return the pairs of links of a :class:`batchpid.sim.Robot` that do not collide,
    under its option ``self_collision`` and its .srdf.

    Deterministic: the poses are seeded. Raises RobotError for a mesh that cannot be read.
    """
    solid = list(dict.fromkeys(shape.owner for shape in robot.tables.shapes))
    bodies = rigid_bodies(robot.tables.joints)
    simulated = merge_links(robot.tables)
    tree = body_tree(simulated, robot.fixed_base)
    contacts = Contacts(tree, simulated.shapes, frozenset(), ground=False)
    computed: tuple[DisabledPair, ...] = ()
    if robot.reading.self_collision == "none":
        computed = tuple(DisabledPair(*pair, "User") for pair in combinations(solid, 2))
    elif robot.reading.self_collision == "auto" and len({bodies[link] for link in solid}) > 1:
        # The first pose is the start; the others judge how often a pair touches.
        rest, *close = [
            {frozenset(near[:2]) for near in contacts.near(qpos, GAP)}
            for qpos in (robot.start, *robot.sample(SAMPLES, seed=0))
        ]
        computed = disabled_pairs(solid, _adjacent_links(robot.tables.joints, solid), rest, close)
    # The .srdf comes last, so that its reason holds.
    listed = {pair.links: pair for pair in (*computed, *robot.reading.srdf.disabled)}
    pairs = (
        pair
        for links, pair in listed.items()
        if links not in robot.reading.srdf.enabled and links <= set(solid)
    )
    return SelfContact(
        pairs=tuple(pairs),
        reaches_ground=robot.fixed_base and contacts.height(robot.start) < GAP,
    )


def _adjacent_links(joints: Iterable[Joint], solid: Collection[str]) -> list[frozenset[str]]:
    """Return the pairs of links with shapes, ``solid``, whose rigid bodies are neighbours.

    Neighbours are connected by a joint, or by a chain of joints and bodies without shapes.
    """
    joints = list(joints)
    bodies = rigid_bodies(joints)
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
