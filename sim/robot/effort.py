"""Effort limits for joints whose URDF gives none."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64

GRAVITY_MARGIN = 2.0  # of the effort that holds the joint still
SPEED = 3.0  # [rad/s or m/s], at which the joint's damping is overcome
ACCELERATION = 30.0  # [rad/s^2 or m/s^2] of all joints at once
POSES = 50


def suggested_effort_limit(gravity: Float64, mass_matrix: Float64, friction: ArrayLike, damping: ArrayLike) -> Float64:
    """Return an effort limit for each joint (dof,) [N m or N], from gravity (n, dof) and M (n, dof, dof) at n poses.

    It is 2 (max |g_j| + friction) + damping * 3 rad/s + max sum_k |M_jk| * 30 rad/s^2: twice the effort that holds the
    joint still, plus the effort that accelerates all joints at once, in the worst directions.
    """
    still = np.abs(gravity).max(0) + np.asarray(friction)
    inertia = np.abs(mass_matrix).sum(2).max(0)
    return GRAVITY_MARGIN * still + SPEED * np.asarray(damping) + ACCELERATION * inertia
