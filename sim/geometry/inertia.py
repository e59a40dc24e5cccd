"""Inertia tensors that a body can have.

The principal moments a <= b <= c of a body are positive and satisfy the triangle inequality c <= a
+ b. This says that the density-weighted covariance tr(I)/2 - I has no negative eigenvalue: P. M.
Wensing, S. Kim, J.-J. E. Slotine, "Linear matrix inequalities for physically consistent inertial
parameter identification", IEEE Robotics and Automation Letters 3 (2018).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from batchpid.arrays.array_types import Float64

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
LEAST_MASS = 1e-9
"""Mass [kg] of a row without mass: 0 stands for a mass that the file does not give."""
DENSITY = 1000.0  # [kg/m^3] of water, with which SAPIEN computes the mass of shapes
# Least principal moment over the largest of a tensor that had to be replaced; PhysX divides by it.
SLENDER = 1e-3
# Mass [kg] and principal moment [kg m^2] with a reciprocal that single precision can hold.
SMALLEST = 1e-30
SMALLEST_RATIO = 1e-9  # of principal moments that SAPIEN's eigenvalues and single precision resolve


def from_entries(entries: Sequence[float]) -> Float64:
    """Return the tensor (3, 3) of its entries xx, xy, xz, yy, yz, zz."""
    tensor = np.zeros((3, 3))
    tensor[np.triu_indices(3)] = entries
    return tensor + np.triu(tensor, 1).T


def nearest_physical(tensor: Float64) -> Float64:
    """Return the physically possible inertia tensor (3, 3) nearest to a symmetric one in the
    Frobenius norm.

    The nearest has the same principal axes, so the moments are projected on the cone of the
    triangle inequalities: on its face c = a + b or, if a would be negative there, on its edge (0,
    m, m). Then a is raised to SLENDER times c. The result is zero if no moment is positive.
    """
    (a, b, c), axes = np.linalg.eigh(tensor)
    excess = max(c - a - b, 0.0) / 3
    a = a + excess
    b = b + excess
    c = c - excess
    if a < 0:
        a, b, c = 0.0, (b + c) / 2, (b + c) / 2
    moments = np.maximum([a, b, c], 0.0)
    moments[0] = max(moments[0], SLENDER * moments[2])
    nearest: Float64 = (axes * moments) @ axes.T
    return nearest


def possible_inertia(mass: float, tensor: Float64) -> tuple[Float64, tuple[str, str] | None]:
    """Return an inertia tensor (3, 3) if PhysX can simulate it, else the nearest that a body of
    that mass has, with the problem and its figures.
    """
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] >= max(SMALLEST, SMALLEST_RATIO * moments[2]):
        return tensor, None
    if moments[2] >= SMALLEST:
        changed = nearest_physical(tensor)
    else:
        changed = np.zeros((3, 3))
    done = "the nearest possible one is used"
    if changed.max() < SMALLEST:
        changed = ball(mass)
        done = f"the tensor of a ball of its mass at {DENSITY:g} kg/m^3 is used"
    before = " ".join(f"{moment:.3g}" for moment in moments)
    after = " ".join(f"{moment:.3g}" for moment in np.linalg.eigvalsh(changed))
    text = f"no body has such an inertia tensor: {done}"
    return changed, (text, f"moments {before} kg m^2, used {after}")


def triangle_excess(tensor: Float64) -> float:
    """Return (c - a - b) / c of the principal moments of a tensor (3, 3): positive if the tensor is
    impossible.
    """
    a, b, c = np.linalg.eigvalsh(tensor)
    return float((c - a - b) / c)


def ball(mass: float) -> Float64:
    """Return the inertia tensor (3, 3) [kg m^2] of a ball of ``mass`` [kg] at DENSITY: 2/5 m
    r^2.
    """
    radius = (3 * mass / (4 * np.pi * DENSITY)) ** (1 / 3)
    tensor: Float64 = 0.4 * mass * radius**2 * np.eye(3)
    return tensor
