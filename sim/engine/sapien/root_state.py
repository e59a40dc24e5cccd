"""State of an articulation's root link: position, quaternion w, x, y, z, linear and angular velocity (13,)."""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
from numpy.typing import NDArray

ROOT_SIZE = 13


def read_root(articulation: Any) -> NDArray[np.float32]:
    """Return the state of the root link of a SAPIEN articulation (13,)."""
    pose = articulation.get_root_pose()
    velocity = articulation.get_root_linear_velocity(), articulation.get_root_angular_velocity()
    return np.concatenate([pose.p, pose.q, *velocity], dtype=np.float32)


def write_root(articulation: Any, state: NDArray[np.float32]) -> None:
    """Set the state of the root link of a SAPIEN articulation (13,)."""
    articulation.set_root_pose(sapien.Pose(state[:3], state[3:7]))
    articulation.set_root_linear_velocity(state[7:10])
    articulation.set_root_angular_velocity(state[10:])
