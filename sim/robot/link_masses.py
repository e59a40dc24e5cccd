"""Masses of a robot's links, from ``<inertial>`` or from collision shapes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from batchpid.arrays.read_only import read_only
from batchpid.sim.robot.collision_shapes import LinkShape, link_shapes
from batchpid.sim.robot.parts import LinkMass, Urdf
from batchpid.sim.robot.simulated_links import simulated
from batchpid.task_space.rotations import rotate
from batchpid.task_space.spatial_inertia import SpatialInertia

_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def link_masses(robot: Urdf) -> dict[str, LinkMass]:
    """Return the mass of every link of the URDF, whether links are merged or not.

    Raises RobotError for a mesh that cannot be read.
    """
    repaired = {each.link for each in robot.repairs if each.code == "inertia"}
    inertias, shapes, masses = simulated(robot.urdf, True).inertias, link_shapes(robot.urdf, False), {}
    for link in robot.links:
        if (given := inertias.get(link.name)) is None:
            masses[link.name] = LinkMass(0.0, "none", 0.0, 0.0)
            continue
        inertia = SpatialInertia(given.mass, read_only(given.center), read_only(given.tensor))
        source = "shapes" if not link.inertial else "repaired" if link.name in repaired else "inertial"
        largest = np.linalg.eigvalsh(inertia.tensor)[-1]
        gyration = float(np.sqrt(largest / inertia.mass)) if inertia.mass > 0 else 0.0
        masses[link.name] = LinkMass(inertia.mass, source, gyration, _size(shapes[link.name]), inertia)
    return masses


def _size(shapes: Sequence[LinkShape]) -> float:
    """Return the diagonal [m] of the box around ``shapes``, 0 without any."""
    corners = []
    for shape in shapes:
        center, half = shape.half_extents
        corners.append(rotate(shape.wxyz, center + half * _CORNERS) + shape.position)
    return float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0))) if corners else 0.0
