"""Missed contacts of robots without collision shapes, by the shapes of their description, at the
ends of ticks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Rows
from batchpid.sim.engine.scene_spec import SceneSpec

DEPTH = 1e-3
"""Smallest depth [m] of an overlap that counts as a contact: bodies at rest on each other may
overlap by less.
"""
_LONGEST = 10.0
"""Travel of a sliding joint without limits [m]."""


class MissedContacts:
    """Contacts that ``size`` robots of ``spec`` would have had, with a ground at height 0 or
    without.

    Distances take as long to compute as many sim steps. They are computed where joint motion since
    the last time can have closed them: unit speed of a joint brings two links together at most at
    the speed ``arms``.
    """

    def __init__(self, spec: SceneSpec, size: int, ground: bool) -> None:
        self._contacts, tree = spec.contact_model(ground), spec.rigid_tree.held
        slides = tree.bodies.slides.ravel() > 0
        parents = tree.body_parents
        body, balls = self._contacts.balls
        # From the origin of each body to the end of its last child; the base is last.
        farthest = np.zeros(tree.dof + 1)
        np.maximum.at(farthest, body, np.linalg.norm(balls[:, :3], axis=1) + balls[:, 3])
        for joint in reversed(range(tree.dof)):
            limits = spec.joints[joint].lower, spec.joints[joint].upper
            if slides[joint]:
                travel = np.abs(np.clip(limits, -_LONGEST, _LONGEST)).max()
            else:
                travel = 0.0
            offset = np.linalg.norm(tree.bodies.at_zero[joint][:, 3])
            farthest[parents[joint]] = max(
                farthest[parents[joint]], offset + travel + farthest[joint]
            )
        moves = np.vstack([tree.bodies.moves, np.zeros(tree.dof)])
        first, second = self._contacts.body_pairs.T
        # A joint that moves both bodies of a pair, or none, leaves their distance.
        moves_one = moves[first] != moves[second]
        self._arms = np.where(moves_one, np.where(slides, 1.0, farthest[:-1]), 0.0)
        self._centers = np.zeros((size, tree.dof))
        self._margins = np.zeros((size, len(first)))

    def place(self, mask: NDArray[np.bool_]) -> None:
        """Forget the distances of the robots of ``mask`` (size,), which are now in other states."""
        self._margins[mask] = 0.0

    def look(
        self,
        qpos: Rows,
        steps: NDArray[np.int64],
        first: NDArray[np.int64],
        tables: NDArray[np.int64],
    ) -> None:
        """Look for overlaps at ``qpos`` (ticks, size, dof), after these ``steps`` (ticks,).

        The step of the first one of a robot is written into ``first`` (size,), where that is 0,
        and into the rows of ``tables`` (ticks, size) from there on.
        """
        rows = np.flatnonzero(first == 0)
        ticks = np.zeros(len(rows), np.intp)
        while rows.size:
            # Most robots move too little in all ticks together, which is seen at once.
            moved = np.abs(qpos[:, rows] - self._centers[rows])
            may_close = (moved.max(axis=0) @ self._arms.T >= self._margins[rows]).any(axis=1)
            rows, ticks = rows[may_close], ticks[may_close]
            closes = (moved[:, may_close] @ self._arms.T >= self._margins[rows]).any(axis=2)
            closes &= np.arange(len(qpos))[:, None] >= ticks
            may_close = closes.any(axis=0)
            rows, ticks = rows[may_close], closes.argmax(axis=0)[may_close]
            if rows.size:
                self._search(qpos[ticks, rows], rows)
            missed = (self._margins[rows] < 0).any(axis=1)
            for row, tick in zip(rows[missed].tolist(), ticks[missed].tolist(), strict=True):
                first[row] = tables[tick:, row] = steps[tick]
            rows, ticks = rows[~missed], ticks[~missed] + 1

    def _search(self, qpos: Rows, rows: NDArray[np.intp]) -> None:
        """Compute the distances that motion of robots ``rows`` to ``qpos`` (rows, dof) can have
        closed; the others have decreased by that motion at most.
        """
        rest = self._margins[rows] - np.abs(qpos - self._centers[rows]) @ self._arms.T
        distances = self._contacts.least_distances(qpos, rest <= 0)
        self._margins[rows] = np.maximum(rest, distances + DEPTH)
        self._centers[rows] = qpos
