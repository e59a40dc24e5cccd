"""The repaired robot as a URDF for other programs."""

from __future__ import annotations

import math

import numpy as np
from lxml import etree
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document, Float64
from batchpid.errors import RobotError
from batchpid.export.differences import Exported
from batchpid.sim.description.tables import Body
from batchpid.sim.findings import summary
from batchpid.sim.geometry.shapes import MOMENTS, Shape
from batchpid.sim.robot.robot import Robot
from batchpid.task_space.frames import to_rpy


def to_urdf(robot: Robot) -> Exported:
    """Return the URDF of ``robot`` with its repairs, which need none again, and a list of them.

    It holds what is simulated: links with inertias and shapes, and joints with limits, friction,
    damping and mimics. Links that fixed joints connect stay apart. Paths of meshes are absolute.
    Raises RobotError for meshes of an MJCF file.
    """
    root = etree.Element("robot", name=robot.name)
    for body in robot.tables.bodies:
        link = etree.SubElement(root, "link", name=body.name)
        if body.mass:
            inertial = _placed(link, "inertial", body.center, body.inertia_wxyz)
            _add(inertial, "mass", value=body.mass)
            entries = body.inertia[np.triu_indices(3)]
            _add(inertial, "inertia", **dict(zip(MOMENTS, entries, strict=True)))
        for shape in robot.tables.shapes_of(body.name):
            if shape.vertices is not None:
                problem = f"{robot.path}: a URDF has no place for the meshes of an MJCF file"
                raise RobotError(f"{problem}; use to_mjcf, or batchpid export --to mjcf")
            collision = _placed(link, "collision", shape.position, shape.wxyz)
            _add(etree.SubElement(collision, "geometry"), shape.kind, **_sizes(shape))
    for body in robot.tables.bodies[1:]:
        _write_joint(root, body)
    differences = [sentence.partition(": ")[2] for sentence in summary(robot.repairs)]
    if robot.actuators is not None:
        differences.append("motors and sensors (actuators) are not in a URDF")
    etree.indent(root)
    text = etree.tostring(root, encoding="unicode")
    return Exported(f'<?xml version="1.0"?>\n{text}\n', tuple(differences))


def _write_joint(root: etree._Element, body: Body) -> None:
    joint = body.joint
    assert joint is not None  # of a body that is not the base
    element = _placed(root, "joint", body.position, body.wxyz)
    element.attrib.update({"name": joint.name, "type": joint.type})
    _add(element, "parent", link=joint.parent_link)
    _add(element, "child", link=joint.child_link)
    if not joint.moves:
        return
    _add(element, "axis", xyz=joint.axis)
    limits = {"effort": joint.effort_limit, "velocity": joint.velocity_limit}
    limits = {key: limit for key, limit in limits.items() if math.isfinite(limit)}
    if not joint.continuous:
        limits |= {"lower": joint.lower, "upper": joint.upper}
    _add(element, "limit", **limits)
    _add(element, "dynamics", damping=joint.damping, friction=joint.friction)
    if joint.soft_lower < joint.soft_upper < math.inf:
        soft = {"soft_lower_limit": joint.soft_lower, "soft_upper_limit": joint.soft_upper}
        _add(element, "safety_controller", **soft)
    if (mimic := joint.mimic) is not None:
        factors = {"multiplier": mimic.multiplier, "offset": mimic.offset}
        _add(element, "mimic", joint=mimic.joint, **factors)


def _sizes(shape: Shape) -> Document:
    """Return the attributes of a shape's element."""
    if shape.kind == "mesh":
        return {"filename": shape.file, "scale": shape.scale}
    if shape.kind == "box":
        return {"size": 2 * np.array(shape.size)}
    if shape.kind == "sphere":
        return {"radius": shape.size}
    return {"radius": shape.size[0], "length": 2 * shape.size[1]}


def _placed(
    parent: etree._Element,
    tag: str,
    position: Float64,
    wxyz: Float64,
) -> etree._Element:
    """Return a new element below ``parent`` with an ``<origin>``."""
    element = etree.SubElement(parent, tag)
    _add(element, "origin", xyz=position, rpy=to_rpy(wxyz))
    return element


def _add(parent: etree._Element, tag: str, **attributes: str | ArrayLike) -> None:
    """Add an element; numbers become text that reads back to the same numbers."""
    element = etree.SubElement(parent, tag)
    for key, value in attributes.items():
        if not isinstance(value, str):
            value = " ".join(map(repr, np.ravel(value).astype(float).tolist()))
        element.set(key, value)
