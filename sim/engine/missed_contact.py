"""Contacts that robots simulated without collision shapes would have had, from the shapes of their description.

A robot is checked when it leaves a region of joint positions, around q0, in which no links can touch. Two links have
the distance d at q0, and unit speed of joint j brings them together at the speed r_j at most. They cannot touch while
``sum_j r_j |q_j - q0_j| < d``. That is conservative advancement (B. Mirtich, Impulse-based Dynamic Simulation of Rigid
Body Systems, PhD thesis, University of California, Berkeley, 1996, section 2.3). A robot in motion is checked at about
every twentieth tick.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.link_reach import LinkExtent, closing_arms, link_reach
from batchpid.sim.engine.robot_model import contacts_of, description_tree
from batchpid.sim.engine.scene_spec import SceneSpec

DEPTH = 1e-3
"""Depth [m] from which an overlap counts as a contact: bodies at rest on each other may overlap by less."""


class MissedContacts:
    """Contacts that ``size`` robots of ``spec`` would have had, with a ground at height 0 or without."""

    def __init__(self, spec: SceneSpec, size: int, ground: bool) -> None:
        self._contacts, tree = contacts_of(spec, ground), description_tree(spec).held
        body, balls = self._contacts.balls
        extents = [LinkExtent(None, None, False, np.eye(4), np.eye(4), 0.0, balls[body < 0])]
        for joint, above in enumerate(tree.body_parents):
            place, slides = np.vstack([tree.bodies.at_zero[joint], [0.0, 0.0, 0.0, 1.0]]), tree.bodies.slides[joint] > 0
            limits = spec.joints[joint].lower, spec.joints[joint].upper
            travel = float(np.abs(np.clip(limits, -10.0, 10.0)).max()) if slides else 0.0  # a rail may have no end
            own = balls[body == joint]
            extents.append(LinkExtent(above + 1, joint, bool(slides), place, np.eye(4), travel, own))
        reach = link_reach(extents, tree.dof)
        self._pairs = list(self._contacts.least_distances(np.zeros(tree.dof)))
        first, second = (np.array(self._pairs, np.intp).reshape(-1, 2) + 1).T
        self._arms = closing_arms(reach[first], reach[second])
        self._centers, self._sizes = np.zeros((size, tree.dof)), np.zeros((size, len(self._pairs)))

    def place(self, mask: NDArray[np.bool_]) -> None:
        """Drop the regions of the robots of ``mask`` (size,), which are now in other states."""
        self._sizes[mask] = 0.0

    def look(self, qpos: Float64, step: int, first: NDArray[np.int64]) -> None:
        """Write ``step`` into ``first`` (size,), if it is 0, for robots with overlaps at ``qpos`` (size, dof)."""
        closed = np.abs(qpos - self._centers) @ self._arms.T
        for row in np.flatnonzero((closed >= self._sizes).any(1) & (first == 0)):
            found = self._contacts.least_distances(qpos[row])
            distances = np.array([found[pair] for pair in self._pairs])
            self._centers[row], self._sizes[row] = qpos[row], distances + DEPTH
            if (distances < -DEPTH).any():
                first[row] = step
