"""Kinematic tree of a robot, for :mod:`batchpid.task_space`."""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.errors import RobotError
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.merging import merge_fixed_links
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.rotations import from_rpy
from batchpid.task_space.spatial_inertia import SpatialInertia


def kinematic_tree(robot: RobotDescription, **options: Any) -> RigidTree:
    """Return the tree of ``robot``; ``options`` are its armature and gravity.

    Masses are from the URDF, or from SAPIEN for links without ``<inertial>`` but with collision shapes.

    Raises RobotError if the base is not fixed, or SAPIEN cannot build a link whose mass comes from its shapes.
    """
    if not robot.fixed_base:
        problem = "operational space and inverse kinematics need a kinematic tree, which has a fixed base"
        raise RobotError(f"{robot.path}: {problem}; load the robot with fixed_base=True, or control its joints")

    def of_shapes(link: str) -> SpatialInertia:
        return robot.link_masses[link].inertia or empty

    empty = SpatialInertia(0.0, np.zeros(3), np.zeros((3, 3)))
    inertias = merge_fixed_links(robot.urdf, of_shapes).inertias
    children = {joint.child_link for joint in robot.all_joints}
    (root,) = (link.name for link in robot.links if link.name not in children)
    links = [root, *(joint.child_link for joint in robot.all_joints)]
    of_links = [inertias.get(link, empty) for link in links]
    return RigidTree(
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
        coupling=robot.coupling,
        **options,
    )


_KIND = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
