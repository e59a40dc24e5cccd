"""Upper bounds, at any pose, of the motion of a robot's links per unit of motion of its joints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64, Rows


class LinkExtent(NamedTuple):
    """Size of a link, and how the joint above it moves it."""

    parent: int | None
    """Index of the parent link; None for the root."""
    dof: int | None
    """Index of the joint above it; None if that joint is fixed."""
    slides: bool
    """True if that joint is prismatic."""
    in_parent: Float64
    """Pose of that joint in the parent's frame (4, 4), homogeneous [m]: the joint turns about x, or slides along it."""
    in_link: Float64
    """Pose of that joint in this link's frame (4, 4)."""
    travel: float
    """Largest distance by which that joint slides [m]."""
    balls: Float64
    """Balls that cover its shapes (balls, 4): centers in its frame, and radii [m]."""
    free: bool = False
    """True for a floating base: column ``dof`` is its displacement, and ``dof`` + 1 its rotation about any axis."""


def link_reach(links: Sequence[LinkExtent], dof: int) -> Float64:
    """Return upper bounds of the speeds of the links' shapes per unit of each joint's speed (links, dof).

    The bound is the largest distance of the shapes from the joint's axis [m], 1 for a sliding joint, and 0 for a joint
    that does not move the link. In ``links`` parents come before their children.
    """
    reach = np.zeros((len(links), dof))
    for row, link in zip(reach, links, strict=True):
        _add_reach(row, link, links)
    return reach


def closing_arms(first: Float64, second: Float64) -> Rows:
    """Return upper bounds of the closing speed of two links per unit speed of each joint, from their reach (..., dof).

    A joint above both links does not change their distance, so its bound is 0.
    """
    return np.where((first > 0) != (second > 0), first + second, 0.0)


def _add_reach(reach: Float64, link: LinkExtent, links: Sequence[LinkExtent]) -> None:
    """Write into ``reach`` (dof,) the largest distance of the shapes of ``link`` from the axis of each joint above it.

    It is the largest for all positions of the joints between. One bound comes from balls: a ball that turns about an
    axis stays within a larger ball with its center on the axis. Another bound is the sum of the distances along the
    chain. The smaller one is used.
    """
    centers, radii, at = link.balls[:, :3], link.balls[:, 3], link
    farthest = (np.linalg.norm(centers, axis=1) + radii).max(initial=0.0)
    while at.parent is not None:
        centers = (centers - at.in_link[:3, 3]) @ at.in_link[:3, :3]
        farthest += np.linalg.norm(at.in_link[:3, 3])
        if at.free and at.dof is not None:
            ball = (np.linalg.norm(centers, axis=1) + radii).max(initial=0.0)
            reach[at.dof : at.dof + 2] = 1.0, min(farthest, ball)
            return  # nothing but the world is above
        if at.slides:
            radii, farthest = radii + at.travel, farthest + at.travel
        elif at.dof is not None:
            radii = radii + np.hypot(centers[:, 1], centers[:, 2])
            centers = centers * (1.0, 0.0, 0.0)
        if at.dof is not None:
            reach[at.dof] = 1.0 if at.slides else min(farthest, radii.max(initial=0.0))
        centers = centers @ at.in_parent[:3, :3].T + at.in_parent[:3, 3]
        farthest += np.linalg.norm(at.in_parent[:3, 3])
        at = links[at.parent]
