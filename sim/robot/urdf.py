"""URDF reader: repairs the elements, resolves meshes, and reads the tables of the robot."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Document, Float64
from batchpid.errors import RobotError
from batchpid.motors import Actuators
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.joint_repair import ends_of, free_base, free_joint_of
from batchpid.sim.robot.link_repair import MOMENTS, from_entries
from batchpid.sim.robot.meshes import check_unchanged, find_mesh, mesh_problem
from batchpid.sim.robot.parts import FileDefaults, Joint, Mimic, MjcfFile
from batchpid.sim.robot.repair import repair
from batchpid.sim.robot.self_collision import DisabledPair
from batchpid.sim.robot.tables import NO_TURN, Body, Shape, Tables, breadth_first
from batchpid.sim.robot.xml import number, numbers
from batchpid.task_space.frames import from_rpy

MOST_READ = 4096  # links and joints of a file


class Source(NamedTuple):
    """Robot as its file gives it.

    ``repairs`` are findings, one for each change that the simulation needs. ``base_start`` is the
    pose (7,) at which the file places a floating base.
    """

    name: str
    tables: Tables
    repairs: tuple[Finding, ...]
    fixed_base: bool
    base_start: tuple[float, ...] | None
    mjcf: MjcfFile | None = None
    pairs: tuple[DisabledPair, ...] = ()
    """Pairs of links that do not collide."""
    defaults: FileDefaults | None = None
    actuators: Actuators | None = None


def read_urdf(
    root: etree._Element,
    path: Path,
    findings: list[Finding],
    fixed_base: bool | None,
    package_dirs: tuple[Path, ...],
    missing_meshes: str,
) -> Source:
    """Return the robot of the root element of a URDF, with ``findings`` of reading the file.

    The element is repaired in place. Raises RobotError for a structure or number that SAPIEN cannot
    build, or a bad mesh.
    """
    free_joint = free_joint_of(root)
    base = None
    if fixed_base is None:
        fixed_base = free_joint is None
    if free_joint is not None and not fixed_base:
        base = free_base(root, free_joint)
    _repair(root, path, findings, package_dirs, missing_meshes)
    added = [str(finding.link) for finding in findings if finding.code == "missing-link"]
    tables = _read_tables(root, path, added)
    name = root.get("name", path.stem)
    return Source(name, tables, tuple(findings), fixed_base, base)


def _repair(
    root: etree._Element,
    path: Path,
    repairs: list[Finding],
    package_dirs: tuple[Path, ...],
    missing_meshes: str,
) -> None:
    """Repair the ``<robot>`` of the file at ``path``, and append the repairs."""
    if root.tag != "robot":
        problem = f"the root element is <{root.tag}>, not <robot> (URDF) or <mujoco> (MJCF)"
        raise RobotError(
            f"{path}: {problem}; is this a robot's file (not SDF, xacro, a part of an MJCF)?"
        )
    # Before the repairs and the check of the tree, whose time is the square of the number.
    if max(len(root.findall(tag)) for tag in ("link", "joint")) > MOST_READ:
        raise RobotError(
            f"{path}: has more than {MOST_READ} links or joints; remove what the robot does not"
            " need"
        )
    repairs += repair(root, path)
    missing = _resolve_meshes(root, path, package_dirs)
    if missing and missing_meshes == "error":
        raise RobotError(
            f"{path}: collision mesh not found or not readable: {', '.join(missing)}; repair the"
            " file, pass package_dirs=[...] with the folder that holds the package (or name it in"
            " ROS_PACKAGE_PATH), or missing_meshes='skip' to simulate without"
        )
    if missing:
        text = (
            f"collision meshes not found or not readable, simulated without: {', '.join(missing)}"
        )
        remedy = (
            "repair the files, or pass package_dirs=[...] to Robot.load, or name their folder in"
            " ROS_PACKAGE_PATH"
        )
        repairs.append(Finding("warning", "missing-mesh", text, remedy))


def _resolve_meshes(root: etree._Element, path: Path, package_dirs: tuple[Path, ...]) -> list[str]:
    """Make mesh paths absolute; drop the shapes whose file is missing or unreadable; return their
    names and why.
    """
    missing = []
    for collision in root.findall("link/collision"):
        mesh = collision.find("geometry/mesh")
        if mesh is None:
            continue
        name = mesh.get("filename", "")
        file = find_mesh(name, path, package_dirs)
        problem = None if file is None else mesh_problem(file)
        if file is None or problem is not None:
            missing.append(name if problem is None else f"{name} ({problem})")
            collision.getparent().remove(collision)
        else:
            # SAPIEN would simulate the file that it read before.
            check_unchanged(file)
            mesh.set("filename", str(file))
    return missing


def _read_joint(element: etree._Element, path: Path) -> Joint:
    """Return a repaired joint."""
    name = element.get("name", "")
    kind = element.get("type", "")
    where = f"{path}: joint {name!r}"
    parent, child = ends_of(element)
    if not parent or not child:
        raise RobotError(f"{where}: needs <parent link=...> and <child link=...>; add them")
    axis, limit, dynamics, mimic, safety = map(
        element.find, ("axis", "limit", "dynamics", "mimic", "safety_controller")
    )
    fields: Document = {}
    if axis is not None:
        fields["axis"] = numbers(axis, "xyz", "1 0 0", where)
    if limit is not None:
        for key in ("effort", "velocity"):
            fields[f"{key}_limit"] = number(limit, key, "inf", where, limit=True)
        for key in ("lower", "upper") if kind != "continuous" else ():
            fields[key] = number(limit, key, "0", where, limit=True)
    if safety is not None:
        low, high = (number(safety, f"soft_{key}_limit", "0", where) for key in ("lower", "upper"))
        if low < high:  # both are 0 where they are left out
            fields |= {"soft_lower": low, "soft_upper": high}
    for key in ("damping", "friction") if dynamics is not None else ():
        fields[key] = number(dynamics, key, "0", where)
    if mimic is not None:
        multiplier = number(mimic, "multiplier", "1", where)
        offset = number(mimic, "offset", "0", where)
        fields["mimic"] = Mimic(mimic.get("joint", ""), multiplier, offset)
    return Joint(name, kind, parent, child, **fields)


def _read_tables(root: etree._Element, path: Path, added: list[str]) -> Tables:
    """Return the tables of a repaired URDF. ``added`` are links that the file does not hold."""
    links = root.findall("link")
    joints = [_read_joint(element, path) for element in root.findall("joint")]
    _check_tree([link.get("name", "") for link in links], joints, path, added)
    above = {
        joint.child_link: (joint, *read_origin(element, f"{path}: joint {joint.name!r}"))
        for joint, element in zip(joints, root.findall("joint"), strict=True)
    }
    # Siblings are in the order of their joints.
    order = {joint.child_link: number for number, joint in enumerate(joints)}
    links.sort(key=lambda link: order.get(link.get("name", ""), -1))
    bodies: list[Body] = []
    shapes: list[Shape] = []
    for link in links:
        name = link.get("name", "")
        where = f"{path}: link {name!r}"
        body = Body(name, *above.get(name, (None,)))
        if (inertial := link.find("inertial")) is not None:
            center, turn = read_origin(inertial, where)
            tensor = inertial.find("inertia")
            entries = [number(tensor, key, "0", where) for key in MOMENTS]
            body = body._replace(
                mass=number(inertial.find("mass"), "value", "0", where),
                center=center,
                inertia=from_entries(entries),
                inertia_wxyz=turn,
            )
        bodies.append(body)
        for collision in link.findall("collision"):
            place = read_origin(collision, where)
            shapes += [
                read_shape(geometry, name, place, where)
                for geometry in collision.iterfind("geometry/*")
            ]
    # Links of a loop are below no root, and so left behind.
    tables = breadth_first(bodies, shapes)
    if len(tables.bodies) != len(bodies):
        root_link = tables.bodies[0].name
        raise RobotError(
            f"{path}: some joints form a loop apart from the root {root_link!r}; a robot must be"
            " one tree"
        )
    return tables


def read_shape(
    geometry: etree._Element, link: str, place: tuple[Float64, Float64], where: str
) -> Shape:
    """Return the shape of a ``<geometry>`` of ``link``, at a position and orientation."""
    kind = geometry.tag
    size: tuple[float, ...] = ()
    if kind == "mesh":
        scale = numbers(geometry, "scale", "1 1 1", where)
        return Shape(link, link, kind, size, *place, geometry.get("filename", ""), scale)
    if kind == "box":
        size = tuple(0.5 * side for side in numbers(geometry, "size", "0 0 0", where))
    else:
        size = (number(geometry, "radius", "0", where),)
    if kind in ("capsule", "cylinder"):
        size += (0.5 * number(geometry, "length", "0", where),)
    return Shape(link, link, kind, size, *place)


def read_origin(element: etree._Element, where: str) -> tuple[Float64, Float64]:
    """Return position (3,) [m] and orientation (4,) of an element's ``<origin>``."""
    origin = element.find("origin")
    position = np.array(numbers(origin, "xyz", "0 0 0", where))
    rpy = numbers(origin, "rpy", "0 0 0", where)
    return position, from_rpy(rpy) if any(rpy) else NO_TURN  # mostly


def _check_tree(links: list[str], joints: list[Joint], path: Path, added: list[str]) -> None:
    """Raise RobotError for a link with two parents, and unless there is exactly one root."""
    children = [joint.child_link for joint in joints]
    if twice := sorted(name for name, count in Counter(children).items() if count > 1):
        raise RobotError(
            f"{path}: link with two parents: {', '.join(twice)}; a robot must be a tree"
        )
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        remedy = "a robot must be one tree"
        if added:
            remedy = f"joints name {added}, not in the file: correct the names"
        raise RobotError(
            f"{path}: needs exactly one root link, found {roots or 'a loop'}; {remedy}"
        )
