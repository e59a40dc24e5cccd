"""Contacts that robots without collision shapes would have had, by the model of the robot that has them.

A robot is checked where it leaves a region of joint positions in which nothing touches: with the distance d of two
links, and the largest speed r_j of one towards the other per unit of joint j's speed, nothing touches while ``sum_j r_j
|q_j - q0_j| < d``. That is conservative advancement (B. Mirtich, Impulse-based Dynamic Simulation of Rigid Body
Systems, PhD thesis, University of California, Berkeley, 1996, section 2.3). A robot in motion is checked at about every
twentieth tick.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64
from batchpid.arrays.read_only import read_only
from batchpid.sim.engine.link_reach import LinkExtent, closing_arms, link_reach
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.engine.sapien.built_tree import scene_tree
from batchpid.sim.engine.sapien.contacts import scene_contacts
from batchpid.sim.engine.sapien.extents import NearPair, link_extents, touching_pairs
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.task_space.frames import matrix_of, rotate

DEPTH = 1e-3
"""Depth [m] from which an overlap counts as a contact: bodies at rest on each other may overlap by less."""
LISTED_DISTANCE = 0.02
"""Distance from which the engine lists a pair of shapes [m], twice the contact offset."""


class PairDistances:
    """Bounds of the distances of links of a robot made of ``links``, parents first, of which the ``pairs`` may touch.

    ``arms`` (pairs, dof) is the largest speed at which the links of a pair approach, per unit of each joint's speed.
    Pairs that no joint moves apart are left out.
    """

    def __init__(self, links: Sequence[LinkExtent], pairs: Iterable[tuple[int, int]], dof: int) -> None:
        reach = np.vstack([link_reach(links, dof), np.zeros(dof)])  # the last row is of the WORLD
        arms = closing_arms(reach[:, None], reach[None])
        kept = [pair for pair in pairs if arms[pair].any()]
        self._index = {frozenset(pair): index for index, pair in enumerate(kept)}
        first, second = np.array(kept, int).reshape(-1, 2).T
        self.arms = read_only(arms[first, second])
        self._balls = np.concatenate([link.balls for link in links])
        counts = np.array([len(link.balls) for link in links])
        self._owner = np.repeat(np.arange(len(links)), counts)
        # Rows of the links with shapes in tables of them; WORLD has the last.
        self._starts = (np.cumsum(counts) - counts)[counts > 0]
        rows = np.append(np.cumsum(counts > 0) - 1, np.count_nonzero(counts))
        self._first_row, self._second_row = rows[first], rows[second]

    def index(self, pair: NearPair) -> int | None:
        """Return the row of ``arms`` that is of this pair, None if no joint moves its links apart."""
        return self._index.get(frozenset((pair.first, pair.second)))

    def lower_bounds(self, poses: Float64) -> Float64:
        """Return lower bounds of the distances (pairs,) [m], by the balls of links at these poses (links, 7)."""
        at, radii = poses[self._owner], self._balls[:, 3]
        centers = rotate(matrix_of(at[:, 3:]), self._balls[:, :3]) + at[:, :3]
        squares = np.einsum("bi,bi->b", centers, centers)
        between = np.sqrt(np.maximum(squares[:, None] + squares - 2 * (centers @ centers.T), 0.0))
        table = np.column_stack([between - radii, centers[:, 2]]) - radii[:, None]
        table = np.minimum.reduceat(table, self._starts, axis=0)
        table = np.minimum.reduceat(table, [*self._starts, len(radii)], axis=1)
        return table[self._first_row, self._second_row]


@lru_cache(maxsize=8)
def pair_distances(spec: SceneSpec) -> PairDistances:
    """Return the bounds for the robot of ``spec``, the same object for equal specs."""
    _scene, robot = build_scene(spec, new_system(spec))
    return PairDistances(link_extents(robot), touching_pairs(robot, spec.ground), robot.dof)


class MissedContacts:
    """Contacts that ``size`` robots of ``spec`` would have had, with a ground at height 0 or without."""

    def __init__(self, spec: SceneSpec, size: int, ground: bool) -> None:
        like_sapien: dict[str, Any] = {"physics": PHYSICS["fast"], "engine": "sapien"}
        shaped = replace(spec, collisions=True, ground=ground, build=None, **like_sapien)
        self._contacts, self._distances = scene_contacts(shaped), pair_distances(shaped)
        self._tree = scene_tree(shaped)
        pairs, dof = self._distances.arms.shape
        self._centers, self._sizes = np.zeros((size, dof)), np.zeros((size, pairs))

    def place(self, mask: NDArray[np.bool_]) -> None:
        """Drop the regions of the robots of ``mask`` (size,), which were placed."""
        self._sizes[mask] = 0.0

    def look(self, qpos: Float64, step: int, first: NDArray[np.int64]) -> None:
        """Write ``step`` into the zeros of ``first`` (size,) for robots that overlap at ``qpos`` (size, dof)."""
        closed = np.abs(qpos - self._centers) @ self._distances.arms.T
        for row in np.flatnonzero((closed >= self._sizes).any(1) & (first == 0)):
            self._sizes[row], touches = self._region(qpos[row])
            self._centers[row] = qpos[row]
            if touches:
                first[row] = step

    def _region(self, qpos: Float64) -> tuple[Float64, bool]:
        """Return how far the links of each pair may close from ``qpos`` (dof,) until one touches, and if one does."""
        poses = ts.link_poses(self._tree, qpos, self._contacts.links)
        sizes = np.maximum(self._distances.lower_bounds(poses), LISTED_DISTANCE)
        for pair in self._contacts.near_pairs(qpos):
            index = self._distances.index(pair)
            if index is not None:
                sizes[index] = min(sizes[index], pair.distance)
        return sizes + DEPTH, bool((sizes < -DEPTH).any())
