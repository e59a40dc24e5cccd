"""Robots on a floor: the scene that the page and films draw."""

from __future__ import annotations

import math

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.findings import Finding
from batchpid.sim.robot.robot import Robot
from batchpid.sim.view.surfaces import surfaces
from batchpid.task_space.frames import placed

MAX_ROBOTS = 64
"""Largest number of robots in a scene."""
FIELD_OF_VIEW = math.radians(42)
"""Vertical field of view of the camera [rad]."""
TILE = 0.5
"""Edge of a tile of the floor [m]."""
_PITCH = 1.3
"""Distance between neighbours, in reaches: two robots overlap only when both stretch out."""
_CAMERA_DIRECTION = np.array([-0.62, -0.80, 0.52])


class RobotScene:
    """``count`` robots in a square around the origin, on a floor.

    The floor is at height 0 if physics has a ``ground``, otherwise at the lowest point of the start
    pose. ``deviation`` [m] is the largest distance of a triangle from a round surface.
    """

    def __init__(
        self,
        robot: Robot,
        count: int,
        ground: bool,
        deviation: float,
    ) -> None:
        self._tree = robot.rigid_tree
        self.ground = ground
        self.findings: list[Finding] = []
        """Meshes that cannot be read. Their links are drawn by the collision shapes, or not at
        all.
        """
        self.surfaces = surfaces(robot, deviation, self.findings)
        """Coloured triangles of one robot."""
        self._links = [self._tree.index(surface.link) for surface in self.surfaces]
        # The 95th percentile over seeded poses: a single stretched pose should not push all robots
        # apart.
        samples = ts.link_poses(self._tree, robot.sample(200, seed=0))
        distances = np.linalg.norm(samples[..., :2], axis=-1).max(1)
        self.reach = max(0.3, float(np.quantile(distances, 0.95)))
        """Horizontal reach of a robot [m]."""
        row, column = np.divmod(np.arange(count), round(math.sqrt(count)))
        grid = np.stack([column, row, 0 * row], axis=1)
        self.positions: Float64 = _PITCH * self.reach * (grid - grid.max(0) / 2)
        """Positions of the robots (count, 3) [m]."""
        frames = ts.link_poses(self._tree, robot.start)[:, 2].min()
        lowest = min(float(frames), robot.dynamics().contacts.height(robot.start, base_too=True))
        self.floor = 0.0 if ground else lowest
        """Height of the floor [m]."""
        corner = np.abs(self.positions[0, :2]) + 2.0 * self.reach
        self.half_floor: Float64 = TILE * np.ceil(corner / TILE)
        """Half the edges of the floor under all robots (2,) [m], in whole tiles."""
        self.target: Float64 = np.array([0.0, 0.0, self.floor + 0.35 * self.reach])
        """Point that the camera looks at (3,) [m]."""
        size = 2 * math.hypot(*self.positions[0, :2]) + 2.0 * self.reach
        self.eye: Float64 = 1.02 * size * _CAMERA_DIRECTION + [0.0, 0.0, self.floor]
        """Position of the camera (3,) [m]."""
        self._qpos = np.tile(robot.start, (count, 1))
        self._base = np.tile([0.0, 0, 0, 1, 0, 0, 0], (count, 1))

    def place(self, qpos: Rows, base_pose: Rows | None = None) -> Float64:
        """Return the poses of the surfaces (count, surfaces, 7) [m] at the joint positions (count,
        dof) [rad or m].

        ``base_pose`` (count, 7) are the poses of floating bases. A robot with a number that is not
        finite stays where it was.
        """
        finite = np.isfinite(qpos).all(1, keepdims=True)
        if base_pose is not None:
            finite &= np.isfinite(base_pose).all(1, keepdims=True)
            self._base = np.where(finite, base_pose, self._base)
        self._qpos = np.where(finite, qpos, self._qpos)
        links = ts.link_poses(self._tree, self._qpos)[:, self._links]
        poses = placed(self._base[:, None], links)
        poses[..., :3] += self.positions[:, None]
        return poses
