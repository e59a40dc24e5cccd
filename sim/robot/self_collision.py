"""Self-collision: pairs of links that do not collide, from an .srdf or from sampled poses.

MoveIt's setup assistant finds the pairs that its planners leave out of collision checks in this way (D. Coleman et al.,
"Reducing the barrier to entry of complex robotic software: a MoveIt! case study", J. Softw. Eng. Robotics 5, 2014).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.xml import parse_xml

SELF_COLLISION = ("auto", "urdf", "none")
"""Values of the option ``self_collision`` of :meth:`batchpid.sim.Robot.load`."""
ALWAYS = 0.95
"""Share of sampled poses beyond which a pair counts as always in contact; MoveIt's."""
GAP = 1e-3
"""Distance [m] that counts as contact there: links built to glide along each other never come apart."""
SAMPLES = 200
"""Number of sampled poses; MoveIt's."""
PENETRATION = 1e-3
"""Depth [m] from which links at rest overlap: fingers of a closed gripper only touch."""


class DisabledPair(NamedTuple):
    """Two links that do not collide.

    ``reason`` is one of MoveIt's: "Adjacent" (neighbours), "Default" (overlap at the start pose), "Always" (in nearly
    every sampled pose), "Never" or "User" (in an .srdf).
    """

    first: str
    second: str
    reason: str

    @property
    def links(self) -> frozenset[str]:
        """Names of the links."""
        return frozenset((self.first, self.second))


class Srdf(NamedTuple):
    """Pairs that an .srdf disables and enables, and findings about it."""

    disabled: tuple[DisabledPair, ...] = ()
    enabled: frozenset[frozenset[str]] = frozenset()
    findings: tuple[Finding, ...] = ()


class SelfContact(NamedTuple):
    """Contact of a robot's links with each other and with the ground.

    ``pairs`` do not collide. The pairs ``left_over`` should not collide, but do, because PhysX's filter is full: it
    holds all pairs of up to 31 links, any 62 pairs of more links, and usually many more. ``reaches_ground`` is True if
    a link other than the base touches the ground at the start pose.
    """

    pairs: tuple[DisabledPair, ...]
    left_over: tuple[DisabledPair, ...]
    reaches_ground: bool


def read_srdf(path: Path, links: Iterable[str]) -> Srdf:
    """Return the pairs in the .srdf at ``path``, for any reason; a pair without reason gets "User".

    Pairs that name a link twice or an unknown link are left out, as in MoveIt, with a finding. Raises RobotError for
    what :func:`batchpid.sim.robot.xml.parse_xml` refuses.
    """
    known, disabled, enabled, findings = set(links), list[DisabledPair](), set[frozenset[str]](), list[Finding]()
    for element in parse_xml(path).iterchildren("disable_collisions", "enable_collisions"):
        pair = element.get("link1", ""), element.get("link2", "")
        if len(known.intersection(pair)) != 2:
            text = f"{path.name}: <{element.tag} link1={pair[0]!r} link2={pair[1]!r}> does not name two of its links"
            findings.append(Finding("warning", "srdf-link", text, "left out; correct the names"))
        elif element.tag == "enable_collisions":
            enabled.add(frozenset(pair))
        else:
            disabled.append(DisabledPair(*pair, element.get("reason") or "User"))
    return Srdf(tuple(disabled), frozenset(enabled), tuple(findings))


def disabled_pairs(
    order: Sequence[str],
    adjacent: Iterable[frozenset[str]],
    rest: Iterable[frozenset[str]],
    samples: Sequence[Iterable[frozenset[str]]],
) -> tuple[DisabledPair, ...]:
    """Return the pairs that do not collide, each with the first of its reasons, in ``order`` of the links.

    ``adjacent`` are neighbours, ``rest`` the pairs that overlap at rest, ``samples`` those in contact at each pose.
    """
    touches = Counter(pair for sample in samples for pair in set(sample))
    always = (pair for pair, count in touches.items() if count > ALWAYS * len(samples))
    reasons: dict[frozenset[str], str] = {}
    for reason, pairs in (("Adjacent", adjacent), ("Default", rest), ("Always", always)):
        for pair in pairs:
            reasons.setdefault(pair, reason)
    number = {link: index for index, link in enumerate(order)}
    ordered = {tuple(sorted(pair, key=number.__getitem__)): reason for pair, reason in reasons.items()}
    listed = [DisabledPair(first, second, reason) for (first, second), reason in ordered.items()]
    return tuple(sorted(listed, key=lambda pair: (number[pair.first], number[pair.second])))
