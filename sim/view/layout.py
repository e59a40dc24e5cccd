"""Where robots stand when they are shown, and where one looks from: the same in the browser and in a film."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.robot.kinematics import Kinematics
from sim.robot.robot import Robot

Float64 = NDArray[np.float64]

_PITCH = 1.3
"""From robot to robot, in reaches: neighbours overlap only when both stretch out."""
_GAP = 0.6
"""Between two groups, in pitches."""
_AWAY = np.array([-0.62, -0.80, 0.52]) / np.linalg.norm([-0.62, -0.80, 0.52])
FIELD_OF_VIEW = math.radians(42)
"""Of the camera, vertically [rad]."""


class Stage(NamedTuple):
    """``places`` (robots, 3) [m], group by group; the camera's ``eye`` and what it looks ``at`` (3,); the ``reach``."""

    places: Float64
    eye: Float64
    at: Float64
    reach: float


def stage(kinematics: Kinematics, robot: Robot, groups: int, per_group: int) -> Stage:
    """Place ``groups`` blocks of ``per_group`` robots beside each other about the origin, near enough to a square."""
    reach = _reach(kinematics, robot)
    columns = max(1, round(math.sqrt(per_group / groups)))
    index = np.arange(per_group)
    block = np.stack([index % columns, index // columns, np.zeros(per_group)], axis=1)
    width = columns + (_GAP if groups > 1 else 0.0)
    grid = np.concatenate([block + np.array([group * width, 0.0, 0.0]) for group in range(groups)])
    places = _PITCH * reach * (grid - (grid.min(0) + grid.max(0)) / 2)
    size = float(np.hypot(*np.ptp(places, axis=0)[:2])) + 2.0 * reach
    return Stage(places, 1.16 * size * _AWAY, np.array([0.0, 0.0, 0.35 * reach]), reach)


def _reach(kinematics: Kinematics, robot: Robot) -> float:
    """Return how far from its base a robot gets: the 95th percentile over seeded poses, at least 0.3 m."""
    poses = kinematics.poses(robot.sample(200, seed=0))
    return max(0.3, float(np.quantile(np.linalg.norm(poses.position[..., :2], axis=-1).max(1), 0.95)))
