"""URDF reader for headless simulation: parses safely, drops visuals, resolves meshes, lists the joints.

SAPIEN's own loader builds render components for every ``<visual>``, which fails on a machine without a render device,
and silently skips a collision mesh that it cannot read. The text made here has no visuals, absolute mesh paths, and no
mimic joint that SAPIEN would silently mis-simulate.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from batchpid.errors import RobotError
from sim.robot.description import MOVING_TYPES, Joint, Link, Mimic, Urdf
from sim.robot.findings import Finding, refuse
from sim.robot.meshes import find_mesh, mesh_problem
from sim.robot.xml import number, numbers, parse_xml

MAX_LINKS = 255  # PhysX counts the links of an articulation in a byte
MAX_PAIRS = 31  # SAPIEN has a bit for each pair of links that may not collide
SMALLEST = 1e-30  # mass [kg] and principal moment [kg m^2] with a reciprocal that single precision can hold
SMALLEST_SIZE, LARGEST_SIZE = 1e-6, 1e6  # of shapes [m] and scales of meshes, by PhysX's limits of the latter
_SHAPES = {  # that SAPIEN knows: their attributes, each with as many numbers as it has
    "box": {"size": "0 0 0"},
    "sphere": {"radius": "0"},
    "cylinder": {"radius": "0", "length": "0"},
    "capsule": {"radius": "0", "length": "0"},
    "mesh": {"scale": "1 1 1"},
}
_READ = {  # elements that are kept, by parent: what SAPIEN does not use it may still fail to parse
    "robot": {"link", "joint"},
    "link": {"inertial", "collision"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic"},
}


def read_urdf(path: Path, package_dirs: tuple[Path, ...], missing_meshes: str, strict: bool) -> Urdf:
    """Read and sanitise the URDF file at ``path``.

    Parameters
    ----------
    package_dirs, missing_meshes, strict
        See :meth:`sim.Robot.load`.

    Raises
    ------
    RobotError
        Unreadable file, malformed XML, an entity or DTD, a structure or number that SAPIEN cannot build, a bad mesh.
    """
    root = parse_xml(path)
    if root.tag != "robot":
        raise RobotError(f"{path}: the root element is <{root.tag}>, not <robot>; is this a URDF (not SDF, xacro)?")
    if (count := len(root.findall("link"))) > MAX_LINKS:
        remedy = "merge links that are joined by fixed joints, or split the robot"
        raise RobotError(f"{path}: has {count} links; PhysX holds at most {MAX_LINKS} in one robot; {remedy}")
    for parent in [*root.findall("link"), *root.findall("joint"), root]:
        for child in [child for child in parent if child.tag not in _READ[parent.tag]]:
            parent.remove(child)
    missing = _resolve_meshes(root, path, package_dirs)
    if missing and missing_meshes == "error":
        raise RobotError(
            f"{path}: collision mesh not found or not readable: {', '.join(missing)}; repair the file, pass "
            "package_dirs=[...] with the folder that holds the package, or missing_meshes='skip' to simulate without"
        )
    repairs = []
    if missing:
        text = f"collision meshes not found or not readable, simulated without: {', '.join(missing)}"
        remedy = "repair the files, or pass package_dirs=[...] to Robot.load"
        repairs.append(Finding("warning", "missing-mesh", text, remedy))
    joints = [_read_joint(element, path) for element in root.findall("joint")]
    links = [_read_link(element, path) for element in root.findall("link")]
    ordered = _breadth_first(links, joints, path)
    for element, joint in zip(root.findall("joint"), joints, strict=True):
        if joint.mimic is not None and joint.mimic.joint not in (other.name for other in joints):
            problem = f"joint {joint.name!r} mimics the unknown joint {joint.mimic.joint!r}"
            raise RobotError(f"{path}: {problem}; correct the name")
        if joint.mimic is not None and not mimic_works(joint, joints):
            element.remove(element.find("mimic"))  # SAPIEN would mis-simulate it; the preflight reports it
    if strict:
        refuse(path, repairs)
    text = etree.tostring(root, encoding="unicode")
    return Urdf(root.get("name", path.stem), text, tuple(ordered), tuple(links), tuple(missing), tuple(repairs))


def _resolve_meshes(root: etree._Element, path: Path, package_dirs: tuple[Path, ...]) -> list[str]:
    """Make mesh paths absolute; drop the shapes whose file is missing or unreadable; return their names and why."""
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
            mesh.set("filename", str(found))
    return missing


def _read_joint(element: etree._Element, path: Path) -> Joint:
    """Return a joint, and write out or remove what SAPIEN fails on.

    SAPIEN reads a missing limit as NaN, fails on ``<dynamics>`` without damping, and parses what it does not use.
    """
    name, kind = element.get("name", ""), element.get("type", "")
    where, ranged = f"{path}: joint {name!r}", kind in ("revolute", "prismatic")
    if not name:
        raise RobotError(f"{where}: has no name; add name=")
    if kind not in (*MOVING_TYPES, "fixed"):
        remedy = "use revolute, continuous, prismatic or fixed"
        raise RobotError(f"{where}: type {kind!r} cannot be simulated by SAPIEN's loader; {remedy}")
    parent, child = (None if end is None else end.get("link") for end in map(element.find, ("parent", "child")))
    if not parent or not child:
        raise RobotError(f"{where}: needs <parent link=...> and <child link=...>; add them")
    axis, limit, dynamics, mimic = map(element.find, ("axis", "limit", "dynamics", "mimic"))
    fields: dict[str, Any] = _origin(element, where)
    if axis is not None and kind == "fixed":
        element.remove(axis)
    elif axis is not None:
        fields["axis"] = numbers(axis, "xyz", "1 0 0", where)
        if math.hypot(*fields["axis"]) < 1e-3:
            raise RobotError(f"{where}: <axis xyz={axis.get('xyz')!r}> has no direction; correct the URDF")
    if limit is None and ranged:
        raise RobotError(f"{where}: a {kind} joint needs <limit lower= upper= effort= velocity=>; add it")
    if limit is not None:
        limits = {f"{key}_limit": number(limit, key, "inf", where, limit=True) for key in ("effort", "velocity")}
        if min(limits.values()) < 0:
            raise RobotError(f"{where}: effort and velocity limits must be >= 0 ({limits}); correct the URDF")
        for key in ("lower", "upper") if ranged else ():
            limits[key] = number(limit, key, "0", where, limit=True)
            limit.set(key, repr(limits[key]))
        if ranged and limits["lower"] > limits["upper"]:
            text = f"lower limit {limits['lower']:g} is above upper limit {limits['upper']:g}"
            raise RobotError(f"{where}: {text}; swap them")
        if not ranged:
            element.remove(limit)
        fields |= limits
    for key in ("damping", "friction") if dynamics is not None else ():
        fields[key] = number(dynamics, key, "0", where)
        if fields[key] < 0:
            raise RobotError(f"{where}: damping and friction must be >= 0 ({key} is {fields[key]}); correct the URDF")
        dynamics.set(key, repr(fields[key]))
    if mimic is not None:
        multiplier, offset = number(mimic, "multiplier", "1", where), number(mimic, "offset", "0", where)
        fields["mimic"] = Mimic(mimic.get("joint", ""), multiplier, offset)
    return Joint(name, kind, parent, child, **fields)


def mimic_works(joint: Joint, joints: Sequence[Joint]) -> bool:
    """Return whether SAPIEN simulates the mimic of ``joint`` correctly, which it does by a stiff tendon.

    It does for ``q = +-q_other`` where the other joint moves a sibling of this joint's link, or its parent. Any other
    mimic SAPIEN silently drops or mis-simulates.
    """
    mimic = joint.mimic
    if mimic is None or abs(mimic.multiplier) != 1 or mimic.offset != 0:
        return False
    other = next(other for other in joints if other.name == mimic.joint)
    if not other.moves or other is joint:
        return False
    return joint.parent_link in (other.child_link, other.parent_link)


def _read_link(element: etree._Element, path: Path) -> Link:
    """Return a link, and write out or remove those parts of its ``<inertial>`` that SAPIEN fails on."""
    name = element.get("name", "")
    where = f"{path}: link {name!r}"
    if not name:
        raise RobotError(f"{where}: has no name; add name=")
    mass, inertia = element.find("inertial/mass"), element.find("inertial/inertia")
    value = None if mass is None else number(mass, "value", "0", where)
    if value and value < SMALLEST:
        raise RobotError(f"{where}: mass {value} must be 0 or at least {SMALLEST:g} kg; correct the URDF")
    tensor = np.zeros((3, 3))
    if inertia is not None:
        for row, column, key in zip(*np.triu_indices(3), ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), strict=True):
            tensor[row, column] = tensor[column, row] = number(inertia, key, "0", where)
            inertia.set(key, inertia.get(key, "0"))
        if tensor.any() and np.linalg.eigvalsh(tensor)[0] < SMALLEST:
            problem = f"whose principal moments are not all at least {SMALLEST:g} kg m^2"
            raise RobotError(f"{where}: no body has the inertia {dict(inertia.attrib)}, {problem}; correct the URDF")
    for part in [*element]:
        _origin(part, where)
        if part.tag == "inertial" and not (value and tensor.any()):
            element.remove(part)  # SAPIEN does not use it
        elif part.tag == "collision":
            _check_shapes(part, where)
    return Link(name, value, len(element.findall("collision")), bool(value) and bool(tensor.any()))


def _check_shapes(collision: etree._Element, where: str) -> None:
    shapes = [shape for shape in collision.iterfind("geometry/*") if shape.tag in _SHAPES]
    if not shapes:
        raise RobotError(f"{where}: a <collision> has none of {', '.join(_SHAPES)}; add <geometry> with a shape")
    for shape in shapes:
        for key, default in _SHAPES[shape.tag].items():
            sizes = numbers(shape, key, default, where)
            sizes = tuple(map(abs, sizes)) if key == "scale" else sizes  # a negative scale mirrors the mesh
            if min(sizes) < SMALLEST_SIZE or max(sizes) > LARGEST_SIZE:
                need = f"must be > 0, from {SMALLEST_SIZE:g} to {LARGEST_SIZE:g}"
                raise RobotError(f"{where}: <{shape.tag} {key}={shape.get(key)!r}> {need}; correct the URDF")


def _origin(element: etree._Element, where: str) -> dict[str, tuple[float, ...]]:
    """Return the position [m] and the roll, pitch and yaw [rad] of an element's ``<origin>``."""
    origin = element.find("origin")
    return {"origin": numbers(origin, "xyz", "0 0 0", where), "rpy": numbers(origin, "rpy", "0 0 0", where)}


def _breadth_first(links: list[Link], joints: list[Joint], path: Path) -> list[Joint]:
    """Return the joints level by level from the root, siblings in file order, if they form one tree."""
    known, children = [link.name for link in links], [joint.child_link for joint in joints]
    linked, moved, below = set(known), set(children), defaultdict(list)
    for joint in joints:
        below[joint.parent_link].append(joint)
        for link in {joint.parent_link, joint.child_link} - linked:
            raise RobotError(f"{path}: joint {joint.name!r} names the unknown link {link!r}; add the link")
    for problem, names, remedy in (
        ("link name used twice", known, "names must be unique"),
        ("joint name used twice", [joint.name for joint in joints], "names must be unique"),
        ("link with two parents", children, "a robot must be a tree"),
    ):
        if twice := sorted(name for name, count in Counter(names).items() if count > 1):
            raise RobotError(f"{path}: {problem}: {', '.join(twice)}; {remedy}")
    roots = [name for name in known if name not in moved]
    if len(roots) != 1:
        raise RobotError(f"{path}: needs exactly one root link, found {roots or 'a loop'}; a robot must be one tree")
    ordered = below[roots[0]].copy()
    for joint in ordered:
        ordered += below[joint.child_link]
    if len(ordered) != len(joints):
        raise RobotError(f"{path}: some joints form a loop apart from the root {roots[0]!r}; a robot must be one tree")
    return ordered


def read_srdf(path: Path, urdf: Urdf) -> str:
    """Return the text of the .srdf at ``path``, checked for what SAPIEN's loader fails on.

    Raises
    ------
    RobotError
        What :func:`sim.robot.xml.parse_xml` refuses, a pair without reason or of unknown links, too many pairs.
    """
    root = parse_xml(path)
    names = {link.name for link in urdf.links}
    joined = {frozenset((joint.parent_link, joint.child_link)) for joint in urdf.all_joints}
    pairs = 0
    for element in root.findall("disable_collisions"):
        first, second = element.get("link1"), element.get("link2")
        where = f"{path}: <disable_collisions link1={first!r} link2={second!r}>"
        if "reason" not in element.attrib:
            raise RobotError(f"{where} has no reason; add reason='Default' for SAPIEN to apply it, or another")
        if element.get("reason").lower() != "default":
            continue  # SAPIEN applies no others
        if first not in names or second not in names or first == second:
            raise RobotError(f"{where} needs two links of the URDF; correct the names")
        pairs += frozenset((first, second)) not in joined
    if pairs > MAX_PAIRS:
        raise RobotError(f"{path}: disables {pairs} pairs with reason 'Default'; SAPIEN takes {MAX_PAIRS}; remove some")
    return etree.tostring(root, encoding="unicode")
