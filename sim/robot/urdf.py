"""URDF reader: parses safely, repairs the text, resolves meshes, and reads the tables of the robot.

An MJCF file is read as the URDF that is equivalent to it (:mod:`batchpid.sim.robot.mjcf`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Document, Float64
from batchpid.arrays.read_only import read_only
from batchpid.errors import MissingDependencyError, RobotError
from batchpid.sim.robot.findings import Finding, finding_of
from batchpid.sim.robot.joint_repair import ends_of, free_base, free_joint_of
from batchpid.sim.robot.link_repair import MOMENTS, from_entries
from batchpid.sim.robot.meshes import check_unchanged, find_mesh, mesh_problem
from batchpid.sim.robot.parts import Joint, Mimic, Placement
from batchpid.sim.robot.repair import repair
from batchpid.sim.robot.tables import NO_TURN, ORIGIN, Body, Shape, Tables
from batchpid.sim.robot.xml import number, numbers, parse_xml
from batchpid.task_space.rotations import from_rpy

if TYPE_CHECKING:
    from batchpid.sim.robot.mjcf.mjcf_reader import Mjcf

MOST_READ = 4096  # links and joints of a file
TURN = 2 * np.pi + 0.01
"""Largest plausible angle of an origin [rad]."""


class Source(NamedTuple):
    """Robot as its file gives it.

    ``repairs`` are findings, one for each change that the simulation needs; ``oddities`` are
    findings about content that was read as it stands. ``base_start`` is the pose (7,) at which the
    file places a floating base.
    """

    name: str
    tables: Tables
    repairs: tuple[Finding, ...]
    oddities: tuple[Finding, ...]
    fixed_base: bool
    base_start: tuple[float, ...] | None
    mjcf: Mjcf | None


def is_mjcf(root: etree._Element) -> bool:
    """Return whether a root element is an MJCF file's; MuJoCo ignores a default namespace."""
    return root.prefix is None and etree.QName(root).localname == "mujoco"


def read_robot(
    path: Path, fixed_base: bool | None, package_dirs: tuple[Path, ...], missing_meshes: str
) -> Source:
    """Return the robot in the URDF or MJCF file at ``path``.

    For the arguments see :meth:`batchpid.sim.Robot.load`.

    Raises
    ------
    RobotError
        A file that cannot be read, a structure or number that SAPIEN cannot build, a bad mesh, or
        an MJCF file that MuJoCo does not compile.
    MissingDependencyError
        The file is MJCF, and the package ``mujoco`` is missing.
    """
    findings: list[Finding] = []
    root = parse_xml(path, findings)
    mjcf, base = None, None
    if is_mjcf(root):
        mjcf = _read_mjcf(path, root, fixed_base is not False, missing_meshes)
        root, base = mjcf.root, mjcf.base
        findings += mjcf.findings
    free_joint = free_joint_of(root)
    fixed_base = free_joint is None if fixed_base is None else fixed_base
    if free_joint is not None and not fixed_base:
        base = free_base(root, free_joint, findings)
    _repair(root, path, findings, package_dirs, missing_meshes)
    links = [link.get("name", "") for link in root.findall("link")]
    joints = [_read_joint(element, path) for element in root.findall("joint")]
    added = [str(finding.link) for finding in findings if finding.code == "missing-link"]
    ordered = _breadth_first(links, joints, path, added)
    tables = _read_tables(root, ordered, str(path))
    name, oddities = root.get("name", path.stem), tuple(_degrees(root))
    return Source(name, tables, tuple(findings), oddities, fixed_base, base, mjcf)


def _read_mjcf(path: Path, root: etree._Element, fixed_base: bool, missing_meshes: str) -> Mjcf:
    if not path.is_file():
        raise RobotError(
            f"{path}: an MJCF file is read several times, also by workers; save it as a file first"
        )
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError("mujoco>=3.17", "reading an MJCF file") from error
    from batchpid.sim.robot.mjcf.mjcf_reader import read_mjcf

    try:
        return read_mjcf(path, root.get("model") or path.stem, fixed_base, missing_meshes)
    except UnicodeDecodeError as error:
        raise RobotError(
            f"{path}: a name is not UTF-8, which MuJoCo requires: {error}; save it as UTF-8"
        ) from error


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
    missing, check = [], cache(mesh_problem)
    for collision in root.findall("link/collision"):
        mesh = collision.find("geometry/mesh")
        if mesh is None:
            continue
        name = mesh.get("filename", "")
        found = find_mesh(name, path, package_dirs)
        problem = None if found is None else check(found)
        if found is None or problem is not None:
            missing.append(name if problem is None else f"{name} ({problem})")
            collision.getparent().remove(collision)
        else:
            check_unchanged(found)
            mesh.set("filename", str(found))
    return missing


def _read_joint(element: etree._Element, path: Path) -> Joint:
    """Return a repaired joint."""
    name, kind = element.get("name", ""), element.get("type", "")
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


def _read_tables(root: etree._Element, joints: Sequence[Joint], where: str) -> Tables:
    """Return the tables of a repaired URDF with these joints, breadth first."""
    elements = {
        (tag, element.get("name")): element
        for tag in ("link", "joint")
        for element in root.findall(tag)
    }
    children = {joint.child_link for joint in joints}
    base = next(name for tag, name in elements if tag == "link" and name not in children)
    bodies: list[Body] = []
    shapes: list[Shape] = []
    for joint in (None, *joints):
        name = base if joint is None else joint.child_link
        link = elements["link", name]
        body = Body(name, joint)
        if joint is not None:
            position, wxyz = read_origin(elements["joint", joint.name], where)
            body = body._replace(position=position, wxyz=wxyz)
        if (inertial := link.find("inertial")) is not None:
            center, turn = read_origin(inertial, where)
            tensor = inertial.find("inertia")
            entries = [number(tensor, key, "0", where) for key in MOMENTS]
            body = body._replace(
                mass=number(inertial.find("mass"), "value", "0", where),
                center=center,
                inertia=read_only(from_entries(entries)),
                inertia_wxyz=turn,
            )
        bodies.append(body)
        for collision in link.findall("collision"):
            place = read_origin(collision, where)
            shapes += [
                read_shape(geometry, name, place, where)
                for geometry in collision.iterfind("geometry/*")
            ]
    own = {body.name: Placement(body.name, ORIGIN, NO_TURN) for body in bodies}
    return Tables(tuple(bodies), tuple(shapes), own)


def _degrees(root: etree._Element) -> Iterator[Finding]:
    """Yield a finding for each origin with an angle of more than a turn, in degrees probably."""
    for origin in root.iter("origin"):
        if max(map(abs, numbers(origin, "rpy", "0 0 0", "origin"))) > TURN:
            text = "roll, pitch or yaw of more than a turn, as if degrees were read as radians"
            detail = f"<{origin.getparent().tag}> rpy {origin.get('rpy')}"
            remedy = "give <origin rpy=> in radians"
            yield finding_of(origin, "warning", "degrees", text, remedy, detail)


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
    wxyz = from_rpy(numbers(origin, "rpy", "0 0 0", where))
    return read_only(position), read_only(wxyz)


def _breadth_first(
    links: list[str], joints: list[Joint], path: Path, added: list[str]
) -> list[Joint]:
    """Return the joints level by level from the root, siblings in file order, if they form one
    tree.

    ``added`` are links that joints name and the file does not hold.
    """
    children = [joint.child_link for joint in joints]
    below = defaultdict(list)
    for joint in joints:
        below[joint.parent_link].append(joint)
    if twice := sorted(name for name, count in Counter(children).items() if count > 1):
        raise RobotError(
            f"{path}: link with two parents: {', '.join(twice)}; a robot must be a tree"
        )
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        remedy = (
            f"joints name {added}, not in the file: correct the names"
            if added
            else "a robot must be one tree"
        )
        raise RobotError(
            f"{path}: needs exactly one root link, found {roots or 'a loop'}; {remedy}"
        )
    ordered = below[roots[0]].copy()
    for joint in ordered:
        ordered += below[joint.child_link]
    if len(ordered) != len(joints):
        raise RobotError(
            f"{path}: some joints form a loop apart from the root {roots[0]!r}; a robot must be one"
            " tree"
        )
    return ordered
