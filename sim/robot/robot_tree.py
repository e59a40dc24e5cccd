"""Rigid tree of a robot, for :mod:`batchpid.task_space`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from lxml import etree

from batchpid.sim.robot.merging import edges_of
from batchpid.sim.robot.xml import numbers
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.rotations import from_rpy
from batchpid.task_space.spatial_inertia import SpatialInertia

_EMPTY = SpatialInertia(0.0, np.zeros(3), np.zeros((3, 3)))
_KIND = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


def rigid_tree(urdf: str, inertias: Mapping[str, SpatialInertia], **options: Any) -> RigidTree:
    """Return the tree of a sanitised URDF with ``inertias`` of its links, by name, in the frames of the links.

    Links are in breadth-first order, as in SAPIEN. ``options`` are passed to :class:`RigidTree`.
    """
    root = etree.fromstring(urdf.encode())
    joints = edges_of(root)
    (base,) = {link.get("name", "") for link in root.findall("link")} - {joint.child for joint in joints}
    links = [base, *(joint.child for joint in joints)]
    of_links = [inertias.get(link, _EMPTY) for link in links]
    elements = [joint.element for joint in joints]
    kinds = [_KIND.get(element.get("type"), "fixed") for element in elements]
    return RigidTree(
        links=tuple(links),
        parent=np.array([-1, *(links.index(joint.parent) for joint in joints)]),
        joint_types=("fixed", *kinds),
        joint_names=tuple(joint.name for joint, kind in zip(joints, kinds, strict=True) if kind != "fixed"),
        position=np.array([_numbers(each, "origin", "xyz", "0 0 0") for each in (root, *elements)]),
        wxyz=np.array([from_rpy(_numbers(each, "origin", "rpy", "0 0 0")) for each in (root, *elements)]),
        axis=np.array([_numbers(each, "axis", "xyz", "1 0 0") for each in (root, *elements)]),
        mass=np.array([inertia.mass for inertia in of_links]),
        center=np.array([inertia.center for inertia in of_links]),
        inertia=np.array([inertia.tensor for inertia in of_links]),
        **options,
    )


def _numbers(element: etree._Element, tag: str, name: str, default: str) -> tuple[float, ...]:
    return numbers(element.find(tag), name, default, f"joint {element.get('name')!r}")
