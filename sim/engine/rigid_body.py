r"""Mass matrix of a tree of rigid bodies in programs of JAX, by the extension.

The composite-rigid-body algorithm (R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, section 6.2), with
all quantities in the axes of the base and about its origin. With the axis a_j and the place p_j of joint j, its motion
is s_j = (w, v) = (a_j, p_j x a_j), or (0, a_j) if it slides. All that it moves has the mass m, the first moment h and
the inertia tensor I, so that the momenta under s_j, and the mass matrix, are::

    linear   l_j = m v + w x h        angular   k_j = I w + h x v
    M_ij = M_ji = s_i . (k_j, l_j)    for a joint i that moves joint j, or is joint j; else 0
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.arrays.read_only import read_only
from batchpid.native.task_space_extension import BODY
from batchpid.sim.engine.native import xla
from batchpid.task_space.spatial_inertia import SpatialInertia, inertia_rows, moved_matrix, spatial_matrix


class RigidBodies(NamedTuple):
    """Bodies of a robot on a fixed base, one for each joint, parents first; links that cannot move apart are one body.

    A body's frame is its joint's frame: the joint turns about x or slides along it.
    """

    tree: NDArray[np.int32]
    """(dof, 2): number of the joint above, -1 for none; 1 for a joint that slides."""
    rotation: Float64
    """Orientation of the joint at position 0 in the frame of its parent (dof, 3, 3)."""
    position: Float64
    """Position there (dof, 3) [m]."""
    mass: Float64
    """(dof,) [kg]."""
    center: Float64
    """Center of mass in the body's frame (dof, 3) [m]."""
    tensor: Float64
    """Inertia tensor about it, in the body's axes (dof, 3, 3) [kg m^2]."""
    base: SpatialInertia
    """Inertia of the base, with all that is fixed to it, in its frame."""
    links: Mapping[str, tuple[int, Float64]]
    """Body of each simulated link, by name, -1 for the base; and the link's pose in the frame of the body (4, 4)."""

    def table(self) -> Float64:
        """Return all but the tree, a row for each body (dof, 25)."""
        return np.hstack([getattr(self, name).reshape(-1, numbers) for name, numbers in BODY.items()])

    def frozen(self) -> RigidBodies:
        """Return these bodies, read-only."""
        links = {name: (body, read_only(place)) for name, (body, place) in self.links.items()}
        bodies, base = RigidBodies._make(map(read_only, self)), SpatialInertia._make(map(read_only, self.base))
        return bodies._replace(base=base, links=MappingProxyType(links))

    def inertias(self) -> Float64:
        """Return mass, center and tensor, a row for each body and one for the base (dof + 1, 13)."""
        base = np.hstack([self.base.mass, self.base.center, self.base.tensor.ravel()])
        return np.vstack([self.table()[:, -len(base) :], base])

    def varied(self, added: Mapping[str, Float64]) -> Float64:
        """Return :meth:`inertias` of n robots (n, dof + 1, 13), with spatial inertias (n, 6, 6) added to links."""
        nominal, of_bodies = self.inertias(), dict[int, Float64]()
        rows = np.tile(nominal, (len(next(iter(added.values()))), 1, 1))
        for name, spatial in added.items():
            body, place = self.links[name]
            own = SpatialInertia(nominal[body, 0], nominal[body, 1:4], nominal[body, 4:].reshape(3, 3))
            of_bodies[body] = of_bodies.get(body, spatial_matrix(own)) + moved_matrix(spatial, place)
        for body, matrices in of_bodies.items():
            rows[:, body] = inertia_rows(matrices)
        return rows


def mass_matrix(bodies: RigidBodies, qpos: Any) -> Any:
    """Return the mass matrices (..., dof, dof) [kg m^2 or kg] at ``qpos`` (..., dof), a JAX array on the CPU."""
    return xla.mass_matrix(bodies.tree, bodies.table(), qpos)
