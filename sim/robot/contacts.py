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
from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.robot.collision_shapes import add_geom
from batchpid.sim.robot.tables import Shape
from batchpid.task_space.frames import matrix_of
from batchpid.task_space.rigid_tree import RigidTree

NEAR = 0.02
"""Distance [m] below which two shapes are near each other."""
GROUND = ""
"""Name of the ground."""


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

    def near(self, qpos: Rows, within: float = NEAR) -> Iterator[Near]:
        """Yield the pairs of shapes that are closer than ``within`` [m], at one pose (dof,)."""
        apart, heights = self._apart(qpos, max(within, NEAR))
        owners = [shape.owner for shape in self._shapes]
        for row in np.flatnonzero(apart < within).tolist():
            first, second = self._pairs[row].tolist()
            yield Near(owners[first], owners[second], float(apart[row]))
        for row in np.flatnonzero(heights < within).tolist():
            yield Near(owners[self._grounded[row]], GROUND, float(heights[row]))

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

    def least_distances(self, qpos: Rows) -> dict[tuple[int, int], float]:
        """Return a lower bound of the distance [m] of each pair of bodies that may touch, at one
        pose (dof,).

        It is exact where the bodies are near each other. The ground counts as the base, body -1.
        """
        apart, heights = self._apart(qpos, NEAR)
        bodies = [
            *np.sort(self._body[self._pairs], axis=1).tolist(),
            *([-1, body] for body in self._body[self._grounded]),
        ]
        least: dict[tuple[int, int], float] = {}
        for distance, (first, second) in zip(
            [*apart.tolist(), *heights.tolist()], bodies, strict=True
        ):
            least[first, second] = min(distance, least.get((first, second), np.inf))
        return least

    def _apart(self, qpos: Rows, within: float) -> tuple[Float64, Float64]:
        """Return lower bounds of the distances of the pairs (pairs,) [m], exact below ``within``,
        and the heights of the lowest points of the shapes that may touch the ground.
        """
        with self._lock:
            centers = self._move(qpos)
            radii = self._model.geom_rbound[: len(centers)]
            (first, second) = self._pairs.T
            apart = (
                np.linalg.norm(centers[first] - centers[second], axis=1)
                - radii[first]
                - radii[second]
            )
            for row in np.flatnonzero(apart < within).tolist():
                a, b = self._pairs[row].tolist()
                apart[row] = mujoco.mj_geomDistance(self._model, self._data, a, b, within, None)
            return apart, np.array([self._lowest(index) for index in self._grounded.tolist()])

    def in_contact(self, qpos: Rows, clearance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether links are closer than ``clearance`` [m] to each other or to the ground
        (n,).
        """
        return np.array([any(True for _ in self.near(row, clearance)) for row in np.asarray(qpos)])

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
        """Place the shapes; return their centers (shapes, 3)."""
        if not self._shapes:
            return np.zeros((0, 3))
        poses = ts.link_poses(self._tree, np.asarray(qpos, np.float64), self.links)[self._link]
        turns = matrix_of(poses[:, 3:])
        centers = poses[:, :3] + np.einsum("sij,sj->si", turns, self._place)
        self._data.geom_xpos[:] = centers
        self._data.geom_xmat[:] = (turns @ self._turn).reshape(-1, 9)
        return np.asarray(centers)

    def _lowest(self, index: int) -> float:
        """Return the height [m] of the lowest point of a shape, as placed."""
        shape = self._shapes[index]
        place = self._data.geom_xpos[index]
        x, y, z = self._data.geom_xmat[index].reshape(3, 3)[
            2
        ]  # the shape's axes along the vertical
        if shape.kind == "mesh":
            mesh = self._model.geom_dataid[index]
            start = self._model.mesh_vertadr[mesh]
            vertices = self._model.mesh_vert[start : start + self._model.mesh_vertnum[mesh]]
            return float(place[2] + (vertices @ np.array([x, y, z])).min())
        size = shape.size
        if shape.kind == "box":
            return float(place[2] - np.abs([x, y, z]) @ np.array(size))
        round_ = size[0] * np.hypot(x, y) if shape.kind == "cylinder" else size[0]
        return float(place[2] - round_ - (abs(z) * size[1] if len(size) > 1 else 0.0))
