"""Extents of a robot's links, and the pairs of links that may touch."""

from __future__ import annotations

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from sapien import physx

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.link_reach import LinkExtent
from batchpid.sim.engine.sapien.collision_groups import may_touch

MAX_BALLS = 8
"""Largest number of balls that cover one shape."""
WORLD = -1
"""Link number of the ground."""


class NearPair(NamedTuple):
    """Two shapes near each other: the numbers of their links, or WORLD, and their distance [m]."""

    first: int
    second: int
    distance: float


def link_extents(robot: Any) -> list[LinkExtent]:
    """Return the extents of a robot's links, parents first."""
    dofs = {joint.name: dof for dof, joint in enumerate(robot.active_joints)}
    numbers = {link: number for number, link in enumerate(robot.links)}
    extents = []
    for link in robot.links:
        joint, slides = link.joint, link.joint.type == "prismatic"
        in_parent, in_link = (
            np.asarray(pose.to_transformation_matrix(), float) for pose in (joint.pose_in_parent, joint.pose_in_child)
        )
        # A rail may have no end.
        travel = float(np.abs(np.clip(joint.limits, -10.0, 10.0)).max(initial=0.0)) if slides else 0.0
        parent = None if link.parent is None else numbers[link.parent]
        balls = [_balls(shape) for shape in link.collision_shapes]
        covered = np.concatenate(balls) if balls else np.empty((0, 4))
        extents.append(LinkExtent(parent, dofs.get(joint.name), slides, in_parent, in_link, travel, covered))
    return extents


def touching_pairs(robot: Any, ground: bool) -> list[tuple[int, int]]:
    """Return the pairs of links, by number, that the engine does not ignore, those with the ground included."""
    links = robot.links
    words = [{tuple(shape.get_collision_groups()) for shape in link.collision_shapes} for link in links]
    pairs = []
    for first, second in combinations(range(len(links)), 2):
        parent = links[second].parent is links[first] or links[first].parent is links[second]
        if parent and links[first].parent is not None and links[second].parent is not None:
            continue  # PhysX ignores a link and its parent, unless that is the root of a fixed base
        if any(may_touch(a, b) for a in words[first] for b in words[second]):
            pairs.append((first, second))
    return pairs + [(number, WORLD) for number in range(len(links)) if ground and words[number]]


def shape_box(shape: Any) -> tuple[Float64, Float64]:
    """Return the center (3,) and the half size (3,) [m] of the box around a shape, in the frame of the shape."""
    if hasattr(shape, "radius"):  # a sphere, a capsule or a cylinder, along x; a capsule's ends are round
        ends = 0.0 if isinstance(shape, physx.PhysxCollisionShapeCylinder) else shape.radius
        return np.zeros(3), np.array([getattr(shape, "half_length", 0.0) + ends, shape.radius, shape.radius])
    if hasattr(shape, "half_size"):
        return np.zeros(3), np.asarray(shape.half_size, float)
    vertices = np.asarray(shape.vertices, float) * np.asarray(shape.scale, float)
    return (vertices.max(0) + vertices.min(0)) / 2, np.ptp(vertices, axis=0) / 2


def _balls(shape: Any) -> Float64:
    """Return balls that cover a shape (balls, 4), center and radius [m] in the link's frame: one for each slice."""
    center, half = shape_box(shape)
    round_ = hasattr(shape, "radius")
    axis = 0 if round_ else int(half.argmax())
    across = float(half[1] if round_ else np.linalg.norm(np.delete(half, axis)))
    slices = int(np.clip(np.ceil(half[axis] / max(across, 1e-6)), 1, MAX_BALLS))
    at = np.tile(center, (slices, 1))
    at[:, axis] += half[axis] * ((2 * np.arange(slices) + 1) / slices - 1)
    place = np.asarray(shape.local_pose.to_transformation_matrix(), float)
    radii = np.full((slices, 1), np.hypot(across, half[axis] / slices))
    return np.hstack([at @ place[:3, :3].T + place[:3, 3], radii])
