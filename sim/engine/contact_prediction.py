"""Prediction of contact, from which it follows which robots get a PhysX system to themselves.

Robots that share a system never meet, and each moves bit-identically to a robot alone, as long as at most one contact
acts on it. PhysX solves contacts in sequence, each with what the previous ones left over (Gauss-Seidel), and their
order depends on what else the system holds: PGS sorts those of articulations by their index in a pool that all share
(``ArticulationSortPredicate`` in ``DyDynamics.cpp`` of PhysX 5.3.1), TGS takes them in the order in which they began.
PhysX's flag for enhanced determinism changes neither. Alone in a system, a robot's past decides the order.

A robot has to move to such a system before a second contact acts on it, and better before the first: rebuilding a robot
discards what the engine remembers of a contact, such as where friction holds. The engine lists a pair of shapes from
0.02 m apart (twice the contact offset), long before they push each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_ACCELERATION = 3000.0
"""Largest acceleration [m/s^2] of one link towards another that is predicted: a light finger's under full effort."""
LOOKAHEAD_STEPS = 3
"""Time steps looked ahead: the listed distance is one step old, and the next step acts on what closes within it."""

WORLD = -1
"""Link number of the ground."""


class LinkExtent(NamedTuple):
    """Size of a link, and how the joint above it moves it."""

    parent: int | None
    """Number of the parent link; None for the root."""
    dof: int | None
    """Number of the joint above it; None if that joint is fixed."""
    slides: bool
    """True if that joint is prismatic."""
    offset: float
    """Largest distance of the link's frame from its parent's [m]."""
    radius: float
    """Largest distance of a point of its shapes from its frame [m]."""


class NearPair(NamedTuple):
    """Two shapes near each other: the numbers of their links, or WORLD, and their distance [m]."""

    first: int
    second: int
    distance: float


class ContactPredictor:
    """Predictor of contact for a robot made of ``links``, parents first.

    ``reach`` (len(links) + 1, dof) is the largest speed of a point of each link per unit of each joint's speed: the
    distance from the joint [m], or 1 for a joint that slides. The last row is the world's.
    """

    def __init__(self, links: Sequence[LinkExtent], dof: int, timestep: float) -> None:
        self.reach = reach = np.zeros((len(links) + 1, dof))
        for row, link in zip(reach, links, strict=False):
            radius, at = link.radius, link
            while at.parent is not None:
                if at.dof is not None:
                    row[at.dof] = 1.0 if at.slides else radius
                radius += at.offset
                at = links[at.parent]
        between = (reach[:, None] > 0) != (reach[None] > 0)
        # A joint above both links moves them alike.
        self._arm = np.where(between, reach[:, None] + reach[None], 0.0)
        self._lookahead, self._speed_gain = LOOKAHEAD_STEPS * timestep, MAX_ACCELERATION * timestep

    def predicts_contact(self, pairs: Iterable[NearPair], qvel: NDArray[np.floating]) -> bool:
        """Return whether contact may act within LOOKAHEAD_STEPS, at joint velocities ``qvel`` (dof,).

        The distance of a pair shrinks no faster than sum_j r_j |qvel_j|, over the joints between its links, with r_j
        the sum of their reach. Contact is predicted if one pair may close at that speed, or two at that speed plus
        MAX_ACCELERATION * timestep: fingers at rest a millimetre apart that spring together touch at one place first,
        and one contact has no order.
        """
        speed, accelerated = np.abs(qvel), 0
        for pair in pairs:
            closing = self._arm[pair.first, pair.second] @ speed
            if pair.distance <= self._lookahead * closing:
                return True
            accelerated += pair.distance <= self._lookahead * (closing + self._speed_gain)
        return accelerated > 1
