"""Prediction of contact, from which it follows which robots get a PhysX system to themselves.

Robots that share a system never meet, and each moves bit-identically to a robot alone, as long as at most one contact
acts on it. PhysX solves contacts in sequence, each from the result of the previous ones (Gauss-Seidel), and their
order depends on the other content of the system: PGS sorts the contacts of articulations by index in a shared pool
(``ArticulationSortPredicate`` in ``DyDynamics.cpp`` of PhysX 5.3.1), TGS takes them in the order in which they began.
PhysX's flag for enhanced determinism changes neither. Alone in a system, a robot's past decides the order.

A robot has to move to such a system before a second contact acts on it, and better before the first: rebuilding a robot
discards the engine's stored contacts, such as the points where friction holds. The engine lists a pair of shapes from
LISTED_DISTANCE on, long before they push each other.

A robot without listed pairs costs a look at an empty list in every step. One with such pairs, as a closed gripper has
for good, is looked at again where it leaves a region of joint positions in which no contact can be predicted: the
distance of two links bounds how far the joints may move until they meet, which is conservative advancement (B. Mirtich,
Impulse-based Dynamic Simulation of Rigid Body Systems, PhD thesis, University of California, Berkeley, 1996, section
2.3). Regions change no prediction, only how often the engine is asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.arrays.read_only import read_only
from batchpid.sim.engine.link_reach import LinkExtent, closing_arms, link_reach

MAX_ACCELERATION = 3000.0
"""Largest acceleration [m/s^2] of one link towards another that is predicted: a light finger's under full effort."""
LOOKAHEAD_STEPS = 3
"""Time steps looked ahead: the listed distance is one step old, and the next step acts on pairs that close in it."""

LISTED_DISTANCE = 0.02
"""Distance from which the engine lists a pair of shapes [m], twice the contact offset."""

STEP_FACTOR = LOOKAHEAD_STEPS + 2
"""Weight of the last sim step in :class:`SafeRegions`: one step more than is looked ahead, since some solvers move
joints by more than their final velocity, and one as the listed distance is a step old."""

WORLD = -1
"""Link number of the ground."""


class NearPair(NamedTuple):
    """Two shapes near each other: the numbers of their links, or WORLD, and their distance [m]."""

    first: int
    second: int
    distance: float


class ContactPredictor:
    """Predictor of contact for a robot made of ``links``, parents first, of which the ``pairs`` may touch.

    ``reach`` (len(links) + 1, dof) is the result of :func:`batchpid.sim.engine.link_reach.link_reach`, with a last row
    of 0 for the world. ``arms`` (pairs, dof) is the largest speed at which the links of a pair approach, per unit of
    each joint's speed.
    """

    def __init__(
        self, links: Sequence[LinkExtent], pairs: Iterable[tuple[int, int]], dof: int, timestep: float
    ) -> None:
        self.reach = read_only(np.vstack([link_reach(links, dof), np.zeros(dof)]))
        self._arm = closing_arms(self.reach[:, None], self.reach[None])
        self._lookahead, self._speed_gain = LOOKAHEAD_STEPS * timestep, MAX_ACCELERATION * timestep
        self._timestep = timestep
        pairs = [pair for pair in pairs if self._arm[pair].any()]
        self._first, self._second = np.array(pairs, int).reshape(-1, 2).T
        self.arms = read_only(self._arm[self._first, self._second])
        self._index = np.full(self._arm.shape[:2], -1)
        self._index[self._first, self._second] = self._index[self._second, self._first] = np.arange(len(pairs))
        self._balls = np.concatenate([link.balls for link in links])
        counts = np.array([len(link.balls) for link in links])
        self._owner = np.repeat(np.arange(len(links)), counts)
        # Rows of the links with shapes in tables of them; WORLD has the last.
        self._starts = (np.cumsum(counts) - counts)[counts > 0]
        rows = np.append(np.cumsum(counts > 0) - 1, np.count_nonzero(counts))
        self._first_row, self._second_row = rows[self._first], rows[self._second]

    def index(self, pair: NearPair) -> int:
        """Return the row of ``arms`` that is of this pair, -1 if no joint moves its links apart."""
        return int(self._index[pair.first, pair.second])

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
        self, pairs: Sequence[NearPair], qvel: NDArray[np.floating], poses: Callable[[], Float64]
    ) -> Float64 | None:
        """Return the sizes s (pairs,) [m] of a region around the present joint positions, where none is predicted.

        No contact is predicted while ``arms`` (|q - q0| + STEP_FACTOR |q - q'|) < s, with q0 the present positions, q
        the positions of a later step and q' of the step before. A pair that is d apart now, with the arms r, was at
        least d - r . |q' - q0| apart in that step, of which distances are listed, and closes by r . |q - q'| in one.

        Parameters
        ----------
        pairs, qvel
            Pairs that the engine lists, and joint velocities (dof,): :meth:`predicts_contact` is False for them.
        poses
            Function that returns the poses of the links (links, 4, 4), homogeneous. Pairs that are not listed are
            LISTED_DISTANCE apart, or as far as the balls that cover them.

        Returns None where the robot would leave its region within a step.
        """
        speed, from_rest = np.abs(qvel), self._lookahead * self._speed_gain
        nearest = min(range(len(pairs)), key=lambda number: pairs[number].distance)
        closing = self.arms @ (self._timestep * speed)
        # Distances are listed of the step before.
        slack = np.full(len(closing), LISTED_DISTANCE - from_rest) - closing
        for number, pair in enumerate(pairs):
            index = self.index(pair)
            if index < 0:  # links that no joint moves apart
                return None
            # The nearest pair may touch first: one contact has no order.
            left = pair.distance - closing[index] - (from_rest if number != nearest else 0.0)
            if (STEP_FACTOR + 1) * closing[index] >= left:
                return None
            slack[index] = min(slack[index], left)
        sizes = np.maximum(slack, self.distances(poses()) - from_rest - closing)
        return None if ((STEP_FACTOR + 1) * closing >= sizes).any() else sizes

    def distances(self, poses: Float64) -> Float64:
        """Return lower bounds of the distances of the pairs that may touch, at these poses of the links."""
        at, radii = poses[self._owner], self._balls[:, 3]
        centers = np.einsum("bij,bj->bi", at[:, :3, :3], self._balls[:, :3]) + at[:, :3, 3]
        squares = np.einsum("bi,bi->b", centers, centers)
        between = np.sqrt(np.maximum(squares[:, None] + squares - 2 * (centers @ centers.T), 0.0))
        table = np.column_stack([between - radii, centers[:, 2]]) - radii[:, None]
        table = np.minimum.reduceat(table, self._starts, axis=0)
        table = np.minimum.reduceat(table, [*self._starts, len(radii)], axis=1)
        return table[self._first_row, self._second_row]


class SafeRegions:
    """Regions of the joint positions of ``size`` robots, within which no contact is predicted; a robot may have none.

    The argument ``arms`` is the attribute of :class:`ContactPredictor`.

    Attributes
    ----------
    known
        Robots with a region (size,), the same array all the time.
    any
        Whether there is one.
    arms
        Weights of the movements of the last sim step and since the center of the region (2 dof, pairs).
    places
        Positions before the last sim step and at the center (size, 2, dof), the same array all the time.
    sizes
        Sizes of the regions (size, pairs), the same array all the time; inf without a region.
    """

    def __init__(self, size: int, arms: Float64) -> None:
        self.known, self.any = np.zeros(size, bool), False
        self.arms = np.concatenate([STEP_FACTOR * arms.T, arms.T])
        self.places = np.zeros((size, 2, arms.shape[1]))  # of the step before, and at the center of the region
        self._moved, self._used = np.zeros_like(self.places), np.zeros((size, 1, len(arms)))
        self.sizes = np.full((size, len(arms)), np.inf)

    def enter(self, row: int, qpos: NDArray[np.floating], sizes: Float64) -> None:
        """Set the region of a robot: around ``qpos`` (dof,), with the ``sizes`` of :meth:`ContactPredictor.region`."""
        self.places[row] = qpos
        self.sizes[row] = sizes
        self.known[row] = self.any = True

    def drop(self, rows: int | list[int] | NDArray[np.bool_]) -> None:
        """Take the regions of some robots (rows or a mask) away."""
        self.known[rows] = False
        self.sizes[rows] = np.inf
        self.any = bool(self.known.any())

    def left(self, qpos: Float64) -> list[int]:
        """Return the robots that are outside of their regions, one sim step after the last call, at ``qpos``."""
        moved = np.subtract(qpos[:, None], self.places, self._moved)
        np.abs(moved, moved)
        self.places[:, 0] = qpos
        # Robot by robot, so that no result depends on how many there are.
        outside = np.matmul(moved.reshape(len(moved), 1, -1), self.arms, self._used) >= self.sizes[:, None]
        return np.flatnonzero(outside.any((1, 2))).tolist() if outside.any() else []
