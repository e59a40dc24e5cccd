"""Prediction of contact, from which it follows which robots get a PhysX system to themselves.

Robots that share a system never meet, and each moves bit-identically to a robot alone, as long as at most one contact
acts on it. PhysX solves contacts in sequence, each with what the previous ones left over (Gauss-Seidel), and their
order depends on what else the system holds: PGS sorts those of articulations by their index in a pool that all share
(``ArticulationSortPredicate`` in ``DyDynamics.cpp`` of PhysX 5.3.1), TGS takes them in the order in which they began.
PhysX's flag for enhanced determinism changes neither. Alone in a system, a robot's past decides the order.

A robot has to move to such a system before a second contact acts on it, and better before the first: rebuilding a robot
discards what the engine remembers of a contact, such as where friction holds. The engine lists a pair of shapes from
LISTED_DISTANCE on, long before they push each other.

A robot without listed pairs costs a look at an empty list in every step. One with such pairs, as a closed gripper has
for good, is looked at again where it leaves a region of joint positions in which no contact can be predicted: the
distance of two links bounds how far the joints may move until they meet, which is conservative advancement (B. Mirtich,
Impulse-based Dynamic Simulation of Rigid Body Systems, PhD thesis, University of California, Berkeley, 1996, section
2.3). Regions change no prediction, only how often the engine is asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

MAX_ACCELERATION = 3000.0
"""Largest acceleration [m/s^2] of one link towards another that is predicted: a light finger's under full effort."""
LOOKAHEAD_STEPS = 3
"""Time steps looked ahead: the listed distance is one step old, and the next step acts on what closes within it."""

LISTED_DISTANCE = 0.02
"""Distance from which the engine lists a pair of shapes [m], twice the contact offset."""

STEP_FACTOR = LOOKAHEAD_STEPS + 2
"""Weight of the last sim step in :class:`SafeRegions`: one step more than is looked ahead, since some solvers move
joints by more than their final velocity, and one as the listed distance is a step old."""

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
        self._timestep = timestep
        # Pairs that the engine may list: it ignores those of a link and its parent.
        solid = [*(number for number, link in enumerate(links) if link.radius > 0), WORLD]
        parents = {(link.parent, number) for number, link in enumerate(links)}
        pairs = [pair for pair in combinations(solid, 2) if pair not in parents and self._arm[pair].any()]
        self._first, self._second = np.array(pairs, int).reshape(-1, 2).T
        self._arms = self._arm[self._first, self._second]
        radii = np.array([*(link.radius for link in links), 0.0])
        self._radii = radii[self._first] + radii[self._second]

    def predicts_contact(self, pairs: Iterable[NearPair], qvel: NDArray[np.floating]) -> bool:
        """Return whether contact may act within LOOKAHEAD_STEPS, at joint velocities ``qvel`` (dof,).

        The distance of a pair shrinks no faster than sum_j r_j |qvel_j|, over the joints between its links, with r_j
        the sum of their reach. Contact is predicted if one pair may close at that speed, or two at that speed plus
        MAX_ACCELERATION * timestep: fingers at rest a millimetre apart that spring together touch at one place first,
        and one contact has no order.
        """
        speed, accelerated = np.abs(qvel), 0
        for pair in pairs:
            closing = float(self._arm[pair.first, pair.second] @ speed)
            if pair.distance <= self._lookahead * closing:
                return True
            accelerated += pair.distance <= self._lookahead * (closing + self._speed_gain)
        return accelerated > 1

    def region(
        self, pairs: Sequence[NearPair], qvel: NDArray[np.floating], positions: Callable[[], Float64]
    ) -> Float64 | None:
        """Return the bounds W (pairs, dof) of a region around the present joint positions, where none is predicted.

        No contact is predicted while W (|q - q0| + STEP_FACTOR |q - q'|) < 1, with q0 the present positions, q those of
        a later step and q' those of the step before. A pair that is d apart now, whose joints have the reach r, was
        at least d - r . |q' - q0| apart in that step, of which distances are listed, and closes by r . |q - q'| in one.

        Parameters
        ----------
        pairs, qvel
            Pairs that the engine lists, and joint velocities (dof,): :meth:`predicts_contact` is False for them.
        positions
            Function that returns the origins of the links (links, 3) [m]. Pairs that are not listed are LISTED_DISTANCE
            apart, or as far as the balls around their origins.

        Returns None where the robot would leave its region within a step.
        """
        speed, from_rest = np.abs(qvel), self._lookahead * self._speed_gain
        arm, distance = self._listed(pairs)
        slack = distance - from_rest
        slack[np.argmin(distance)] += from_rest  # the nearest pair may touch first: one contact has no order
        listed = self._bounds(arm, slack, speed)
        step = (STEP_FACTOR + 1) * self._timestep * speed
        if (listed @ step).max() >= 1:
            return None
        places = positions()
        between = places[self._first] - places[self._second]  # WORLD stands for the last link here
        apart = np.sqrt(np.einsum("ij,ij->i", between, between))
        apart = np.where(self._second == WORLD, places[self._first, 2], apart) - self._radii
        slack = np.maximum(apart, LISTED_DISTANCE) - from_rest
        bounds = np.concatenate([listed, self._bounds(self._arms, slack, speed)])
        return None if (bounds @ step).max() >= 1 else bounds

    def _bounds(self, arms: Float64, slack: Float64, speed: NDArray[np.floating]) -> Float64:
        """Return arms / slack, less what pairs (pairs, dof) closed by since the step that distances are listed of."""
        left = slack - self._timestep * (arms @ speed)
        return arms / np.maximum(left, 1e-9)[:, None]

    def _listed(self, pairs: Iterable[NearPair]) -> tuple[Float64, Float64]:
        """Return the arms (pairs, dof) and the distances (pairs,) of listed pairs."""
        first, second, distance = np.array([*pairs], float).reshape(-1, 3).T
        return self._arm[first.astype(int), second.astype(int)], distance


class SafeRegions:
    """Regions of the joint positions of ``size`` robots, within which no contact is predicted; a robot may have none.

    ``known`` is the mask (size,) of the robots with a region, ``any`` is True if there is one.
    """

    def __init__(self, size: int, dof: int) -> None:
        self.known, self.any = np.zeros(size, bool), False
        self._places = np.zeros((2, size, dof))  # of the step before, and at the center of the region
        self._weights, self._moved = np.zeros_like(self._places), np.zeros_like(self._places)
        self._bounds = [np.zeros((1, dof))] * size

    def enter(self, row: int, qpos: NDArray[np.floating], bounds: Float64) -> None:
        """Give a robot the region around ``qpos`` (dof,) with the ``bounds`` of :meth:`ContactPredictor.region`."""
        weights = bounds.max(0)
        self._places[:, row] = qpos
        self._weights[:, row] = STEP_FACTOR * weights, weights
        self._bounds[row] = bounds
        self.known[row] = self.any = True

    def drop(self, rows: int | list[int] | NDArray[np.bool_]) -> None:
        """Take the regions of some robots (rows or a mask) away."""
        self.known[rows] = False
        self._weights[:, rows] = 0.0
        self.any = bool(self.known.any())

    def left(self, qpos: Float64) -> list[int]:
        """Return the robots that are outside of their regions, one sim step after the last call, at ``qpos``."""
        moved = np.subtract(qpos, self._places, self._moved)
        np.abs(moved, moved)
        self._places[0] = qpos
        # All robots together, then each with the largest of its bounds, then with each of them: the cheapest first.
        if np.vdot(moved, self._weights) < 1:
            return []
        near = np.flatnonzero(np.einsum("kij,kij->i", moved, self._weights) >= 1).tolist()
        return [row for row in near if (self._bounds[row] @ (STEP_FACTOR * moved[0, row] + moved[1, row])).max() >= 1]
