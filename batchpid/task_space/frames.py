"""Frames, rotations and spatial inertias, with any leading axes, for NumPy and JAX arrays.

A frame is a matrix (..., 3, 4): the axes of the frame as columns, and its position. A pose (..., 7)
is a position and a unit quaternion (w, x, y, z), the order that SAPIEN and viser use. Products are
written as sums of elementwise products: their rounding does not depend on the number of rows, as a
library's does.

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


def cross_matrix(vector: Array) -> Array:
    """Return C (..., 3, 3) with C a = c x a for vectors c (..., 3)."""
    # Row i is e_i x c.
    return cross(namespace(vector).eye(3, dtype=vector.dtype), vector[..., None, :])


def rotate(turn: Array, vector: Array) -> Array:
    """Return the vectors (..., 3) turned by matrices (..., 3, 3): R v."""
    return (turn * vector[..., None, :]).sum(-1)


def unrotate(turn: Array, vector: Array) -> Array:
    """Return the vectors (..., 3) in the axes of matrices (..., 3, 3): R^T v."""
    return (turn * vector[..., None]).sum(-2)


def matrix_of(wxyz: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any length but 0.

    R = 1 + 2 (w C + C C) / (w, v)^2 with C a = v x a, and C C = v v^T - v^2 1.
    """
    v = wxyz[..., 1:]
    scale = 2 / (wxyz * wxyz).sum(-1)[..., None, None]
    eye = namespace(wxyz).eye(3, dtype=wxyz.dtype)
    square = v[..., None] * v[..., None, :] - (v * v).sum(-1)[..., None, None] * eye
    return eye + scale * (wxyz[..., :1, None] * cross_matrix(v) + square)


def wxyz_of(turn: Array) -> Array:
    """Return the unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    4 q q^T is linear in the entries of the matrix; its row with the largest diagonal entry is a
    multiple of q.
    """
    xp = namespace(turn)
    back = xp.swapaxes(turn, -1, -2)
    odd = turn - back
    trace = xp.trace(turn, axis1=-2, axis2=-1)[..., None, None]
    axis = xp.stack([odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]], axis=-1)[..., None]
    first = xp.concatenate([1 + trace, xp.swapaxes(axis, -1, -2)], axis=-1)
    even = turn + back + (1 - trace) * xp.eye(3, dtype=turn.dtype)
    table = xp.concatenate([first, xp.concatenate([axis, even], axis=-1)], axis=-2)
    best = xp.diagonal(table, axis1=-2, axis2=-1).argmax(-1)
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
    turn = compose(goal, inverse(wxyz))
    turn = xp.where(turn[..., :1] < 0, -turn, turn)
    w, v = turn[..., :1], turn[..., 1:]
    length = xp.sqrt((v * v).sum(-1, keepdims=True))
    # Small angles are 2 sin.
    small = length < 1e-12 * w
    angle = xp.where(small, 1.0, xp.atan2(length, w))
    return v * (2 * angle / xp.where(small, w, length))


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
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdims=True)
    v = aw * bv + bw * av + cross(av, bv)
    return namespace(a, b).concatenate([w, v], axis=-1)


def inverse(q: Array) -> Array:
    """Return the inverse of unit quaternions (..., 4): the conjugate."""
    return namespace(q).concatenate([q[..., :1], -q[..., 1:]], axis=-1)


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

    @property
    def principal(self) -> tuple[Float64, Float64]:
        """Principal moments (3,) [kg m^2] and axes (3, 3), the columns of a rotation."""
        moments, axes = np.linalg.eigh(self.tensor)
        return moments, axes * np.linalg.det(axes)


def spatial_matrix(inertia: SpatialInertia) -> Float64:
    """Return the matrix S (6, 6) of the kinetic energy 1/2 (v, w)^T S (v, w), with v the velocity
    of the origin.

    S = [[m 1, -m C], [m C, I - m C C]] with C a = c x a.
    """
    # The origin moves with v; the center of mass with v + w x c.
    mass = inertia.mass
    cross = cross_matrix(inertia.center)
    lower = [mass * cross, inertia.tensor - mass * cross @ cross]
    return np.block([[mass * np.eye(3), -mass * cross], lower])


def moved_matrix(matrix: Float64, place: Float64) -> Float64:
    """Return spatial matrices (..., 6, 6) in another frame, in which their present frame has the
    homogeneous pose ``place`` (4, 4).
    """
    # Velocity (v, w) in the matrices' frame, from the velocity in the other one.
    back = place[:3, :3].T
    zero = np.zeros((3, 3))
    turn = np.block([[back, -back @ cross_matrix(place[:3, 3])], [zero, back]])
    moved: Float64 = turn.T @ matrix @ turn
    return moved


def inertia_rows(matrices: Float64) -> Float64:
    """Return mass, center and inertia tensor, a row for each spatial matrix (n, 6, 6): (n, 13)."""
    mass = matrices[:, 0, 0, None]
    # The block m C holds the center of mass thrice; one entry of each is read.
    center = matrices[:, [5, 3, 4], [1, 2, 0]] / mass
    cross = cross_matrix(center)
    tensor = matrices[:, 3:, 3:] + mass[:, :, None] * cross @ cross
    return np.hstack([mass, center, tensor.reshape(-1, 9)])


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


Inertias = Sequence[Array]
"""Inertias about the origin of the world, in its axes: mass, first moment x, y, z, and entries xx,
yy, zz, xy, xz, yz of the inertia tensor; arrays (dof, rows).
"""
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def inertias_in(mass: Array, center: Array, tensor: Array, frames: Array) -> Inertias:
    """Return the inertias of bodies with ``center`` (n, 3, rows) and ``tensor`` (n, 3, 3, rows) in
    their ``frames`` (n, 3, 4, rows).
    """
    axes = range(3)
    turn = [[frames[:, i, k] for k in axes] for i in axes]
    r = [dotted(turn[i], [center[:, k] for k in axes]) + frames[:, i, 3] for i in axes]
    half = [[dotted(row, [tensor[:, k, j] for k in axes]) for j in axes] for row in turn]
    square = dotted(r, r)
    # R I R^T + m (r.r 1 - r r^T)
    entries = [
        dotted(half[i], turn[j]) + mass * ((square if i == j else 0.0) - r[i] * r[j])
        for i, j in _ENTRIES
    ]
    return mass + 0.0 * square, *[mass * at for at in r], *entries


def dotted(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """Return the sum of the products of components, in their order."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def momenta(inertias: Inertias, v: Vector, w: Vector) -> tuple[Vector, Vector]:
    """Return the momenta p = m v + w x c and k = I w + c x v."""
    mass, cx, cy, cz, xx, yy, zz, xy, xz, yz = inertias
    c = cx, cy, cz
    spin = dotted((xx, xy, xz), w), dotted((xy, yy, yz), w), dotted((xz, yz, zz), w)
    return added(scaled(v, mass), crossed(w, c)), added(spin, crossed(c, v))
