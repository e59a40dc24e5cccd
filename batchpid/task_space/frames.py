"""Frames, rotations and spatial inertias, with any leading axes, for NumPy and JAX arrays.

A frame is a matrix (..., 3, 4): the axes of the frame as columns, and its position. A pose (..., 7)
is a position and a unit quaternion (w, x, y, z), the order that SAPIEN and viser use. Functions of
quaternions that follow :func:`compose` are for NumPy alone. Products are written as sums of
elementwise products: their rounding does not depend on the number of rows, as a library's does.

Spatial inertias: R. Featherstone, Rigid Body Dynamics Algorithms (2008), section 2.13.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Array, Float64, Rows
from batchpid.arrays.elementwise import namespace

Vector = tuple[Array, Array, Array]
"""Components x, y and z of vectors, arrays of one shape: XLA makes one loop of operations on them,
but not of those on slices of one array.
"""


def components(vectors: Array) -> Vector:
    """Return the components of vectors (..., 3)."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def added(a: Vector, b: Vector) -> Vector:
    """Return the sums of vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def scaled(a: Vector, b: Array) -> Vector:
    """Return vectors times numbers."""
    return a[0] * b, a[1] * b, a[2] * b


def crossed(a: Vector, b: Vector) -> Vector:
    """Return the cross products of vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def cross(a: Array, b: Array) -> Array:
    """Return the cross product of (..., 3) and (..., 3)."""
    return namespace(a, b).stack(crossed(components(a), components(b)), axis=-1)


def rotate(turn: Array, vector: Array) -> Array:
    """Return the vectors (..., 3) turned by matrices (..., 3, 3): R v."""
    return (
        turn[..., 0] * vector[..., :1]
        + turn[..., 1] * vector[..., 1:2]
        + turn[..., 2] * vector[..., 2:3]
    )


def unrotate(turn: Array, vector: Array) -> Array:
    """Return the vectors (..., 3) in the axes of matrices (..., 3, 3): R^T v."""
    return (
        turn[..., 0, :] * vector[..., :1]
        + turn[..., 1, :] * vector[..., 1:2]
        + turn[..., 2, :] * vector[..., 2:3]
    )


def in_axes(turn: Array, twists: Array) -> Array:
    """Return the columns of ``twists`` (..., 6, n) in the axes of matrices (..., 3, 3)."""
    xp = namespace(turn, twists)
    columns = namespace(twists).moveaxis(twists, -1, -2)
    halves = [
        unrotate(turn[..., None, :, :], part) for part in (columns[..., :3], columns[..., 3:])
    ]
    return xp.moveaxis(xp.concatenate(halves, axis=-1), -1, -2)


def multiply(a: Array, b: Array) -> Array:
    """Return the products of matrices (..., n, 3) and (..., 3, m)."""
    return a[..., :1] * b[..., :1, :] + a[..., 1:2] * b[..., 1:2, :] + a[..., 2:3] * b[..., 2:3, :]


def turned(frame: Array, inner: Array) -> Array:
    """Return the frames ``inner`` (..., 3, 4), which are given in ``frame`` (..., 3, 4), in the
    axes in which ``frame`` is given.
    """
    xp = namespace(frame, inner)
    product = multiply(frame[..., :3], inner)
    shift = xp.zeros_like(frame[..., :3])
    return product + xp.concatenate([shift, frame[..., 3:]], axis=-1)


def matrix_of(wxyz: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any length but 0."""
    xp = namespace(wxyz)
    w, x, y, z = (wxyz[..., k] for k in range(4))
    s = 2 / (w * w + x * x + y * y + z * z)
    rows = (
        (1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)),
    )
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def wxyz_of(turn: Array) -> Array:
    """Return the unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    4 q q^T is linear in the entries of the matrix; its row with the largest diagonal entry is a
    multiple of q.
    """
    xp = namespace(turn)
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = (
        [turn[..., i, j] for j in range(3)] for i in range(3)
    )
    squares = [1 + r00 + r11 + r22, 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22]
    wx = r21 - r12
    wy = r02 - r20
    wz = r10 - r01
    xy = r10 + r01
    xz = r02 + r20
    yz = r21 + r12
    rows = [
        [squares[0], wx, wy, wz],
        [wx, squares[1], xy, xz],
        [wy, xy, squares[2], yz],
        [wz, xz, yz, squares[3]],
    ]
    table = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    best = xp.stack(squares, axis=-1).argmax(-1)
    q = xp.take_along_axis(table, best[..., None, None], axis=-2)[..., 0, :]
    q = q / xp.sqrt((q * q).sum(-1, keepdims=True))
    return xp.where(q[..., :1] < 0, -q, q)


def pose_of(frame: Array) -> Array:
    """Return the poses (..., 7) of frames (..., 3, 4)."""
    return namespace(frame).concatenate([frame[..., 3], wxyz_of(frame[..., :3])], axis=-1)


def rotation_error(goal: Array, wxyz: Array) -> Array:
    """Return the rotation vectors (..., 3) [rad] from ``wxyz`` to ``goal`` (..., 4) in the world,
    at most pi long.

    The quaternions need not have unit length: with (w, v) = goal * conjugate(wxyz) the angle is 2
    atan2(|v|, w).
    """
    xp = namespace(goal, wxyz)
    gw = goal[..., :1]
    g = goal[..., 1:]
    qw = wxyz[..., :1]
    q = wxyz[..., 1:]
    w = gw * qw + (g * q).sum(-1, keepdims=True)
    v = qw * g - gw * q - cross(g, q)
    w, v = xp.where(w < 0, -w, w), xp.where(w < 0, -v, v)
    length = xp.sqrt((v * v).sum(-1, keepdims=True))
    small = length < 1e-12 * w
    return v * xp.where(
        small, 2 / xp.where(small, w, 1.0), 2 * xp.atan2(length, w) / xp.where(small, 1.0, length)
    )


def pose_error(goal: Array, pose: Array) -> Array:
    """Return the errors (..., 6) [m, rad] from ``pose`` to ``goal`` (..., 7), in the axes of the
    world.
    """
    turn = rotation_error(goal[..., 3:], pose[..., 3:])
    return namespace(goal, pose).concatenate([goal[..., :3] - pose[..., :3], turn], axis=-1)


def moved(pose: Array, step: Array) -> Array:
    """Return poses (..., 7) shifted and turned by ``step`` (..., 6) [m, rad], in the axes of the
    world.
    """
    xp = namespace(pose, step)
    half = 0.5 * step[..., 3:]
    angle = xp.sqrt((half * half).sum(-1, keepdims=True))
    # sinc(x) is sin(pi x) / (pi x): without a turn it is 1.
    turn = xp.concatenate([xp.cos(angle), xp.sinc(angle / np.pi) * half], axis=-1)
    wxyz = compose(turn, pose[..., 3:])
    return xp.concatenate([pose[..., :3] + step[..., :3], wxyz], axis=-1)


def compose(a: Array, b: Array) -> Array:
    """Return the rotation b followed by a: Hamilton's product of (..., 4) and (..., 4)."""
    aw, ax, ay, az = (a[..., k] for k in range(4))
    bw, bx, by, bz = (b[..., k] for k in range(4))
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return namespace(a, b).stack([w, x, y, z], axis=-1)


def inverse(q: Rows) -> Rows:
    """Return the inverse of unit quaternions (..., 4): the conjugate."""
    return np.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def placed(base: Rows, poses: Rows) -> Rows:
    """Return poses (..., 7), which are given in the frame of ``base`` (..., 7), in the frame in
    which ``base`` is given.
    """
    position = base[..., :3] + rotate(matrix_of(base[..., 3:]), poses[..., :3])
    return np.concatenate([position, compose(base[..., 3:], poses[..., 3:])], axis=-1)


def about(axis: Rows, angle: Rows) -> Rows:
    """Return the rotations (..., 4) by ``angle`` (...) [rad] about a unit ``axis`` (3,)."""
    half = np.asarray(angle) / 2
    return np.concatenate([np.cos(half)[..., None], np.sin(half)[..., None] * axis], axis=-1)


def from_rpy(rpy: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation of a URDF's ``rpy`` [rad]: about the fixed x, then y, then z."""
    roll, pitch, yaw = (
        about(axis, angle) for axis, angle in zip(np.eye(3), np.asarray(rpy, float), strict=True)
    )
    return compose(yaw, compose(pitch, roll))


def to_rpy(q: Rows) -> NDArray[np.float64]:
    """Return the ``rpy`` [rad] of a rotation (4,), the inverse of :func:`from_rpy`, exact at pitch
    +-pi/2 too.

    With R = Rz(yaw) Ry(pitch) Rx(roll), yaw = atan2(R10, R00). Pitch and roll follow from Rz(-yaw)
    R = Ry(pitch) Rx(roll), which has a solution for any yaw where cos(pitch) = 0.
    """
    (r00, r01, r02), (r10, r11, r12), (r20, _, _) = np.asarray(matrix_of(np.asarray(q, float)))
    yaw = np.arctan2(r10, r00)
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.array(
        [np.arctan2(s * r02 - c * r12, c * r11 - s * r01), np.arctan2(-r20, c * r00 + s * r10), yaw]
    )


class SpatialInertia(NamedTuple):
    """Mass [kg], center of mass (3,) [m] and inertia tensor about it (3, 3) [kg m^2], in the axes
    of one frame.
    """

    mass: float
    center: Float64
    tensor: Float64

    def moved(self, position: Float64, wxyz: Float64) -> SpatialInertia:
        """Return the inertia in another frame, in which its present frame has this position and
        rotation: c' = p + R c.

        The tensor about the center of mass turns with the axes: I' = R I R^T.
        """
        matrix = matrix_of(wxyz)
        return SpatialInertia(
            self.mass, position + matrix @ self.center, matrix @ self.tensor @ matrix.T
        )


def spatial_matrix(inertia: SpatialInertia) -> Float64:
    """Return the matrix S (6, 6) of the kinetic energy 1/2 (v, w)^T S (v, w), with v the velocity
    of the origin.

    S = [[m 1, -m C], [m C, I - m C C]] with C a = c x a.
    """
    mass = inertia.mass
    # The origin moves with v; the center of mass with v + w x c.
    cross = _cross_matrix(inertia.center)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = mass * np.eye(3)
    matrix[:3, 3:] = -mass * cross
    matrix[3:, :3] = mass * cross
    matrix[3:, 3:] = inertia.tensor - mass * cross @ cross
    return matrix


def moved_matrix(matrix: Float64, place: Float64) -> Float64:
    """Return spatial matrices (..., 6, 6) in another frame, in which their present frame has the
    homogeneous pose ``place`` (4, 4).
    """
    turn = np.zeros(
        (6, 6)
    )  # velocity (v, w) in the matrices' frame, from the velocity in the other one
    turn[:3, :3] = turn[3:, 3:] = place[:3, :3].T
    turn[:3, 3:] = -place[:3, :3].T @ _cross_matrix(place[:3, 3])
    return turn.T @ matrix @ turn


def inertia_rows(matrices: Float64) -> Float64:
    """Return mass, center and inertia tensor, a row for each spatial matrix (n, 6, 6): (n, 13)."""
    mass = matrices[:, 0, 0, None]
    # The block m C holds the center of mass thrice; one entry of each is read.
    center = matrices[:, [5, 3, 4], [1, 2, 0]] / mass
    cross = _cross_matrix(center)
    tensor = matrices[:, 3:, 3:] + mass[:, :, None] * cross @ cross
    return np.hstack([mass, center, tensor.reshape(-1, 9)])


def _cross_matrix(vector: Float64) -> Float64:
    """Return C (..., 3, 3) with C a = c x a for vectors c (..., 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.moveaxis(
        np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]),
        (0, 1),
        (-2, -1),
    )


def total(parts: Sequence[SpatialInertia]) -> SpatialInertia:
    """Return the inertia of ``parts``, given in one frame, as one body (Huygens and Steiner).

    m = sum m_i, c = sum m_i c_i / m, I = sum (I_i + m_i (d_i.d_i 1 - d_i d_i^T)) with d_i = c_i -
    c. A body without mass is at its first part.
    """
    mass = sum(part.mass for part in parts)
    center = parts[0].center
    if mass > 0:
        center = sum((part.mass * part.center for part in parts), start=np.zeros(3)) / mass
    tensor = np.zeros((3, 3))
    for part in parts:
        d = part.center - center
        tensor += part.tensor + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return SpatialInertia(mass, center, tensor)
