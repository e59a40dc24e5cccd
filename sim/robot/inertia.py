"""Inertia tensors that a body can have.

The principal moments a <= b <= c of a body are positive and satisfy the triangle inequality c <= a + b. This says that
the density-weighted covariance tr(I)/2 - I has no negative eigenvalue: P. M. Wensing, S. Kim, J.-J. E. Slotine,
"Linear matrix inequalities for physically consistent inertial parameter identification", IEEE Robotics and Automation
Letters 3 (2018).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from batchpid.arrays.array_types import Float64

SLENDER = 1e-3  # smallest principal moment over the largest of a tensor that had to be replaced; PhysX divides by it
DENSITY = 1000.0  # [kg/m^3] of water, with which SAPIEN computes the mass of shapes


def from_entries(entries: Sequence[float]) -> Float64:
    """Return the tensor (3, 3) of its entries xx, xy, xz, yy, yz, zz."""
    tensor = np.zeros((3, 3))
    tensor[np.triu_indices(3)] = entries
    return tensor + np.triu(tensor, 1).T


def nearest_physical(tensor: Float64) -> Float64:
    """Return the physical inertia tensor (3, 3) that is nearest to a symmetric one in the Frobenius norm.

    The nearest has the same principal axes, so the moments are projected on the cone of the triangle inequalities: on
    its face c = a + b or, if a would be negative there, on its edge (0, m, m). Then a is raised to SLENDER times c. The
    result is zero if there is no positive part.
    """
    (a, b, c), axes = np.linalg.eigh(tensor)
    excess = max(c - a - b, 0.0) / 3
    a, b, c = a + excess, b + excess, c - excess
    if a < 0:
        a, b, c = 0.0, (b + c) / 2, (b + c) / 2
    moments = np.maximum([a, b, c], 0.0)
    moments[0] = max(moments[0], SLENDER * moments[2])
    return (axes * moments) @ axes.T


def triangle_excess(tensor: Float64) -> float:
    """Return (c - a - b) / c of the principal moments of a tensor (3, 3): positive if no body has it."""
    a, b, c = np.linalg.eigvalsh(tensor)
    return float((c - a - b) / c)


def ball(mass: float) -> Float64:
    """Return the inertia tensor (3, 3) [kg m^2] of a ball of ``mass`` [kg] at DENSITY: 2/5 m r^2."""
    radius = (3 * mass / (4 * np.pi * DENSITY)) ** (1 / 3)
    return 0.4 * mass * radius**2 * np.eye(3)
