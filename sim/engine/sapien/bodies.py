"""Rigid bodies of one of SAPIEN's articulations, for the algorithms of :mod:`batchpid.sim.engine.rigid_body`."""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.sim.engine.rigid_body import RigidBodies
from batchpid.task_space.rotations import from_rpy, rotate
from batchpid.task_space.spatial_inertia import SpatialInertia, total


def bodies_of(robot: Any) -> RigidBodies:
    """Return the bodies of one of SAPIEN's articulations."""
    dofs = {joint.name: dof for dof, joint in enumerate(robot.active_joints)}
    places: dict[Any, tuple[int, Float64]] = {}  # of each link: its body, and its pose in the body's frame
    parts: list[list[SpatialInertia]] = [[] for _ in range(len(dofs) + 1)]  # the last are the base's
    tree, at_zero = np.tile(np.array([-1, 0], np.int32), (len(dofs), 1)), np.tile(np.eye(4), (len(dofs), 1, 1))
    for link in robot.links:
        if link.parent is None:
            places[link] = -1, np.eye(4)
            continue
        joint, (body, place) = link.joint, places[link.parent]
        place = place @ _matrix(joint.pose_in_parent)
        if (dof := dofs.get(joint.name)) is not None:
            tree[dof], at_zero[dof] = (body, joint.type == "prismatic"), place
            body, place = dof, np.eye(4)
        place = place @ _matrix(joint.pose_in_child.inv())
        places[link] = body, place
    for link, (body, place) in places.items():
        at, principal = place @ _matrix(link.cmass_local_pose), np.diag([float(str(one)) for one in link.inertia])
        parts[body].append(SpatialInertia(link.mass, at[:3, 3], at[:3, :3] @ principal @ at[:3, :3].T))
    *bodies, base = [total(of_body) for of_body in parts]
    mass, center, tensor = map(np.array, zip(*bodies, strict=True))
    links = {link.name: place for link, place in places.items()}
    return RigidBodies(tree, at_zero[:, :3, :3], at_zero[:, :3, 3], mass, center, tensor, base, links).frozen()


def _matrix(pose: Any) -> Float64:
    """Return one of SAPIEN's poses (4, 4), homogeneous: from roll, pitch and yaw, as SAPIEN gives it to Pinocchio."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotate(np.broadcast_to(from_rpy(np.asarray(pose.rpy, float)), (3, 4)), np.eye(3)).T
    matrix[:3, 3] = pose.p
    return matrix
