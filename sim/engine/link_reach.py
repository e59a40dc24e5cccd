"""Missed contacts of robots without collision shapes; upper bounds of the motion of links per motion of joints.

A robot that is simulated without collision shapes is checked for contacts that it would have had, by the shapes of its
description. A check is due when its joint positions leave a region around q0 in which no links can touch. Two links
have the distance d at q0, and unit speed of joint j brings them together at most at speed r_j. They cannot touch while
``sum_j r_j |q_j - q0_j| < d``. That is conservative advancement (B. Mirtich, Impulse-based Dynamic Simulation of Rigid
Body Systems, PhD thesis, University of California, Berkeley, 1996, section 2.3). A robot in motion is checked at about
every twentieth tick.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.engine.robot_model import contacts_of, description_tree
from batchpid.sim.engine.scene_spec import SceneSpec


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


DEPTH = 1e-3
"""Smallest depth [m] of an overlap that counts as a contact: bodies at rest on each other may overlap by less."""


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
