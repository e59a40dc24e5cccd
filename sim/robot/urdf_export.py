"""The repaired robot as a URDF for other programs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from copy import deepcopy
from pathlib import Path

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Float64
from batchpid.errors import RobotError
from batchpid.export.differences import Exported
from batchpid.sim.description.reading import is_mjcf, read_robot
from batchpid.sim.description.tables import Body
from batchpid.sim.description.urdf import UNUSED
from batchpid.sim.description.xml import parse_xml
from batchpid.sim.findings import summary
from batchpid.sim.geometry.mesh_files import find_mesh
from batchpid.sim.geometry.shapes import MOMENTS, Shape, mesh_file
from batchpid.sim.robot.robot import Robot
from batchpid.task_space.frames import to_rpy

COPIED = {*UNUSED, "safety_controller"}
"""Elements that are copied from a URDF."""


def to_urdf(robot: Robot, folder: Path | None = None) -> Exported:
    """Return the URDF of ``robot`` with its repairs, which need none again, and a list of them.

    Links, joints, shapes and mimics are written from the tables; visuals, soft limits and elements
    without effect here are copied from the file. Links that fixed joints connect stay apart.

    Parameters
    ----------
    robot
        Its file is read again.
    folder
        Of the new file: paths of meshes are relative to it. Default: absolute paths.

    Raises
    ------
    RobotError
        The file cannot be read, or has changed since the robot was loaded.
    """
    path, packages = robot.path, robot.source.package_dirs
    if read_robot(path, robot.fixed_base, packages, "skip").tables != robot.tables:
        raise RobotError(f"{path}: has changed since the robot was loaded; load it again")
    root = _write(robot)
    differences = [sentence.partition(": ")[2] for sentence in summary(robot.repairs)]
    if not is_mjcf(source := parse_xml(path)):
        _copy_unused(source, root, path, packages)
    if robot.actuators is not None:
        differences.append("motors and sensors (actuators) are not in a URDF")
    if folder is not None:
        for mesh in root.iter("mesh"):
            if os.path.isabs(name := mesh.get("filename", "")):
                mesh.set("filename", os.path.relpath(name, folder))
    etree.indent(root)
    etree.cleanup_namespaces(root)
    text = etree.tostring(root, encoding="unicode")
    return Exported(f'<?xml version="1.0"?>\n{text}\n', tuple(differences))


def _write(robot: Robot) -> etree._Element:
    """Return the ``<robot>`` of the tables."""
    root = etree.Element("robot", name=robot.name)
    for body in robot.tables.bodies:
        link = etree.SubElement(root, "link", name=body.name)
        if body.mass:
            inertial = _placed(link, "inertial", body.center, body.inertia_wxyz)
            etree.SubElement(inertial, "mass", value=_text([body.mass]))
            entries = map(repr, body.inertia[np.triu_indices(3)].tolist())
            etree.SubElement(inertial, "inertia", dict(zip(MOMENTS, entries, strict=True)))
        for shape in robot.tables.shapes_of(body.name):
            collision = _placed(link, "collision", shape.position, shape.wxyz)
            geometry = etree.SubElement(collision, "geometry")
            etree.SubElement(geometry, shape.kind, _shape_attributes(shape))
    for body in robot.tables.bodies[1:]:
        _write_joint(root, body)
    return root


def _write_joint(root: etree._Element, body: Body) -> None:
    joint = body.joint
    assert joint is not None  # of a body that is not the base
    element = _placed(root, "joint", body.position, body.wxyz)
    element.attrib.update({"name": joint.name, "type": joint.type})
    etree.SubElement(element, "parent", link=joint.parent_link)
    etree.SubElement(element, "child", link=joint.child_link)
    if not joint.moves:
        return
    etree.SubElement(element, "axis", xyz=_text(joint.axis))
    limits = {"effort": joint.effort_limit, "velocity": joint.velocity_limit}
    limits = {key: limit for key, limit in limits.items() if math.isfinite(limit)}
    if not joint.continuous:
        limits |= {"lower": joint.lower, "upper": joint.upper}
    etree.SubElement(element, "limit", {key: repr(limit) for key, limit in limits.items()})
    damping = repr(joint.damping)
    friction = repr(joint.friction)
    etree.SubElement(element, "dynamics", damping=damping, friction=friction)
    if (mimic := joint.mimic) is not None:
        factors = {"multiplier": repr(mimic.multiplier), "offset": repr(mimic.offset)}
        etree.SubElement(element, "mimic", factors, joint=mimic.joint)


def _shape_attributes(shape: Shape) -> dict[str, str]:
    if shape.kind == "mesh":
        return {"filename": mesh_file(shape), "scale": _text(shape.scale)}
    if shape.kind == "box":
        return {"size": _text([2 * side for side in shape.size])}
    radius, *half_length = shape.size
    attributes = {"radius": repr(radius)}
    if half_length:
        attributes["length"] = repr(2 * half_length[0])
    return attributes


def _placed(
    parent: etree._Element,
    tag: str,
    position: Float64,
    wxyz: Float64,
) -> etree._Element:
    """Return a new element below ``parent`` with an ``<origin>``."""
    element = etree.SubElement(parent, tag)
    etree.SubElement(element, "origin", xyz=_text(position), rpy=_text(to_rpy(wxyz)))
    return element


def _text(values: Iterable[float]) -> str:
    """Return numbers as text that reads back to the same numbers."""
    return " ".join(repr(float(value)) for value in values)


def _copy_unused(
    source: etree._Element,
    root: etree._Element,
    path: Path,
    packages: tuple[Path, ...],
) -> None:
    """Copy the elements without effect here into ``root``."""
    owners = {
        (tag, element.get("name")): element
        for tag in ("link", "joint")
        for element in root.findall(tag)
    }
    copied = set()
    for parent in (source, *source.findall("link"), *source.findall("joint")):
        owner = (parent.tag, (parent.get("name") or "").strip())
        target = root if parent is source else owners.get(owner)
        if target is None or owner in copied:
            continue  # left out, or the second of its name
        copied.add(owner)
        target.extend(deepcopy([child for child in parent if child.tag in COPIED]))
    # Paths were relative to the source, which the new file may not be near.
    for mesh in root.iterfind("link/visual/geometry/mesh"):
        if (file := find_mesh(mesh.get("filename", ""), path, packages)) is not None:
            mesh.set("filename", str(file))
