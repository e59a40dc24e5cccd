"""The repaired robot as a URDF for other programs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError
from batchpid.export.differences import Exported
from batchpid.sim.robot.description import RobotDescription
from batchpid.sim.robot.findings import summary
from batchpid.sim.robot.meshes import find_mesh
from batchpid.sim.robot.repair import UNUSED
from batchpid.sim.robot.urdf import read_source, read_urdf, repair_urdf
from batchpid.task_space.rigid_tree import RigidTree


def to_urdf(
    robot: RobotDescription,
    folder: Path | None = None,
    mass_factors: Mapping[str, float] | None = None,
) -> Exported:
    """Return the URDF of ``robot`` with its repairs, which need none again, and a list of them.

    Links, joints, numbers and mimics are copied from the file unless repaired; visuals and other
    elements without effect here are copied. Links that fixed joints connect stay apart.

    Parameters
    ----------
    robot
        Its file is read again.
    folder
        Of the new file: paths of meshes are relative to it. Default: absolute paths.
    mass_factors
        Factors of the masses and inertia tensors of rigid bodies, each by the name of one of its
        links. The links that fixed joints connect keep their shares.

    Raises
    ------
    RobotError
        The file cannot be read, or has changed since the robot was loaded.
    """
    path, packages = robot.path, robot.package_dirs
    source, findings, _ = read_source(path, robot.fixed_base, "skip")
    root = deepcopy(source)
    if read_urdf(deepcopy(source), path, findings, packages, "skip", False).urdf != robot.urdf:
        raise RobotError(f"{path}: has changed since the robot was loaded; load it again")
    repair_urdf(root, path, findings, packages, "skip")
    root.set("name", robot.name)
    found = [sentence.partition(": ")[2] for sentence in summary(robot.repairs)]
    found += _copy_unused(source, root, path, packages)
    found += _lacking(robot)
    for link, factor in (mass_factors or {}).items():
        _scale_masses(root, robot.rigid_tree, link, factor)
    if folder is not None:
        for mesh in root.iter("mesh"):
            if os.path.isabs(name := mesh.get("filename", "")):
                mesh.set("filename", os.path.relpath(name, folder))
    etree.indent(root)
    etree.cleanup_namespaces(root)
    text = etree.tostring(root, encoding="unicode")
    return Exported(f'<?xml version="1.0"?>\n{text}\n', tuple(found))


def _scale_masses(root: etree._Element, tree: RigidTree, link: str, factor: float) -> None:
    """Multiply mass and inertia tensor of each link of a body by ``factor``; those by shapes become
    numbers.
    """
    body = tree.link_bodies[tree.index(link)]
    for index, name in enumerate(tree.links):
        if tree.link_bodies[index] != body or not tree.mass[index]:
            continue
        owner = next(element for element in root.findall("link") if element.get("name") == name)
        if (old := owner.find("inertial")) is not None:
            owner.remove(old)
        inertial = etree.SubElement(owner, "inertial")
        etree.SubElement(inertial, "origin", xyz=" ".join(map(repr, tree.center[index].tolist())))
        etree.SubElement(inertial, "mass", value=repr(factor * float(tree.mass[index])))
        places = {
            "ixx": (0, 0),
            "ixy": (0, 1),
            "ixz": (0, 2),
            "iyy": (1, 1),
            "iyz": (1, 2),
            "izz": (2, 2),
        }
        tensor = {
            key: repr(factor * float(tree.inertia[index][place])) for key, place in places.items()
        }
        etree.SubElement(inertial, "inertia", **tensor)


def _copy_unused(
    source: etree._Element, root: etree._Element, path: Path, packages: tuple[Path, ...]
) -> list[str]:
    """Copy the elements without effect here into ``root``; return the visual meshes that are not
    found.
    """
    owners = {
        (tag, each.get("name")): each for tag in ("link", "joint") for each in root.findall(tag)
    }
    copied = set()
    missing = []
    for parent in (source, *source.findall("link"), *source.findall("joint")):
        owner = (parent.tag, (parent.get("name") or "").strip())
        target = root if parent is source else owners.get(owner)
        if target is None or owner in copied:
            continue  # left out, or the second of its name
        copied.add(owner)
        target.extend(deepcopy([each for each in parent if each.tag in UNUSED]))
    for mesh in root.iterfind("link/visual/geometry/mesh"):
        if (found := find_mesh(mesh.get("filename", ""), path, packages)) is None:
            missing.append(mesh.get("filename", ""))
        else:
            mesh.set("filename", str(found))
    return (
        [f"visual meshes not found, written as they were: {', '.join(sorted({*missing}))}"]
        if missing
        else []
    )


def _lacking(robot: RobotDescription) -> Iterator[str]:
    """Yield sentences about infinite limits, for which a URDF has no number, and about
    actuators.
    """
    for what, names in (
        ("effort limit", [joint.name for joint in robot.joints if math.isinf(joint.effort_limit)]),
        (
            "velocity limit",
            [joint.name for joint in robot.joints if math.isinf(joint.velocity_limit)],
        ),
    ):
        if names:
            yield f"no {what}, which other programs may require: {', '.join(names)}"
    endless = [
        joint
        for joint in robot.joints
        if not joint.continuous and math.isinf(joint.upper - joint.lower)
    ]
    if endless:
        names = [joint.name for joint in endless]
        yield (
            "no position limit, written as inf, which other programs may refuse:"
            f" {', '.join(names)}"
        )
    if robot.actuators is not None:
        yield "motors and sensors (actuators) are not in a URDF"
