"""Rotations as unit quaternions w, x, y, z, batched over any leading axes; the order that SAPIEN
and viser use.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Rows


def multiply(a: Rows, b: Rows) -> Rows:
    """Return the rotation b followed by a: Hamilton's product of (..., 4) and (..., 4)."""
    aw, ax, ay, az = (a[..., k] for k in range(4))
    bw, bx, by, bz = (b[..., k] for k in range(4))
    w, x = aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by
    y, z = aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw
    return np.stack([w, x, y, z], axis=-1)


def rotate(q: Rows, v: Rows) -> Rows:
    """Return vectors v (..., 3) rotated by q (..., 4): v + 2 w (u x v) + 2 u x (u x v), with u the
    vector part.
    """
    w, u = q[..., :1], q[..., 1:]
    t = 2 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def inverse(q: Rows) -> Rows:
    """Return the inverse of unit quaternions (..., 4): the conjugate."""
    return np.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def placed(base: Rows, poses: Rows) -> Rows:
    """Return poses (..., 7) that are given in the frame of ``base`` (..., 7), in the frame of that
    one.
    """
    position = base[..., :3] + rotate(base[..., 3:], poses[..., :3])
    return np.concatenate([position, multiply(base[..., 3:], poses[..., 3:])], axis=-1)


def about(axis: Rows, angle: Rows) -> Rows:
    """Return the rotations (..., 4) by ``angle`` (...) [rad] about a unit ``axis`` (3,)."""
    half = np.asarray(angle) / 2
    return np.concatenate([np.cos(half)[..., None], np.sin(half)[..., None] * axis], axis=-1)


def from_rpy(rpy: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation of a URDF's ``rpy`` [rad]: about the fixed x, then y, then z."""
    roll, pitch, yaw = (
        about(axis, angle) for axis, angle in zip(np.eye(3), np.asarray(rpy, float), strict=True)
    )
    return multiply(yaw, multiply(pitch, roll))


def to_rpy(q: Rows) -> NDArray[np.float64]:
    """Return the ``rpy`` [rad] of a rotation (4,), the inverse of :func:`from_rpy`, exact at pitch
    +-pi/2 too.

    With R = Rz(yaw) Ry(pitch) Rx(roll), yaw = atan2(R10, R00). Pitch and roll follow from Rz(-yaw)
    R = Ry(pitch) Rx(roll), which has a solution for any yaw where cos(pitch) = 0.
    """
    columns = rotate(np.broadcast_to(np.asarray(q, float), (3, 4)), np.eye(3))
    (r00, r10, r20), (r01, r11, _), (r02, r12, _) = columns
    yaw = np.arctan2(r10, r00)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array(
        [np.arctan2(s * r02 - c * r12, c * r11 - s * r01), np.arctan2(-r20, c * r00 + s * r10), yaw]
    )
