"""Limits of PhysX: robots that SAPIEN cannot simulate, and content that it simulates otherwise than
the robot's file says.

PhysX ignores pairs of links by its filter. Each shape has four words of 32 bits. As SAPIEN sets the
filter up, two shapes are ignored if the upper halves of word 3 differ, or if they share a bit of
word 2 and the lower half of word 3. Else they may touch, with words 0 and 1 by default.

The pairs to ignore are the edges of a graph of bodies. Each bit of word 2 ignores all pairs within
a clique, so that it takes an edge clique cover (L. T. Kou, L. J. Stockmeyer and C. K. Wong,
"Covering edges by cliques with regard to keyword conflicts and intersection graphs", Comm. ACM 21,
1978, whose greedy method this is). What 32 cliques leave over collides.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import combinations

import numpy as np

from batchpid.sim.description.merging import rigid_bodies
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.findings import Finding
from batchpid.task_space.frames import matrix_of

MAX_LINKS = 255
"""Largest number of links of a robot: PhysX counts them in a byte."""
Words = tuple[int, int, int, int]
Pair = frozenset[str]
"""Names of two bodies."""

_ROBOT = 0xFFFF  # lower half of word 3: bits of word 2 in the user's content mean something else
_MAX_CLIQUES = 32
_PARALLEL = 0.99
"""Cosine of the angle between a wheel's axis and the axis of its cylinder, from which it rolls."""
_MUJOCO = "use the engine 'mujoco'"


def refusals(spec: SceneSpec) -> Iterator[Finding]:
    """Yield the reasons for which SAPIEN cannot simulate the robot."""
    count = len(spec.simulated.bodies)
    if count > MAX_LINKS:
        text = f"has {count} links that move; PhysX holds at most {MAX_LINKS} in one robot"
        yield Finding("engine", text, f"{_MUJOCO}, or split the robot")


def shortfalls(spec: SceneSpec) -> Iterator[Finding]:
    """Yield content that SAPIEN simulates otherwise than the robot's file says."""
    if spec.mjcf is not None and spec.mjcf.lost:
        text = f"simulated without contents of the file: {spec.mjcf.lost}"
        yield Finding("engine", text, f"{_MUJOCO}, which simulates the file itself")
    if not spec.collisions:
        return
    for pair in filter_words(spec)[1]:
        first, second = sorted(pair)
        text = "should not collide with another link, but PhysX's filter of pairs is full"
        remedy = f"{_MUJOCO}, or disable fewer pairs in the .srdf"
        yield Finding("engine", text, remedy, link=first, detail=f"with {second!r}")
    joints = {body.name: body.joint for body in spec.simulated.bodies}
    for shape in spec.simulated.shapes:
        joint = joints[shape.body]
        if shape.kind != "cylinder" or joint is None or not joint.continuous:
            continue
        axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
        if abs(matrix_of(shape.wxyz)[:, 2] @ axis) > _PARALLEL:
            text = "a wheel with a cylinder is a prism in PhysX, which rolls several percent slow"
            remedy = f"{_MUJOCO}, or a sphere as its shape"
            yield Finding("engine", text, remedy, link=shape.owner)


@lru_cache(maxsize=8)
def filter_words(spec: SceneSpec) -> tuple[dict[str, Words], frozenset[Pair]]:
    """Return :func:`collision_groups` of the links of ``spec`` that have shapes.

    Links of one rigid body are ignored, too: they cannot move apart, and the solver would shake
    them. PhysX ignores contacts within a simulated link, and with its parent, unless that is the
    root of a fixed base.
    """
    simulated = spec.simulated
    placements = simulated.links
    root = simulated.bodies[0].name
    bodies = rigid_bodies(spec.tables.joints)
    neighbours = {
        frozenset((joint.parent_link, joint.child_link))
        for joint in simulated.joints
        if joint.moves and not (spec.fixed_base and joint.parent_link == root)
    }
    links = list(dict.fromkeys(shape.owner for shape in simulated.shapes))
    ignored = {frozenset(pair) for pair in spec.ignored}
    free = set[Pair]()
    for first, second in combinations(links, 2):
        pair = frozenset((placements[first].link, placements[second].link))
        if len(pair) == 1 or pair in neighbours:
            free.add(frozenset((first, second)))
        elif bodies[first] == bodies[second]:
            ignored.add(frozenset((first, second)))
    pairs = {pair for pair in ignored if pair <= set(links)} - free
    return collision_groups(links, pairs, free)


def collision_groups(
    bodies: Sequence[str], ignored: Collection[Pair], free: Collection[Pair] = frozenset()
) -> tuple[dict[str, Words], frozenset[Pair]]:
    """Return filter words, and the pairs to be ignored for which no words were left.

    With the words, PhysX ignores the other pairs of ``ignored``, perhaps some of ``free``, and no
    others. The ground and the user's content, with the default words 1, 1, 0, 0, touch every body.
    """
    cliques = _cliques(bodies, ignored, free)
    # The largest cliques first: what is left over is then the least.
    cliques = sorted(cliques, key=lambda clique: -len(_within(clique, ignored)))[:_MAX_CLIQUES]
    left = set(ignored).difference(*(_within(clique, ignored) for clique in cliques))
    words = {}
    for body in bodies:
        two = sum(1 << number for number, clique in enumerate(cliques) if body in clique)
        words[body] = (1, 1, two, _ROBOT)
    return words, frozenset(left)


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
