"""Kinematic tree of a robot, for :mod:`batchpid.task_space`."""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.errors import RobotError
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.merging import merge_fixed_links
from batchpid.sim.robot.rotations import from_rpy
from batchpid.sim.robot.spatial_inertia import SpatialInertia
from batchpid.task_space.kinematic_tree import KinematicTree


def kinematic_tree(robot: RobotDescription, **options: Any) -> KinematicTree:
    """Return the tree of ``robot`` with the masses of its URDF; ``options`` are the tree's armature and gravity.

    Raises RobotError if the base is not fixed, or the mass of a link is known to the engine alone.
    """
    if not robot.fixed_base:
        raise RobotError(f"{robot.path}: a kinematic tree has a fixed base; load the robot with fixed_base=True")

    def refuse(link: str) -> SpatialInertia:
        remedy = "its mass would come from its collision shapes, which only the engine knows; give it an <inertial>"
        raise RobotError(f"{robot.path}: link {link!r} has no <inertial>: {remedy}")

    # Merging asks for the inertia of shapes only where a link that has shapes has no <inertial>.
    inertias = merge_fixed_links(robot.urdf, refuse).inertias
    children = {joint.child_link for joint in robot.all_joints}
    (root,) = (link.name for link in robot.links if link.name not in children)
    links = [root, *(joint.child_link for joint in robot.all_joints)]
    empty = SpatialInertia(0.0, np.zeros(3), np.zeros((3, 3)))
    of_links = [inertias.get(link, empty) for link in links]
    return KinematicTree(
        links=tuple(links),
        parent=np.array([-1, *(links.index(joint.parent_link) for joint in robot.all_joints)]),
        joint_types=("fixed", *(_KIND.get(joint.type, "fixed") for joint in robot.all_joints)),
        joint_names=robot.joint_names,
        position=np.array([(0.0, 0.0, 0.0), *(joint.origin for joint in robot.all_joints)]),
        wxyz=np.array([(1.0, 0.0, 0.0, 0.0), *(from_rpy(joint.rpy) for joint in robot.all_joints)]),
        axis=np.array([(1.0, 0.0, 0.0), *(joint.axis for joint in robot.all_joints)]),
        mass=np.array([inertia.mass for inertia in of_links]),
        center=np.array([inertia.center for inertia in of_links]),
        inertia=np.array([inertia.tensor for inertia in of_links]),
        lower=np.where(robot.continuous, -np.inf, robot.lower),
        upper=np.where(robot.continuous, np.inf, robot.upper),
        **options,
    )


_KIND = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
