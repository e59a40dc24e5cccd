"""Distances between the links of one robot, and to the ground, at given poses, from MuJoCo, for
convex shapes.

The distance of two shapes that overlap is negative: the depth by which they penetrate.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import combinations
from threading import RLock

import mujoco
import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.geometry.shapes import Shape, add_geom
from batchpid.task_space.frames import matrix_of
from batchpid.task_space.rigid_tree import RigidTree

GROUND = ""
"""Name of the ground."""
_ANY = 1e6
"""Distance [m] beyond that of all bodies."""
_FARTHEST_PAIR = 1.0
"""Largest distance [m] between shapes that is computed."""


class Contacts:
    """Distances of the links of a robot at poses qpos (n, dof). Several threads may use one object.

    Parameters
    ----------
    tree
        Tree of the simulated links. A link does not collide with its parent, except with the root
        of a fixed base.
    shapes
        Shapes of the simulated links.
    ignored
        Pairs of links of the URDF that do not collide.
    ground
        Whether there is a ground at height 0. The base and the links fixed to it do not collide
        with it.
    """

    def __init__(
        self,
        tree: RigidTree,
        shapes: Sequence[Shape],
        ignored: Collection[frozenset[str]],
        ground: bool,
    ) -> None:
        self._tree = tree
        self._lock = RLock()
        self._shapes = tuple(shapes)
        self.links = tuple(dict.fromkeys(shape.body for shape in shapes))
        self._link = np.array([self.links.index(shape.body) for shape in shapes], np.intp)
        # The ground is the last shape, and belongs to the body of the base.
        self._body = np.full(len(self._shapes) + 1, -1, np.intp)
        for index, shape in enumerate(self._shapes):
            self._body[index] = tree.link_bodies[tree.index(shape.body)]
        # One flat model of all shapes: poses are written into its data, without joints.
        spec = mujoco.MjSpec()
        for shape in self._shapes:
            add_geom(spec, spec.worldbody, shape)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        # On the world, shapes are where they are in their links.
        mujoco.mj_kinematics(self._model, self._data)
        self._place = self._data.geom_xpos[:-1].copy()
        self._turn = self._data.geom_xmat[:-1].reshape(-1, 3, 3).copy()
        self._radii = self._model.geom_rbound[:-1].copy()
        # PhysX lets the children of a fixed root collide with it.
        first = 1 if tree.fixed_base else 0
        above = zip(tree.links[1:], tree.parent[1:].tolist(), strict=True)
        free = {frozenset((link, tree.links[parent])) for link, parent in above if parent >= first}
        pairs = []
        for a, b in combinations(range(len(shapes)), 2):
            bodies = frozenset((shapes[a].body, shapes[b].body))
            owners = frozenset((shapes[a].owner, shapes[b].owner))
            if self._body[a] != self._body[b] and bodies not in free and owners not in ignored:
                pairs.append((a, b))
        if ground:
            moving = np.flatnonzero(self._body >= 0).tolist()
            pairs += [(index, len(self._shapes)) for index in moving]
        self._pairs = np.array(pairs, np.intp).reshape(-1, 2)
        names = [*(shape.owner for shape in self._shapes), GROUND]
        self._owners = [(names[a], names[b]) for a, b in pairs]

    def near(self, qpos: Rows, within: float) -> Iterator[tuple[str, str, float]]:
        """Yield the links, or GROUND, of the shapes that are closer than ``within`` [m] at one pose
        (dof,), and their distance [m].
        """
        gaps = self._gaps(np.asarray(qpos)[None], within)[0]
        for row in np.flatnonzero(gaps < within).tolist():
            yield *self._owners[row], float(gaps[row])

    def in_contact(self, qpos: Rows, clearance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground
        (n,).
        """
        gaps = self._gaps(np.asarray(qpos), clearance)
        return np.asarray((gaps < clearance).any(axis=1))

    def height(self, qpos: Rows, base_too: bool = False) -> float:
        """Return the height [m] of the lowest point of the links that move, at one pose (dof,); inf
        without shapes.
        """
        heights, _ = self._heights(qpos)
        return float(heights[(self._body[:-1] >= 0) | base_too].min(initial=np.inf))

    def feet(self, qpos: Rows) -> list[tuple[str, Float64]]:
        """Return the links on which the robot stands at a pose (dof,), each with the point (3,) [m]
        that touches.

        It belongs to a shape whose lowest point is at most 0.01 m above that of the robot.
        """
        heights, centers = self._heights(qpos)
        lowest = np.flatnonzero(heights <= heights.min(initial=np.inf) + 0.01).tolist()
        return [
            (self.links[self._link[at]], np.array([*centers[at, :2], heights[at]])) for at in lowest
        ]

    def _heights(self, qpos: Rows) -> tuple[Float64, Float64]:
        """Return the heights [m] of the lowest points of the shapes (shapes,) and the shapes'
        centers (shapes, 3) at one pose.
        """
        centers, turns = self._frames(qpos)
        ground = len(self._shapes)
        with self._lock:
            self._put(centers, turns)
            heights = [self._distance(index, ground, _ANY) for index in range(ground)]
        return np.array(heights), centers

    def _gaps(self, qpos: Rows, within: float) -> Float64:
        """Return lower bounds of the distances [m] of the pairs of shapes, at poses qpos (n, dof),
        as (n, pairs), which are exact below ``within``.
        """
        centers, turns = self._frames(qpos)
        first, second = self._pairs[self._pairs[:, 1] < len(self._shapes)].T
        above_ground = self._pairs[len(first) :, 0]
        # Distances between balls around the shapes cost little, so they come first.
        apart = np.linalg.norm(centers[:, first] - centers[:, second], axis=-1)
        apart -= self._radii[first] + self._radii[second]
        gaps = np.hstack([apart, centers[:, above_ground, 2] - self._radii[above_ground]])
        exact = gaps < within
        with self._lock:
            for row in np.flatnonzero(exact.any(axis=1)).tolist():
                self._put(centers[row], turns[row])
                for pair in np.flatnonzero(exact[row]).tolist():
                    one, other = self._pairs[pair].tolist()
                    gaps[row, pair] = self._distance(one, other, _FARTHEST_PAIR)
        return gaps

    def _frames(self, qpos: Rows) -> tuple[Float64, Float64]:
        """Return centers (..., shapes, 3) and rotation matrices (..., shapes, 3, 3) of the shapes
        at poses qpos (..., dof).
        """
        qpos = np.asarray(qpos, np.float64)
        if not self._shapes:
            return np.zeros((*qpos.shape[:-1], 0, 3)), np.zeros((*qpos.shape[:-1], 0, 3, 3))
        poses = ts.link_poses(self._tree, qpos, self.links)
        turns = matrix_of(poses[..., 3:])[..., self._link, :, :]
        centers = poses[..., self._link, :3] + np.einsum("...sij,sj->...si", turns, self._place)
        return centers, turns @ self._turn

    def _put(self, centers: Float64, turns: Float64) -> None:
        """Place the shapes for MuJoCo."""
        self._data.geom_xpos[:-1] = centers
        self._data.geom_xmat[:-1] = turns.reshape(-1, 9)

    def _distance(self, first: int, second: int, farthest: float) -> float:
        """Return the distance [m] of two shapes as placed, at most ``farthest``."""
        return float(
            mujoco.mj_geomDistance(
                self._model,
                self._data,
                first,
                second,
                farthest,
                None,
            )
        )
