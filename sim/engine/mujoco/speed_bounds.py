"""Bounds of the speeds that a robot's joints give to its collision shapes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.sim.robot.tables import Joint

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
