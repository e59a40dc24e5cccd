"""Reader of URDF files: the tree of links and joints.

A published URDF has faults. All that can be repaired without a guess about the robot's geometry is
repaired while it is read, with a finding each; the rest is an error.
"""

from __future__ import annotations

import re
from collections import Counter
from itertools import chain
from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError
from batchpid.sim.description.tables import Body, Source, Tables, breadth_first, unique
from batchpid.sim.description.urdf_elements import (
    SHAPES,
    ElementReader,
    ends_of,
    read_origin,
    text_of,
)
from batchpid.sim.findings import Finding

MOST_READ = 4096  # links and joints of a file
_UNUSED = {"visual", "material", "transmission", "gazebo", "sensor", "ros2_control", "calibration"}
"""Elements of a URDF without effect on the motion."""
_ELEMENTS = {
    "robot": {"link", "joint", "transmission"},
    "link": {"inertial", "collision"},
    "joint": {
        "origin",
        "parent",
        "child",
        "axis",
        "limit",
        "dynamics",
        "mimic",
        "safety_controller",
    },
    "transmission": {"type", "joint", "actuator"},
    "actuator": {"hardwareInterface", "mechanicalReduction"},
}
"""Elements that are read, or say how motors are connected and nothing about the motion, by
parent.
"""
_ATTRIBUTES = {
    "limit": {"lower", "upper", "effort", "velocity", "acceleration", "deceleration"},
    "dynamics": {"damping", "friction"},
    "mimic": {"joint", "multiplier", "offset"},
    "mass": {"value"},
    "inertia": {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"},
    "safety_controller": {
        "soft_lower_limit",
        "soft_upper_limit",
        "k_position",
        "k_velocity",
    },
}
"""Attributes of the same kind, of the elements that have numbers of the motion."""
_EXPAND = "expand it first: xacro FILE.xacro > FILE.urdf"

Elements = dict[str, etree._Element]
"""Links or joints by name."""


def read_urdf(
    root: etree._Element,
    path: Path,
    findings: list[Finding],
    fixed_base: bool | None,
    package_dirs: tuple[Path, ...],
) -> Source:
    """Return the robot of the root element of a URDF, with ``findings`` of reading the file.

    Raises RobotError for a structure or number without repair.
    """
    _check_root(root, path)
    reader = ElementReader(path, package_dirs, findings)
    reader.read_visuals(root)
    _drop_unused(root, findings)
    _report_repeated(root, reader)
    _refuse_xacro(root, path)
    links = _name_links(root, reader)
    joints = _name_joints(root, reader)
    if not joints:
        remedy = f"if it is a xacro, {_EXPAND}"
        raise RobotError(f"{path}: a robot without joints cannot be controlled; {remedy}")
    _match_links(links, joints, path, reader)
    # The root may be a bare link that says, with its floating joint, that the base is free.
    start = _free_base(links, joints, path, fixed_base)
    if fixed_base is None:
        fixed_base = start is None
    tables = _read_tables(links, joints, path, reader)
    reader.report_missing()
    name = root.get("name", "").strip() or path.stem
    return Source(
        path,
        name,
        tables,
        tuple(findings),
        fixed_base,
        start or None,
    )


def _check_root(root: etree._Element, path: Path) -> None:
    """Raise RobotError for a file of another kind, or one that is too large."""
    if root.tag != "robot":
        problem = f"the root element is <{root.tag}>, not <robot> (URDF) or <mujoco> (MJCF)"
        raise RobotError(
            f"{path}: {problem}; is this a robot's file (not SDF, xacro, a part of an MJCF)?"
        )
    # Some of the checks take time that is the square of the number.
    if max(len(root.findall(tag)) for tag in ("link", "joint")) > MOST_READ:
        raise RobotError(
            f"{path}: has more than {MOST_READ} links or joints; remove what the robot does not"
            " need"
        )


def _drop_unused(root: etree._Element, findings: list[Finding]) -> None:
    """Remove elements without effect on the motion; report unknown ones, and attributes."""
    unknown: Counter[str] = Counter()
    motors = root.iterfind("transmission"), root.iterfind("transmission/actuator")
    for parent in (root, *root.findall("link"), *root.findall("joint"), *chain(*motors)):
        for child in list(parent):
            if child.tag in _ELEMENTS[parent.tag]:
                continue
            # With the namespace, or a prefix that nobody declared.
            name = re.split("[:}]", child.tag)[-1]
            if "xacro" in child.tag:
                unknown[f"<xacro:{name}>"] += 1
            elif name not in _UNUSED:
                unknown[f"<{name}>"] += 1
            parent.remove(child)
    for element in root.iter(*_ATTRIBUTES):
        for key in sorted({*element.attrib} - _ATTRIBUTES[element.tag]):
            unknown[f"{key} of <{element.tag}>"] += 1
    for transmission in root.findall("transmission"):
        root.remove(transmission)
    if unknown:
        # A robot may lack the parts of a macro that is not expanded.
        is_xacro = any(name.startswith("<xacro:") for name in unknown)
        listed = ", ".join(f"{count} {name}" for name, count in unknown.most_common(8))
        text = f"elements that the simulation does not use are left out: {listed}"
        remedy = _EXPAND if is_xacro else "remove them, or expect no effect"
        findings.append(Finding("xml" if is_xacro else "unknown-element", text, remedy))


def _report_repeated(root: etree._Element, reader: ElementReader) -> None:
    """Report elements of which the first is read."""
    for part in (*root.findall("link"), *root.findall("joint")):
        for parent in part.iter():
            tags = ("shapes" if child.tag in SHAPES else f"<{child.tag}>" for child in parent)
            for tag, count in Counter(tags).items():
                if count > 1 and tag != "<collision>":
                    text = f"<{parent.tag}> has several {tag}: the first is used"
                    owner = {part.tag: text_of(part, "name")}
                    reader.warn("repeated", text, "remove the others", **owner)


def _refuse_xacro(root: etree._Element, path: Path) -> None:
    for element in root.iter():
        for key, value in element.items():
            # find_mesh reads $(find PACKAGE).
            if "${" in value or ("$(" in value and key != "filename"):
                problem = f"<{element.tag} {key}={value!r}> is an expression of xacro"
                raise RobotError(f"{path}: {problem}; {_EXPAND}")


def _name_links(root: etree._Element, reader: ElementReader) -> Elements:
    """Return the links by name, without those whose name is taken or missing."""
    links: Elements = {}
    for element in root.findall("link"):
        name = text_of(element, "name")
        if not name or name in links:
            text = "has no name, or a repeated one: left out"
            reader.warn("repeated", text, "give every link a unique name", link=name or None)
            continue
        links[name] = element
    return links


def _name_joints(root: etree._Element, reader: ElementReader) -> Elements:
    """Return the joints by name, without copies; other joints of one name get new ones."""
    joints: Elements = {}
    names = {text_of(element, "name") for element in root.findall("joint")}
    for element in root.findall("joint"):
        name = text_of(element, "name")
        ends = ends_of(element)
        if name in joints and ends_of(joints[name]) == ends:
            reader.warn("repeated", "given twice: the first is kept", "remove it", name)
            continue
        new = name
        if not name or name in joints:
            new = unique(name or "{}_to_{}".format(*ends), names)
            text = f"no name, or a repeated one: renamed {new!r}"
            reader.warn("repeated", text, "name it in the URDF", name or None)
        joints[new] = element
    return joints


def _match_links(links: Elements, joints: Elements, path: Path, reader: ElementReader) -> None:
    """Add links that only joints name, remove links that no joint names."""
    joined = {}
    for name, element in joints.items():
        ends = ends_of(element)
        if not all(ends):
            raise RobotError(
                f"{path}: joint {name!r}: needs <parent link=...> and <child link=...>; add them"
            )
        joined.update(dict.fromkeys(ends))
    for name in joined:
        if name not in links:
            links[name] = etree.Element("link")
            text = "named by joints, but not in the file: added, without mass and shape"
            reader.warn("loose-link", text, "correct the name, or add the link", link=name)
    for name in [name for name in links if name not in joined]:
        text = "no joint holds it: left out"
        reader.warn("loose-link", text, "join it, or remove it", link=name)
        del links[name]


def _free_base(
    links: Elements,
    joints: Elements,
    path: Path,
    fixed_base: bool | None,
) -> tuple[float, ...] | None:
    """Remove a floating joint that leads from a link without mass and shapes at the root to all
    others, with this link, unless the base is to be fixed.

    Return the pose (7,) at which the joint places the base, () if it does not, None without
    such a joint.
    """
    children = {ends_of(element)[1] for element in joints.values()}
    at_root = [name for name, joint in joints.items() if ends_of(joint)[0] not in children]
    # With a second joint at the root, the link there is a part of the robot.
    if len(at_root) != 1 or fixed_base:
        return None
    (name,) = at_root
    joint = joints[name]
    link = ends_of(joint)[0]
    if joint.get("type") != "floating" or len(links[link]):
        return None
    del joints[name], links[link]
    if joint.find("origin") is None:
        return ()
    position, turn = read_origin(joint, f"{path}: joint {name!r}")
    return (*position.tolist(), *turn.tolist())


def _read_tables(links: Elements, joints: Elements, path: Path, reader: ElementReader) -> Tables:
    """Return the tables of a file.

    Raises RobotError unless the joints make one tree.
    """
    rows = {name: reader.read_joint(name, element) for name, element in joints.items()}
    reader.repair_mimics(rows, joints)
    parents = Counter(joint.child_link for joint in rows.values())
    if twice := sorted(name for name, count in parents.items() if count > 1):
        raise RobotError(
            f"{path}: link with two parents: {', '.join(twice)}; a robot must be a tree"
        )
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        missing = [name for name, link in links.items() if not link.attrib]
        raise RobotError(
            f"{path}: needs exactly one root link, found {roots or 'a loop'}; a robot must be one"
            f" tree; links that joints name, not in the file: {missing}"
        )
    # Siblings are in the order of their joints.
    bodies = [reader.read_link(Body(roots[0], None), links[roots[0]])]
    for joint in rows.values():
        place = read_origin(joints[joint.name], f"{path}: joint {joint.name!r}")
        body = Body(joint.child_link, joint, *place)
        bodies.append(reader.read_link(body, links[body.name]))
    tables = breadth_first(bodies, reader.shapes, reader.visuals)
    # Links of a loop are below no root, and so left behind.
    if len(tables.bodies) != len(bodies):
        raise RobotError(
            f"{path}: some joints form a loop apart from the root {roots[0]!r}; a robot must be one"
            " tree"
        )
    return tables
