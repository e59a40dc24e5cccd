"""Collision groups: words for PhysX's filter, by which pairs of bodies are ignored.

Each shape has four words of 32 bits. As SAPIEN sets the filter up, two shapes are ignored if the upper halves of word 3
differ, or if they share a bit of word 2 and the lower half of word 3. Else they may touch if word
0 of one shares a bit with word 1 of the other.

The pairs to ignore are the edges of a graph of bodies. Each bit of word 2 ignores all pairs within a clique, so that it
takes an edge clique cover (L. T. Kou, L. J. Stockmeyer and C. K. Wong, "Covering edges by cliques with regard to
keyword conflicts and intersection graphs", Comm. ACM 21, 1978, whose greedy method this is). What 32 cliques leave
over, bits of words 0 and 1 ignore, one for each body of a vertex cover.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

Words = tuple[int, int, int, int]
Pair = frozenset[str]
"""Names of two bodies."""

_ROBOT = 0xFFFF  # lower half of word 3: bits of word 2 in the user's content mean something else
_CONTENT = 1  # bit of words 0 and 1 that every shape has by default
_OTHERS = 1 << 31  # bit of words 0 and 1 of the bodies outside the vertex cover
_MAX_CLIQUES, _MAX_STARS = 32, 30


class CollisionGroups(NamedTuple):
    """Words of each body, and the pairs that should be ignored but that no words were left for."""

    words: dict[str, Words]
    left_over: frozenset[Pair]


def collision_groups(
    bodies: Sequence[str], ignored: Collection[Pair], free: Collection[Pair] = frozenset()
) -> CollisionGroups:
    """Return filter words: PhysX then ignores the pairs ``ignored``, perhaps some of ``free``, and no others.

    The ground and the user's content, with the default words 1, 1, 0, 0, touch every body.
    """
    cliques = _cliques(bodies, ignored, free)
    cliques = sorted(cliques, key=lambda clique: -len(_within(clique, ignored)))[:_MAX_CLIQUES]
    by_words_0_and_1 = set(ignored).difference(*(_within(clique, ignored) for clique in cliques))
    left, stars = by_words_0_and_1, list[str]()
    while left and len(stars) < _MAX_STARS:
        degree = Counter(body for pair in left for body in pair)
        centre = max(bodies, key=lambda body: degree[body])  # the first of the largest
        stars.append(centre)
        left = {pair for pair in left if centre not in pair}

    words = {}
    for body in bodies:
        zero = one = _CONTENT
        if stars:
            one = 0
            for number, centre in enumerate(stars, start=1):
                zero |= (centre == body) << number
                one |= (frozenset((centre, body)) not in by_words_0_and_1) << number
            if body not in stars:
                zero, one = zero | _OTHERS, one | _OTHERS
        two = sum(1 << number for number, clique in enumerate(cliques) if body in clique)
        words[body] = (zero, one, two, _ROBOT)
    return CollisionGroups(words, frozenset(left))


def may_touch(first: Words, second: Words) -> bool:
    """Return whether PhysX's filter, as SAPIEN sets it up, lets two shapes of different bodies touch."""
    if first[3] >> 16 != second[3] >> 16:
        return False
    if first[2] & second[2] and first[3] & 0xFFFF == second[3] & 0xFFFF:
        return False
    return bool(first[0] & second[1] or second[0] & first[1])


def _cliques(bodies: Sequence[str], ignored: Collection[Pair], free: Collection[Pair]) -> list[list[str]]:
    """Return cliques of the graph of edges ``ignored`` and ``free`` that together hold every edge of ``ignored``."""
    uncovered, allowed, cliques = set(ignored), {*ignored, *free}, []
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
