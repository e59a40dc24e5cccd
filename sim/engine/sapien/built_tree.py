"""Rigid tree of a robot as SAPIEN builds it, with PhysX's places, masses and inertias in single precision."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Document, Float64
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.task_space.frames import matrix_of
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.rotations import from_rpy


@lru_cache(maxsize=8)
def scene_tree(spec: SceneSpec) -> RigidTree:
    """Return the tree of the robot of ``spec``, all joints independent, the same object for equal specs.

    Before each link but the base comes a link without mass, "LINK (joint)", in the frame of the joint above.
    """
    _scene, robot = build_scene(spec, new_system(spec))
    rows: list[Document] = []
    at: dict[Any, int] = {}
    for link in robot.links:
        kind, turn = "fixed", np.diag([float(str(one)) for one in link.inertia])
        axes, center = _place(link.cmass_local_pose)
        inertia = {"mass": link.mass, "center": center, "inertia": axes @ turn @ axes.T}
        if link.parent is None:
            rows.append(_row(link.name, -1, "fixed", None) | inertia)
        else:
            kind = {"fixed": "fixed", "prismatic": "prismatic"}.get(link.joint.type, "revolute")
            rows.append(_row(f"{link.name} (joint)", at[link.parent], kind, link.joint.pose_in_parent))
            rows.append(_row(link.name, len(rows) - 1, "fixed", link.joint.pose_in_child.inv()) | inertia)
        at[link] = len(rows) - 1
    columns: Document = {
        name: np.array([row[name] for row in rows]) for name in rows[0] if name not in ("links", "joint_types")
    }
    names = tuple(joint.name for joint in spec.joints)
    links, kinds = (tuple(row[name] for row in rows) for name in ("links", "joint_types"))
    return RigidTree(
        links, joint_types=kinds, joint_names=names, **columns, gravity=spec.gravity, fixed_base=spec.fixed_base
    )


def _row(name: str, parent: int, kind: str, pose: Any) -> Document:
    """Return a link without mass at one of SAPIEN's poses in its parent."""
    position, wxyz = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])) if pose is None else (pose.p, _wxyz(pose))
    empty = {"mass": 0.0, "center": np.zeros(3), "inertia": np.zeros((3, 3))}
    place = {"position": np.asarray(position, float), "wxyz": wxyz, "axis": np.array([1.0, 0.0, 0.0])}
    return {"links": name, "parent": parent, "joint_types": kind, **place, **empty}


def _place(pose: Any) -> tuple[Float64, Float64]:
    """Return axes (3, 3) and position (3,) of one of SAPIEN's poses."""
    return matrix_of(_wxyz(pose)), np.asarray(pose.p, float)


def _wxyz(pose: Any) -> Float64:
    """Return the rotation of one of SAPIEN's poses, by roll, pitch and yaw, as SAPIEN's own dynamics take it."""
    return from_rpy(np.asarray(pose.rpy, float))
