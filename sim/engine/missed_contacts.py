"""Missed contacts of robots without collision shapes, by the shapes of their description, at the
ends of ticks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Bool, Rows
from batchpid.sim.engine.robot_model import contacts_of, description_tree
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

    Distances take as long to compute as the sim steps of a tick. They are computed where joint
    motion since the last time can have closed one of them: unit speed of a joint brings two links
    together at most at the speed ``arms``.
    """

    def __init__(self, spec: SceneSpec, size: int, ground: bool) -> None:
        self._contacts, tree = contacts_of(spec, ground), description_tree(spec).held
        slides = tree.bodies.slides.ravel() > 0
        parents = tree.body_parents
        body, balls = self._contacts.balls
        farthest = np.zeros(
            tree.dof + 1
        )  # from the origin of each body to the end of its last child; the base is last
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
        self._pairs = list(self._contacts.least_distances(np.zeros(tree.dof)))
        first, second = np.array(self._pairs, np.intp).reshape(-1, 2).T
        self._arms = np.where(
            moves[first] != moves[second], np.where(slides, 1.0, farthest[:-1]), 0.0
        )
        self._centers, self._margins = (
            np.zeros((size, tree.dof)),
            np.zeros((size, len(self._pairs))),
        )

    def place(self, mask: Bool) -> None:
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
        for row in np.flatnonzero(self._closes(qpos, slice(None)).any(axis=0) & (first == 0)):
            tick = 0
            while first[row] == 0:
                closes = np.flatnonzero(self._closes(qpos[tick:, row], row))
                if not closes.size:
                    break
                tick += int(closes[0])
                distances = self._contacts.least_distances(qpos[tick, row])
                margins = np.array([distances[pair] for pair in self._pairs]) + DEPTH
                self._centers[row] = qpos[tick, row]
                self._margins[row] = margins
                if (margins < 0).any():
                    first[row] = tables[tick:, row] = steps[tick]
                tick += 1

    def _closes(self, qpos: Rows, rows: Any) -> Bool:
        """Return whether motion to ``qpos`` (..., dof) can have closed a distance of ``rows``."""
        moved = np.abs(qpos - self._centers[rows]) @ self._arms.T
        closes: Bool = (moved >= self._margins[rows]).any(axis=-1)
        return closes
