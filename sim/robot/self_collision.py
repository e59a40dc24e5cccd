"""Self-collision: pairs of links that do not collide, from an .srdf, or from their distances at
sampled poses.

MoveIt's setup assistant finds the pairs that its planners leave out of collision checks in this way
(D. Coleman et al., "Reducing the barrier to entry of complex robotic software: a MoveIt! case
study", J. Softw. Eng. Robotics 5, 2014).

PhysX ignores the pairs by its filter. Each shape has four words of 32 bits. As SAPIEN sets the
filter up, two shapes are ignored if the upper halves of word 3 differ, or if they share a bit of
word 2 and the lower half of word 3. Else they may touch if word 0 of one shares a bit with word 1
of the other.

The pairs to ignore are the edges of a graph of bodies. Each bit of word 2 ignores all pairs within
a clique, so that it takes an edge clique cover (L. T. Kou, L. J. Stockmeyer and C. K. Wong,
"Covering edges by cliques with regard to keyword conflicts and intersection graphs", Comm. ACM 21,
1978, whose greedy method this is). What 32 cliques leave over, bits of words 0 and 1 ignore, one
for each body of a vertex cover.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

from batchpid.sim.robot.contacts import Contacts
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.merging import Separate, merge_links, rigid_bodies
from batchpid.sim.robot.parts import DisabledPair, Joint
from batchpid.sim.robot.simulated_links import rigid_tree
from batchpid.sim.robot.tables import Tables
from batchpid.sim.robot.xml import parse_xml

Words = tuple[int, int, int, int]
Pair = frozenset[str]
"""Names of two bodies."""

_ROBOT = 0xFFFF  # lower half of word 3: bits of word 2 in the user's content mean something else
_CONTENT = 1  # bit of words 0 and 1 that every shape has by default
_OTHERS = 1 << 31  # bit of words 0 and 1 of the bodies outside the vertex cover
_MAX_CLIQUES, _MAX_STARS = 32, 30
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


class Srdf(NamedTuple):
    """Pairs that an .srdf disables and enables, and findings about it."""

    disabled: tuple[DisabledPair, ...] = ()
    enabled: frozenset[frozenset[str]] = frozenset()
    findings: tuple[Finding, ...] = ()


class SelfContact(NamedTuple):
    """Contact of a robot's links with each other and with the ground.

    ``pairs`` do not collide. The pairs ``left_over`` should not collide, but do, because PhysX's
    filter is full: it holds all pairs of up to 31 links, any 62 pairs of more links, and usually
    many more. ``reaches_ground`` is True if a link other than the base touches the ground at the
    start pose.
    """

    pairs: tuple[DisabledPair, ...]
    left_over: tuple[DisabledPair, ...]
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
    """Return the pairs of links of a :class:`.description.RobotDescription` that do not collide,
    under its option ``self_collision`` and its .srdf.

    Deterministic: the poses are seeded. Raises RobotError for a mesh that cannot be read.
    """
    solid = list(dict.fromkeys(shape.owner for shape in robot.tables.shapes))
    bodies = rigid_bodies(robot.all_joints)
    simulated = merge_links(robot.tables)
    tree = rigid_tree(simulated, fixed_base=robot.fixed_base)
    contacts = Contacts(tree, simulated.shapes, frozenset(), ground=False)
    computed: tuple[DisabledPair, ...] = ()
    if robot.self_collision == "none":
        computed = tuple(DisabledPair(*pair, "User") for pair in combinations(solid, 2))
    elif robot.self_collision == "auto" and len({bodies[link] for link in solid}) > 1:
        # The first pose is the start; the others judge how often a pair touches.
        rest, *close = [
            {frozenset(near[:2]) for near in contacts.near(qpos, GAP)}
            for qpos in (robot.start, *robot.sample(SAMPLES, seed=0))
        ]
        computed = disabled_pairs(solid, _adjacent_links(robot.all_joints, solid), rest, close)
    # The .srdf comes last, so that its reason holds.
    listed = {pair.links: pair for pair in (*computed, *robot.srdf.disabled)}
    pairs = [
        pair
        for links, pair in listed.items()
        if links not in robot.srdf.enabled and links <= set(solid)
    ]
    ignored = [pair.links for pair in pairs]
    _, left_over = link_groups(robot.tables, (), robot.fixed_base, ignored)
    return SelfContact(
        pairs=tuple(pair for pair in pairs if pair.links not in left_over),
        left_over=tuple(pair for pair in pairs if pair.links in left_over),
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


def collision_groups(
    bodies: Sequence[str], ignored: Collection[Pair], free: Collection[Pair] = frozenset()
) -> tuple[dict[str, Words], frozenset[Pair]]:
    """Return filter words, and the pairs that should be ignored but that no words were left for.

    With the words, PhysX ignores the other pairs of ``ignored``, perhaps some of ``free``, and no
    others. The ground and the user's content, with the default words 1, 1, 0, 0, touch every body.
    """
    cliques = _cliques(bodies, ignored, free)
    # The largest cliques first: what is left over is then the least.
    cliques = sorted(cliques, key=lambda clique: -len(_within(clique, ignored)))[:_MAX_CLIQUES]
    by_words_0_and_1 = set(ignored).difference(*(_within(clique, ignored) for clique in cliques))
    left = by_words_0_and_1
    stars = list[str]()
    while left and len(stars) < _MAX_STARS:
        degree = Counter(body for pair in left for body in pair)
        centre = max(bodies, key=lambda body: degree[body])  # the first of the largest
        stars.append(centre)
        left = {pair for pair in left if centre not in pair}

    words = {}
    for body in bodies:
        zero = one = _CONTENT
        if stars:
            # With stars the default bit would let every pair touch.
            one = 0
            for number, centre in enumerate(stars, start=1):
                zero |= (centre == body) << number
                one |= (frozenset((centre, body)) not in by_words_0_and_1) << number
            if body not in stars:
                zero = zero | _OTHERS
                one = one | _OTHERS
        two = sum(1 << number for number, clique in enumerate(cliques) if body in clique)
        words[body] = (zero, one, two, _ROBOT)
    return words, frozenset(left)


def link_groups(
    tables: Tables,
    separate: Separate,
    fixed_base: bool,
    ignored: Collection[Pair],
) -> tuple[dict[str, Words], frozenset[Pair]]:
    """Return :func:`collision_groups` of the links of ``tables`` that have shapes, to ignore the
    pairs ``ignored``.

    Links of one rigid body are ignored, too: they cannot move apart, and the solver would shake
    them. PhysX ignores contacts within a simulated link, and with its parent, unless that is the
    root of a fixed base.
    """
    simulated = merge_links(tables, separate)
    placements = simulated.links
    root = simulated.bodies[0].name
    bodies = rigid_bodies(tables.joints)
    neighbours = {
        frozenset((joint.parent_link, joint.child_link))
        for joint in simulated.joints
        if joint.moves and not (fixed_base and joint.parent_link == root)
    }
    links = list(dict.fromkeys(shape.owner for shape in simulated.shapes))
    ignored = set(ignored)
    free = set[Pair]()
    for first, second in combinations(links, 2):
        pair = frozenset((placements[first].link, placements[second].link))
        if len(pair) == 1 or pair in neighbours:
            free.add(frozenset((first, second)))
        elif bodies[first] == bodies[second]:
            ignored.add(frozenset((first, second)))
    return collision_groups(
        links,
        {pair for pair in ignored if pair <= set(links)} - free,
        free,
    )


def _cliques(
    bodies: Sequence[str], ignored: Collection[Pair], free: Collection[Pair]
) -> list[list[str]]:
    """Return cliques of the graph of edges ``ignored`` and ``free`` that together hold every edge
    of ``ignored``.
    """
    uncovered = set(ignored)
    allowed = {*ignored, *free}
    cliques = []
    for pair in combinations(bodies, 2):
        if frozenset(pair) in uncovered:
            clique = list(pair)
            for body in bodies:
                pairs = {frozenset((body, member)) for member in clique}
                if body not in clique and pairs <= allowed and pairs & uncovered:
                    clique.append(body)
            cliques.append(clique)
            uncovered -= _within(clique, ignored)
    return cliques


def _within(clique: Iterable[str], pairs: Collection[Pair]) -> set[Pair]:
    """Return the ``pairs`` that lie within ``clique``."""
    members = set(clique)
    return {pair for pair in pairs if pair <= members}
