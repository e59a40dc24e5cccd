"""Spatial inertia of rigid bodies: mass, center of mass and inertia tensor, moved between frames
and added.

R. Featherstone, Rigid Body Dynamics Algorithms (2008), section 2.13.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.task_space.frames import matrix_of


class SpatialInertia(NamedTuple):
    """Mass [kg], center of mass (3,) [m] and inertia tensor about it (3, 3) [kg m^2], in the axes
    of one frame.
    """

    mass: float
    center: Float64
    tensor: Float64

    def moved(self, position: Float64, wxyz: Float64) -> SpatialInertia:
        """Return the inertia as seen from a frame in which its own has this position and rotation:
        c' = p + R c.

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
    """Return spatial matrices (..., 6, 6) in the frame in which their own has the homogeneous pose
    ``place`` (4, 4).
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
    return np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), (0, 1), (-2, -1))


def total(parts: Sequence[SpatialInertia]) -> SpatialInertia:
    """Return the inertia of ``parts``, given in one frame, as one body (Huygens and Steiner).

    m = sum m_i, c = sum m_i c_i / m, I = sum (I_i + m_i (d_i.d_i 1 - d_i d_i^T)) with d_i = c_i -
    c. The mass must be positive.
    """
    mass = sum(part.mass for part in parts)
    center = sum((part.mass * part.center for part in parts), start=np.zeros(3)) / mass
    tensor = np.zeros((3, 3))
    for part in parts:
        d = part.center - center
        tensor += part.tensor + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return SpatialInertia(mass, center, tensor)
