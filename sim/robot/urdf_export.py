"""The repaired robot as a URDF for other programs."""

from __future__ import annotations

import math

import numpy as np
from lxml import etree
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document, Float64
from batchpid.errors import RobotError
from batchpid.export.differences import Exported
from batchpid.sim.description.tables import Body, Visual
from batchpid.sim.findings import summary
from batchpid.sim.geometry.shapes import MOMENTS, Shape
from batchpid.sim.robot.robot import Robot
from batchpid.task_space.frames import to_rpy


def to_urdf(robot: Robot) -> Exported:
    """Return the URDF of ``robot`` with its repairs, which need none again, and a list of them.

    It holds links with inertias, shapes and visuals, and joints with limits, friction, damping and
    mimics. Links that fixed joints connect stay apart. Paths of meshes are absolute. Raises
    RobotError for meshes of an MJCF file.
    """
    root = etree.Element("robot", name=robot.name)
    for body in robot.tables.bodies:
        link = etree.SubElement(root, "link", name=body.name)
        if body.mass:
            inertial = _placed(link, "inertial", body.center, body.inertia_wxyz)
            _add(inertial, "mass", value=body.mass)
            entries = body.inertia[np.triu_indices(3)]
            _add(inertial, "inertia", **dict(zip(MOMENTS, entries, strict=True)))
        solid = [Visual(shape) for shape in robot.tables.shapes_of(body.name)]
        drawn = robot.tables.visuals.get(body.name, ())
        for tag, visuals in (("collision", solid), ("visual", drawn)):
            for shape, rgba, _problem in visuals:
                if shape is not None:
                    _write_shape(link, tag, shape, rgba)
    for body in robot.tables.bodies[1:]:
        _write_joint(root, body)
    differences = [sentence.partition(": ")[2] for sentence in summary(robot.repairs)]
    if robot.actuators is not None:
        differences.append("motors and sensors (actuators) are not in a URDF")
    if root.find("joint/safety_controller") is not None:
        differences.append("k_velocity of each <safety_controller> is 1")
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
    if math.isfinite(joint.soft_upper - joint.soft_lower):
        soft = {"soft_lower_limit": joint.soft_lower, "soft_upper_limit": joint.soft_upper}
        _add(element, "safety_controller", k_velocity=1, **soft)
    if (mimic := joint.mimic) is not None:
        factors = {"multiplier": mimic.multiplier, "offset": mimic.offset}
        _add(element, "mimic", joint=mimic.joint, **factors)


def _write_shape(
    link: etree._Element,
    tag: str,
    shape: Shape,
    rgba: tuple[float, ...] | None,
) -> None:
    """Add a ``<collision>`` or ``<visual>`` to a link. Raises RobotError for a mesh without file."""
    if shape.vertices is not None:
        problem = "a URDF has no place for the meshes of an MJCF file"
        raise RobotError(f"{shape.owner}: {problem}; use to_mjcf, or batchpid export --to mjcf")
    element = _placed(link, tag, shape.position, shape.wxyz)
    _add(etree.SubElement(element, "geometry"), shape.kind, **_sizes(shape))
    if rgba is not None:
        # Materials of one name are one.
        material = etree.SubElement(element, "material", name=str(rgba))
        _add(material, "color", rgba=rgba)


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
