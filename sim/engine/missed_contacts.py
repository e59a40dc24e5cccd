"""Missed contacts of robots without collision shapes, by the shapes of their description, at the
ends of ticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.parts import Joint

DEPTH = 1e-3
"""Smallest depth [m] of an overlap that counts as a contact: bodies at rest on each other may
overlap by less.
"""
_LONGEST = 10.0
"""Largest position of a sliding joint in which bounds of speeds hold [m]."""
_BEYOND = 0.01
"""Distance beyond the limits of a sliding joint up to which they hold [m]: limits are soft."""


def speed_bounds(
    joints: Sequence[Joint],
    parents: Sequence[int],
    offsets: Float64,
    axes: Float64,
    body: NDArray[np.intp],
    balls: Float64,
) -> tuple[Float64, Float64]:
    """Return bounds of the speed that a unit speed of each joint, and last of a turning base, gives
    to any shape (dof + 1,) [m or 1], and the joint positions in which they hold (2, dof).

    Parameters
    ----------
    joints
        A body for each, parents first.
    parents, offsets, axes
        Parent of each body, -1 for the base; its origin in the frame of the parent (dof, 3) [m];
        and the joint's axis in its own frame, through its origin (dof, 3).
    body, balls
        Body of each shape (shapes,), and a ball around the shape in the frame of the body (shapes,
        4): center and radius [m].
    """
    arms = np.ones(len(joints) + 1)
    travel = np.tile([[-np.inf], [np.inf]], (1, len(joints)))
    carried: list[list[Any]] = [[] for _ in arms]
    for at, ball in zip(body, balls, strict=True):
        carried[at].append(ball)
    # From the last body to the base, which is last in the lists: a ball around the origin of a body
    # contains all that it carries at any pose, and is carried by its parent.
    for at in reversed(range(-1, len(joints))):
        points = np.reshape(carried[at], (-1, 4))
        distance = np.linalg.norm(points[:, :3], axis=1)
        farthest = (distance + points[:, 3]).max(initial=0.0)
        if at < 0:
            arms[at] = farthest
            break
        if joints[at].unit == "m":
            limits = np.clip([joints[at].lower, joints[at].upper], -_LONGEST, _LONGEST)
            travel[:, at] = limits + np.array([-_BEYOND, _BEYOND])
            farthest += np.abs(travel[:, at]).max()
        else:
            # A hinge moves a point by its distance from the axis.
            across = np.linalg.norm(np.cross(points[:, :3], axes[at]), axis=1)
            arms[at] = (across + points[:, 3]).max(initial=0.0)
        carried[parents[at]].append([*offsets[at], farthest])
    return arms, travel


class MissedContacts:
    """Contacts that ``size`` robots of ``spec`` would have had, with a ground at height 0 or
    without.

    Distances take as long to compute as many sim steps. They are computed where joint motion since
    the last time can have closed them: unit speed of a joint brings two links together at most at
    the speed ``arms``.
    """

    def __init__(self, spec: SceneSpec, size: int, ground: bool) -> None:
        self._contacts = spec.contact_model(ground)
        tree = spec.rigid_tree
        axes = np.tile([1.0, 0.0, 0.0], (tree.dof, 1))
        offsets = tree.bodies.at_zero[:, :, 3]
        bounds, _ = speed_bounds(
            spec.joints, tree.body_parents, offsets, axes, *self._contacts.balls
        )
        moves = np.vstack([tree.bodies.moves, np.zeros(tree.dof)])
        first, second = self._contacts.body_pairs.T
        # A joint that moves both bodies of a pair, or none, leaves their distance.
        self._arms = np.where(
            moves[first] != moves[second],
            bounds[:-1],
            0.0,
        )
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
        # Most robots move too little in all ticks together, which is seen at once.
        moved = np.abs(qpos - self._centers).max(axis=0)
        if not (moved @ self._arms.T >= self._margins).any():
            return
        for tick, pose in enumerate(qpos):
            rows = np.flatnonzero(first == 0)
            moved = np.abs(pose[rows] - self._centers[rows])
            rows = rows[(moved @ self._arms.T >= self._margins[rows]).any(axis=1)]
            if rows.size:
                self._search(pose[rows], rows)
                missed = rows[(self._margins[rows] < 0).any(axis=1)]
                first[missed] = steps[tick]
                tables[tick:, missed] = steps[tick]

    def _search(self, qpos: Rows, rows: NDArray[np.intp]) -> None:
        """Compute the distances that motion of robots ``rows`` to ``qpos`` (rows, dof) can have
        closed; the others have decreased by that motion at most.
        """
        rest = self._margins[rows] - np.abs(qpos - self._centers[rows]) @ self._arms.T
        distances = self._contacts.least_distances(qpos, rest <= 0)
        self._margins[rows] = np.maximum(rest, distances + DEPTH)
        self._centers[rows] = qpos
