"""Positions of the robots and of the camera, the same in the browser and in a film."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Float64
from batchpid.sim.robot.robot import Robot

MAX_ROBOTS = 64
"""Largest number of robots on a page or in a film."""
FIELD_OF_VIEW = math.radians(42)
"""Vertical field of view of the camera [rad]."""
TILE = 0.5
"""Edge of a tile or of a cell of the floor [m]."""
_PITCH = 1.3
"""Distance between neighbours, in reaches: two robots overlap only when both stretch out."""
_GAP = 0.6
"""Extra distance between two groups, in pitches."""
_FILM_DISTANCE = 0.85
"""Distance of the camera of a film, as a share of that in the browser."""
_CAMERA_DIRECTION = np.array([-0.62, -0.80, 0.52]) / np.linalg.norm([-0.62, -0.80, 0.52])


class RobotLayout(NamedTuple):
    """Positions of the robots (robots, 3), group by group, of the camera and its target (3,); a robot's reach; the
    height of the floor. In m.
    """

    positions: Float64
    camera: Float64
    target: Float64
    reach: float
    floor: float

    @property
    def film_eye(self) -> Float64:
        """Position of the camera of a film (3,) [m]: nearer, as there no panels cover the sides of the picture."""
        return self.target + _FILM_DISTANCE * (self.camera - self.target)

    @property
    def corners(self) -> tuple[Float64, Float64]:
        """Lowest and highest x and y (2,) of a floor under all robots, in whole tiles [m]."""
        low = np.floor((self.positions.min(0)[:2] - 2.0 * self.reach) / TILE)
        high = np.ceil((self.positions.max(0)[:2] + 2.0 * self.reach) / TILE)
        return TILE * low, TILE * high


def arrange_robots(robot: Robot, groups: int, per_group: int, ground: bool) -> RobotLayout:
    """Return a layout of ``groups`` adjacent blocks of ``per_group`` robots around the origin, roughly square.

    The floor is at height 0 if physics has a ``ground``, otherwise at the height of the lowest link.
    """
    # The 95th percentile over seeded poses: a single stretched pose should not push all robots apart.
    poses = ts.link_poses(robot.rigid_tree, robot.sample(200, seed=0))
    distance = np.linalg.norm(poses[..., :2], axis=-1).max(1)
    reach = max(0.3, float(np.quantile(distance, 0.95)))
    columns = max(1, round(math.sqrt(per_group / groups)))
    group, index = np.divmod(np.arange(groups * per_group), per_group)
    grid = np.stack([index % columns + group * (columns + _GAP), index // columns, 0 * index], axis=1)
    positions = _PITCH * reach * (grid - (grid.min(0) + grid.max(0)) / 2)
    size = float(np.hypot(*np.ptp(positions, axis=0)[:2])) + 2.0 * reach
    floor = 0.0 if ground else lowest_point(robot)
    camera = 1.16 * size * _CAMERA_DIRECTION + [0.0, 0.0, floor]
    return RobotLayout(positions, camera, np.array([0.0, 0.0, floor + 0.35 * reach]), reach, floor)


def lowest_point(robot: Robot) -> float:
    """Return the height [m] of the lowest collision shape or link frame at the start pose."""
    frames = ts.link_poses(robot.rigid_tree, robot.start)[:, 2].min()
    return min(float(frames), robot.dynamics().height(robot.start, base_too=True))
