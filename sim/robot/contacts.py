"""Distances between the links of one robot, and to the ground, at given poses, from MuJoCo, for
convex shapes.

The distance of two shapes that overlap is negative: the depth by which they penetrate.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import combinations
from threading import RLock
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.sim.robot.collision_shapes import add_geom
from batchpid.sim.robot.tables import Shape
from batchpid.task_space.frames import matrix_of
from batchpid.task_space.rigid_tree import RigidTree

NEAR = 0.02
"""Distance [m] below which two shapes are near each other."""
GROUND = ""
"""Name of the ground."""
_EXACT = 0.1
"""Distance [m] of balls around shapes below which least distances are exact."""
_FARTHEST = 1.0
"""Largest distance [m] between shapes that is computed."""


class Near(NamedTuple):
    """Two shapes near each other: their links in the URDF, or GROUND, and their distance [m]."""

    first: str
    second: str
    distance: float


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
        self._tree, self._lock = tree, RLock()
        self._shapes = tuple(shapes)
        self.links = tuple(dict.fromkeys(shape.body for shape in shapes))
        self._link = np.array([self.links.index(shape.body) for shape in shapes], np.intp)
        bodies = [tree.link_bodies[tree.index(link)] for link in self.links]
        self._body = np.array([bodies[link] for link in self._link], np.intp)
        # One flat model of all shapes: poses are written into its data, without joints.
        spec = mujoco.MjSpec()
        for shape in self._shapes:
            add_geom(spec, spec.worldbody, shape)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(
            self._model, self._data
        )  # on the world, shapes are where they are in their links
        self._place = self._data.geom_xpos.copy()
        self._turn = self._data.geom_xmat.reshape(-1, 3, 3).copy()
        # PhysX lets the children of a fixed root collide with it.
        first = 1 if tree.fixed_base else 0
        above = zip(tree.links[1:], tree.parent[1:].tolist(), strict=True)
        free = {frozenset((link, tree.links[parent])) for link, parent in above if parent >= first}
        pairs = [
            (a, b)
            for a, b in combinations(range(len(shapes)), 2)
            if self._body[a] != self._body[b]
            and frozenset((shapes[a].body, shapes[b].body)) not in free
            and frozenset((self._shapes[a].owner, self._shapes[b].owner)) not in ignored
        ]
        self._pairs = np.array(pairs, np.intp).reshape(-1, 2)
        self._grounded = np.flatnonzero(self._body >= 0) if ground else np.empty(0, np.intp)
        owners = [shape.owner for shape in self._shapes]
        self._owners = [(owners[a], owners[b]) for a, b in pairs]
        self._owners += [(owners[index], GROUND) for index in self._grounded.tolist()]
        on_ground = np.column_stack([np.full(len(self._grounded), -1), self._body[self._grounded]])
        touching = np.vstack([np.sort(self._body[self._pairs], axis=1), on_ground])
        self.body_pairs, numbers = np.unique(touching, axis=0, return_inverse=True)
        """Pairs of bodies that may touch (pairs, 2); the ground counts as the base, body -1."""
        self._body_pair = numbers.ravel()

    def near(self, qpos: Rows, within: float = NEAR) -> Iterator[Near]:
        """Yield the pairs of shapes that are closer than ``within`` [m], at one pose (dof,)."""
        gaps = self._gaps(np.asarray(qpos)[None], max(within, NEAR))[0]
        for row in np.flatnonzero(gaps < within).tolist():
            yield Near(*self._owners[row], float(gaps[row]))

    @property
    def balls(self) -> tuple[NDArray[np.intp], Float64]:
        """Body of the tree that has each shape (shapes,), -1 for the base, and a ball around each
        shape (shapes, 4): center in the frame of the body, and radius [m].
        """
        tree = self._tree
        at = [self._tree.index(self.links[link]) for link in self._link]
        frames = tree.bodies.link_frames[at].reshape(-1, 3, 4)
        centers = np.einsum("sij,sj->si", frames[:, :, :3], self._place) + frames[:, :, 3]
        return self._body, np.column_stack([centers, self._model.geom_rbound[: len(centers)]])

    def least_distances(self, qpos: Rows, needed: Bool) -> Float64:
        """Return lower bounds of the distances [m] of :attr:`body_pairs`, at poses qpos (n, dof),
        as (n, pairs).

        Those ``needed`` (n, pairs) are exact where the bodies are near each other, up to 1 m.
        """
        gaps = self._gaps(qpos, _EXACT, needed[:, self._body_pair])
        order = np.argsort(self._body_pair, kind="stable")
        starts = np.searchsorted(self._body_pair[order], np.arange(len(self.body_pairs)))
        least: Float64 = np.minimum.reduceat(gaps[:, order], starts, axis=1)
        return least

    def _gaps(self, qpos: Rows, within: float, needed: Bool | None = None) -> Float64:
        """Return lower bounds of the distances [m] of the pairs of shapes, and then of shapes and
        the ground, at poses qpos (n, dof), as (n, pairs).

        Those ``needed`` (n, pairs), by default all, are exact below ``within``.
        """
        centers, turns = self._frames(qpos)
        radii = self._model.geom_rbound[: len(self._shapes)]
        first, second = self._pairs.T
        # Distances between balls around the shapes cost little, so they come first.
        apart = np.linalg.norm(centers[:, first] - centers[:, second], axis=-1)
        apart -= radii[first] + radii[second]
        heights = centers[:, self._grounded, 2] - radii[self._grounded]
        gaps = np.hstack([apart, heights])
        exact = gaps < within
        if needed is not None:
            exact &= needed
        with self._lock:
            for row in np.flatnonzero(exact.any(axis=1)).tolist():
                self._put(centers[row], turns[row])
                for pair in np.flatnonzero(exact[row]).tolist():
                    gaps[row, pair] = self._distance(pair)
        return gaps

    def _distance(self, pair: int) -> float:
        """Return the distance [m] of two shapes, or of a shape and the ground, as placed."""
        if pair >= len(self._pairs):
            return self._lowest(self._grounded[pair - len(self._pairs)])
        first, second = self._pairs[pair].tolist()
        distance: float = mujoco.mj_geomDistance(
            self._model, self._data, first, second, _FARTHEST, None
        )
        return distance

    def in_contact(self, qpos: Rows, clearance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground
        (n,).
        """
        gaps = self._gaps(np.asarray(qpos), max(clearance, NEAR))
        return np.asarray((gaps < clearance).any(axis=1))

    def nearest_links(self, qpos: Rows) -> tuple[str, ...]:
        """Return the two links nearest to each other; one if the other is the ground, none if none
        are near.
        """
        nearest = min(self.near(qpos), key=lambda pair: pair.distance, default=Near("", "", np.inf))
        return tuple(name for name in nearest[:2] if name)

    def height(self, qpos: Rows, base_too: bool = False) -> float:
        """Return the height [m] of the lowest point of the links that move, at one pose (dof,); inf
        without shapes.
        """
        with self._lock:
            self._move(qpos)
            of = range(len(self._shapes)) if base_too else np.flatnonzero(self._body >= 0).tolist()
            return min((self._lowest(index) for index in of), default=np.inf)

    def feet(self, qpos: Rows, within: float = 0.01) -> list[tuple[str, Float64]]:
        """Return the links on which the robot stands at a pose (dof,), each with the point (3,) [m]
        that touches.

        It belongs to a shape whose lowest point is at most ``within`` [m] above that of the robot.
        """
        with self._lock:
            centers = self._move(qpos)
            heights = np.array([self._lowest(index) for index in range(len(centers))])
            lowest = np.flatnonzero(heights <= heights.min(initial=np.inf) + within).tolist()
            return [
                (self.links[self._link[at]], np.array([*centers[at, :2], heights[at]]))
                for at in lowest
            ]

    def _move(self, qpos: Rows) -> Float64:
        """Place the shapes at one pose; return their centers (shapes, 3)."""
        centers, turns = self._frames(qpos)
        self._put(centers, turns)
        return centers

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
        self._data.geom_xpos[:] = centers
        self._data.geom_xmat[:] = turns.reshape(-1, 9)

    def _lowest(self, index: int) -> float:
        """Return the height [m] of the lowest point of a shape, as placed."""
        shape = self._shapes[index]
        place = self._data.geom_xpos[index]
        x, y, z = self._data.geom_xmat[index].reshape(3, 3)[
            2
        ]  # the shape's axes along the vertical
        if shape.kind == "mesh":
            mesh = self._model.geom_dataid[index]
            # The lowest vertex of a hull; other shapes have a formula.
            start = self._model.mesh_vertadr[mesh]
            vertices = self._model.mesh_vert[start : start + self._model.mesh_vertnum[mesh]]
            return float(place[2] + (vertices @ np.array([x, y, z])).min())
        size = shape.size
        if shape.kind == "box":
            return float(place[2] - np.abs([x, y, z]) @ np.array(size))
        round_ = size[0] * np.hypot(x, y) if shape.kind == "cylinder" else size[0]
        return float(place[2] - round_ - (abs(z) * size[1] if len(size) > 1 else 0.0))
