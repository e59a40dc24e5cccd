"""Masses of a robot's links, as SAPIEN derives them from ``<inertial>`` or from collision shapes."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.read_only import read_only
from batchpid.sim.engine.sapien.building import link_inertia, unmerged_links
from batchpid.sim.engine.sapien.extents import shape_box
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.parts import LinkMass
from batchpid.task_space.spatial_inertia import SpatialInertia

_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


def link_masses(robot: RobotDescription) -> dict[str, LinkMass]:
    """Return the mass of every link of the URDF, whether links are merged or not.

    Raises RobotError if SAPIEN cannot build the robot.
    """
    _ = robot.self_contact  # which tries the shapes of a foreign robot in a child process
    repaired = {each.link for each in robot.repairs if each.code == "inertia"}
    builders, masses = unmerged_links(robot.urdf, robot.fixed_base), {}
    for link in robot.links:
        if not (link.inertial or link.collisions):
            masses[link.name] = LinkMass(0.0, "none", 0.0, 0.0)
            continue
        component = builders[link.name].build_physx_component()
        mass, center, tensor = link_inertia(component)
        inertia = SpatialInertia(mass, read_only(center), read_only(tensor))
        source = "shapes" if not link.inertial else "repaired" if link.name in repaired else "inertial"
        gyration = float(np.sqrt(np.linalg.eigvalsh(inertia.tensor)[-1] / inertia.mass))
        masses[link.name] = LinkMass(inertia.mass, source, gyration, _size(component.collision_shapes), inertia)
    return masses


def _size(shapes: Any) -> float:
    """Return the diagonal [m] of the box around ``shapes``, 0 without any."""
    corners: list[NDArray[np.float64]] = []
    for shape in shapes:
        center, half = shape_box(shape)
        place = np.asarray(shape.local_pose.to_transformation_matrix(), float)
        corners.append((center + half * _CORNERS) @ place[:3, :3].T + place[:3, 3])
    return float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0))) if corners else 0.0
