"""When a robot needs a PhysX system of its own: before something touches it.

Robots that share a system never meet, and each moves to the last bit as it would alone, as long as at most one contact
acts on it. PhysX solves contacts one after another, each with what the one before left over (Gauss-Seidel), and their
order depends on what else the system holds: PGS sorts those of articulations by their index in a pool that all share
(``ArticulationSortPredicate`` in ``DyDynamics.cpp`` of PhysX 5.3.1), TGS takes them as they began. Its flag for
enhanced determinism changes neither. In a system of its own a robot's past alone decides the order.

It has to be there before a second contact acts, and had better be before the first: a robot that is built anew loses
what the engine remembers of a contact, as where friction holds. The engine lists a pair of shapes from 0.02 m apart
(twice the contact offset), long before they push each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SURGE = 3000.0
"""Acceleration [m/s^2] of one link towards another that is foreseen: a light finger's under its full effort."""
AHEAD = 3
"""Time steps looked ahead: the listed distance is one step old, the next step acts on what closes within it."""

WORLD = -1
"""Stands for the ground among the links of :class:`Gap`."""


class Link(NamedTuple):
    """What counts of one link."""

    parent: int | None
    dof: int | None
    """Of the joint above it."""
    slides: bool
    offset: float
    """Farthest that its frame gets from its parent's [m]."""
    radius: float
    """Of its shapes, about its frame [m]."""


class Gap(NamedTuple):
    """A pair of shapes that are near each other: their links, or WORLD, and their distance [m]."""

    first: int
    second: int
    distance: float


class ContactPredictor:
    """Whether a robot made of ``links``, parents first, may be touched in the next time step."""

    def __init__(self, links: Sequence[Link], dof: int, timestep: float) -> None:
        # Of each link about each joint above it; the last row is the world's.
        reach = np.zeros((len(links) + 1, dof))
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
        self._ahead, self._surge = AHEAD * timestep, SURGE * timestep

    def predicts_contact(self, gaps: Iterable[Gap], qvel: NDArray[np.floating]) -> bool:
        """Whether one of ``gaps`` may close within AHEAD steps at joint velocities ``qvel`` (dof,), or two suddenly.

        A gap closes no faster than sum_j r_j |qvel_j|, over the joints between its links, with r_j the reach of the
        links about joint j, or 1 where it slides; suddenly, than that and SURGE timestep. Fingers that rest a
        millimetre apart and spring together touch at one place first, which has no order.
        """
        speed, sudden = np.abs(qvel), 0
        for gap in gaps:
            closing = self._arm[gap.first, gap.second] @ speed
            if gap.distance <= self._ahead * closing:
                return True
            sudden += gap.distance <= self._ahead * (closing + self._surge)
        return sudden > 1
