"""Contacts that robots without collision shapes would have had, by the model of the robot that has them.

A robot is looked at where it leaves a region of joint positions in which nothing touches: with the distance d of two
links, and the largest speed r_j of one towards the other per unit of joint j's speed, nothing touches while ``sum_j r_j
|q_j - q0_j| < d`` (:mod:`batchpid.sim.engine.sapien.contact_prediction`). That is about every twentieth tick of a
motion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.sapien.contact_prediction import LISTED_DISTANCE
from batchpid.sim.engine.sapien.dynamics import scene_dynamics
from batchpid.sim.engine.scene_spec import SceneSpec

DEPTH = 1e-3
"""Depth [m] from which an overlap counts as a contact: bodies at rest on each other may overlap by less."""


class MissedContacts:
    """Contacts that ``size`` robots of ``spec`` would have had, with a ground at height 0 or without."""

    def __init__(self, spec: SceneSpec, size: int, ground: bool) -> None:
        self._model = scene_dynamics(replace(spec, collisions=True, ground=ground, build=None))
        self._predictor = self._model.contact_predictor
        pairs, dof = self._predictor.arms.shape
        self._centers, self._sizes = np.zeros((size, dof)), np.zeros((size, pairs))

    def place(self, mask: NDArray[np.bool_]) -> None:
        """Drop the regions of the robots of ``mask`` (size,), which were placed."""
        self._sizes[mask] = 0.0

    def look(self, qpos: Float64, step: int, first: NDArray[np.int64]) -> None:
        """Write ``step`` into the zeros of ``first`` (size,) for robots that overlap at ``qpos`` (size, dof)."""
        closed = np.abs(qpos - self._centers) @ self._predictor.arms.T
        for row in np.flatnonzero((closed >= self._sizes).any(1) & (first == 0)):
            self._sizes[row], touches = self._region(qpos[row])
            self._centers[row] = qpos[row]
            if touches:
                first[row] = step

    def _region(self, qpos: Float64) -> tuple[Float64, bool]:
        """Return how far the links of each pair may close from ``qpos`` (dof,) until one touches, and if one does."""
        sizes = np.maximum(self._predictor.distances(self._model.link_poses(qpos)), LISTED_DISTANCE)
        for pair in self._model.near_pairs(qpos):
            index = self._predictor.index(pair)
            if index >= 0:  # links that a joint moves apart
                sizes[index] = min(sizes[index], pair.distance)
        return sizes + DEPTH, bool((sizes < -DEPTH).any())
