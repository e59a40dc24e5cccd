"""URDF reader for headless simulation: parses safely, drops visuals, resolves meshes, lists the
joints.

An MJCF file is read as the URDF that is equivalent to it (:mod:`batchpid.sim.robot.mjcf`).

SAPIEN's own loader builds render components for every ``<visual>``, which fails on a machine
without a render device, and silently skips a collision mesh that it cannot read. The text made here
has no visuals, absolute mesh paths, and no mimic joint: the coupling is not SAPIEN's
(:mod:`batchpid.sim.engine.coupled_joints`).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lxml import etree

from batchpid.errors import MissingDependencyError
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.xml import parse_xml

if TYPE_CHECKING:
    from batchpid.sim.robot.mjcf.mjcf_reader import Mjcf

from collections import Counter, defaultdict
from functools import cache

from batchpid.arrays.array_types import Document
from batchpid.errors import RobotError
from batchpid.sim.robot.findings import report
from batchpid.sim.robot.joint_repair import ends_of
from batchpid.sim.robot.link_repair import MOMENTS, from_entries, triangle_excess
from batchpid.sim.robot.meshes import check_unchanged, find_mesh, mesh_problem
from batchpid.sim.robot.parts import Joint, Link, Mimic, Urdf
from batchpid.sim.robot.repair import repair
from batchpid.sim.robot.xml import number, numbers

MOST_READ = 4096  # links and joints of a file


def is_mjcf(root: etree._Element) -> bool:
    """Return whether a root element is an MJCF file's; MuJoCo ignores a default namespace."""
    return root.prefix is None and etree.QName(root).localname == "mujoco"


def read_source(
    path: Path, fixed_base: bool, missing_meshes: str
) -> tuple[etree._Element, list[Finding], Mjcf | None]:
    """Return the root of the URDF at ``path``, or of one that is equivalent to the MJCF there, and
    the findings.

    The last value is the rest of an MJCF file, None for a URDF.

    Raises
    ------
    RobotError
        The file cannot be read, or MuJoCo does not compile it.
    MissingDependencyError
        The file is MJCF, and the package ``mujoco`` is missing.
    """
    findings: list[Finding] = []
    root = parse_xml(path, findings)
    if not is_mjcf(root):
        return root, findings, None
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
        mjcf = read_mjcf(path, root.get("model") or path.stem, fixed_base, missing_meshes)
    except UnicodeDecodeError as error:
        raise RobotError(
            f"{path}: a name is not UTF-8, which MuJoCo requires: {error}; save it as UTF-8"
        ) from error
    return mjcf.root, [*findings, *mjcf.findings], mjcf


def read_urdf(
    root: etree._Element,
    path: Path,
    repairs: list[Finding],
    package_dirs: tuple[Path, ...],
    missing_meshes: str,
    strict: bool,
) -> Urdf:
    """Sanitise a URDF.

    Parameters
    ----------
    root, path, repairs
        Its root element, the file that it is from, and the findings of reading that.
    package_dirs, missing_meshes, strict
        See :meth:`batchpid.sim.Robot.load`.

    Raises
    ------
    RobotError
        A structure or number that SAPIEN cannot build, or a bad mesh.
    """
    repairs = list(repairs)
    repair_urdf(root, path, repairs, package_dirs, missing_meshes)
    joints = [_read_joint(element, path) for element in root.findall("joint")]
    links = [_read_link(element, path) for element in root.findall("link")]
    added = [str(finding.link) for finding in repairs if finding.code == "missing-link"]
    ordered = _breadth_first(links, joints, path, added)
    for element, joint in zip(root.findall("joint"), joints, strict=True):
        if joint.mimic is not None:
            element.remove(element.find("mimic"))  # batchpid.sim.engine.coupled_joints simulates it
    report(path, repairs, strict)
    text = etree.tostring(root, encoding="unicode")
    return Urdf(root.get("name", path.stem), text, tuple(ordered), tuple(links), tuple(repairs))


def repair_urdf(
    root: etree._Element,
    path: Path,
    repairs: list[Finding],
    package_dirs: tuple[Path, ...],
    missing_meshes: str,
) -> None:
    """Repair the ``<robot>`` of the file at ``path``, and append the repairs. See above."""
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
    """Return a repaired joint, and write out or remove what SAPIEN fails on."""
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"{path}: joint {name!r}"
    parent, child = ends_of(element)
    if not parent or not child:
        raise RobotError(f"{where}: needs <parent link=...> and <child link=...>; add them")
    axis, limit, dynamics, mimic = map(element.find, ("axis", "limit", "dynamics", "mimic"))
    fields: Document = _origin(element, where)
    if axis is not None:
        fields["axis"] = numbers(axis, "xyz", "1 0 0", where)
    if limit is not None:
        fields |= {
            f"{key}_limit": number(limit, key, "inf", where, limit=True)
            for key in ("effort", "velocity")
        }
        if kind == "continuous":
            element.remove(limit)
        else:
            fields |= {
                key: number(limit, key, "0", where, limit=True) for key in ("lower", "upper")
            }
    for safety in element.findall("safety_controller"):
        element.remove(safety)
        soft = [number(safety, f"soft_{key}_limit", "0", where) for key in ("lower", "upper")]
        if soft[0] < soft[1]:  # both are 0 where they are left out
            fields |= {"soft_lower": soft[0], "soft_upper": soft[1]}
    for key in ("damping", "friction") if dynamics is not None else ():
        fields[key] = number(dynamics, key, "0", where)
        dynamics.set(key, repr(fields[key]))
    if mimic is not None:
        multiplier, offset = (
            number(mimic, "multiplier", "1", where),
            number(mimic, "offset", "0", where),
        )
        fields["mimic"] = Mimic(mimic.get("joint", ""), multiplier, offset)
    return Joint(name, kind, parent, child, **fields)


def _read_link(element: etree._Element, path: Path) -> Link:
    """Return a repaired link."""
    name, inertial = element.get("name", ""), element.find("inertial")
    where, shapes = f"{path}: link {name!r}", element.findall("collision")
    for part in [each for each in (inertial, *shapes) if each is not None]:
        _origin(part, where)
    if inertial is None:
        return Link(name, None, len(shapes), False)
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    excess = triangle_excess(from_entries([number(inertia, key, "0", where) for key in MOMENTS]))
    return Link(name, number(mass, "value", "0", where), len(shapes), True, excess)


def _origin(element: etree._Element, where: str) -> dict[str, tuple[float, ...]]:
    """Return the position [m] and the roll, pitch and yaw [rad] of an element's ``<origin>``."""
    origin = element.find("origin")
    return {
        "origin": numbers(origin, "xyz", "0 0 0", where),
        "rpy": numbers(origin, "rpy", "0 0 0", where),
    }


def _breadth_first(
    links: list[Link], joints: list[Joint], path: Path, added: list[str]
) -> list[Joint]:
    """Return the joints level by level from the root, siblings in file order, if they form one
    tree.

    ``added`` are links that joints name and the file does not hold.
    """
    known, children = [link.name for link in links], [joint.child_link for joint in joints]
    moved, below = set(children), defaultdict(list)
    for joint in joints:
        below[joint.parent_link].append(joint)
    if twice := sorted(name for name, count in Counter(children).items() if count > 1):
        raise RobotError(
            f"{path}: link with two parents: {', '.join(twice)}; a robot must be a tree"
        )
    roots = [name for name in known if name not in moved]
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
