"""Repair of published URDFs: all faults that can be repaired without a guess about the robot's
geometry.

Every function changes the XML tree in place and yields a finding of each repair. After the repairs
the tree is valid for the reader (:mod:`batchpid.sim.robot.urdf`), or has a fault without repair,
which is an error there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError
from batchpid.sim.robot import joint_repair, link_repair
from batchpid.sim.robot.findings import Finding, finding_of
from batchpid.sim.robot.joint_repair import ends_of
from batchpid.sim.robot.link_repair import SHAPES

_READ = {  # elements to keep, by parent: SAPIEN may fail to parse elements that it does not use
    "robot": {"link", "joint"},
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
    "inertial": {"origin", "mass", "inertia"},
    "collision": {"origin", "geometry"},
    "geometry": {*SHAPES},
}
_MANY = {"link", "joint", "collision", *SHAPES}  # elements that a parent may have several of
UNUSED = {"visual", "material", "transmission", "gazebo", "sensor", "ros2_control", "calibration"}
"""Elements of a URDF that have no effect here."""
_VECTORS = {"xyz", "rpy", "size", "scale"}
"""Attributes that hold three numbers."""


def repair(root: etree._Element, path: Path) -> list[Finding]:
    """Repair the ``<robot>`` read from ``path`` in place and return the findings.

    Raises RobotError if the file is a xacro that was not expanded, or has no joint.
    """
    findings = [*_elements(root), *_attributes(root)]
    # After the removal of elements without effect, where an expression does no harm.
    _refuse_xacro(root, path)
    if root.find("joint") is None:
        remedy = "a xacro has to be expanded first: xacro FILE.xacro > FILE.urdf"
        raise RobotError(f"{path}: a robot without joints cannot be controlled; {remedy}")
    if root.get("name") is None:
        root.set("name", path.stem)
    findings += [*_links(root), *_joints(root), *_tree(root)]
    for joint in root.findall("joint"):
        findings += joint_repair.repair(joint)
    findings += joint_repair.mimics(root)
    for link in root.findall("link"):
        findings += link_repair.repair(link)
    return findings


def _elements(root: etree._Element) -> Iterator[Finding]:
    """Remove elements that SAPIEN does not use, and repetitions of elements that may occur once."""
    unknown: Counter[str] = Counter()
    xacro: Counter[str] = Counter()
    stack = [root]
    while stack:
        parent = stack.pop()
        seen = set()
        for child in list(parent):
            tag = etree.QName(child).localname
            # Elements within those that are kept are looked at in turn.
            if child.tag in _READ[parent.tag] and (child.tag in _MANY or child.tag not in seen):
                seen.add(child.tag)
                stack += [child] if child.tag in _READ else []
                continue
            if child.tag in _READ[parent.tag]:
                text = f"<{parent.tag}> has several <{tag}>: the first is used"
                yield finding_of(parent, "warning", "repeated-element", text, "remove the others")
            elif "xacro" in (etree.QName(child).namespace or ""):
                xacro[tag] += 1
            elif tag not in UNUSED:
                unknown[tag] += 1
            parent.remove(child)
    if xacro:
        text = f"elements of xacro, not expanded, are left out: {_list(xacro)}"
        yield Finding(
            "warning", "xacro", text, "expand the file first: xacro FILE.xacro > FILE.urdf"
        )
    if unknown:
        text = f"elements that the simulation does not use are left out: {_list(unknown)}"
        yield Finding("note", "unknown-element", text, "remove them, or expect no effect")


def _list(tags: Counter[str]) -> str:
    shown = [f"<{tag}>" if count == 1 else f"{count} <{tag}>" for tag, count in tags.most_common(8)]
    return ", ".join(shown) + (" and others" if len(tags) > 8 else "")


def _attributes(root: etree._Element) -> Iterator[Finding]:
    """Strip the attributes, remove empty ones, and read commas between numbers."""
    for element in root.iter():
        for key, value in element.items():
            if not (text := value.strip()):
                del element.attrib[key]
                if key != "name":
                    problem = f"<{element.tag} {key}=''> is empty and counts as not given"
                    yield finding_of(
                        element, "note", "empty-attribute", problem, "give a value, or remove it"
                    )
            elif key in _VECTORS and len(text.split(",")) == 3:
                element.set(key, text.replace(",", " "))
                problem = f"<{element.tag} {key}={text!r}> is read with blanks in place of commas"
                remedy = "separate the numbers by blanks"
                yield finding_of(element, "warning", "number", problem, remedy)
            elif text != value:
                element.set(key, text)


def _refuse_xacro(root: etree._Element, path: Path) -> None:
    for element in root.iter():
        for key, value in element.items():
            if "${" in value or (
                "$(" in value and key != "filename"
            ):  # of which find_mesh reads $(find PACKAGE)
                problem = (
                    f"<{element.tag} {key}={value!r}> is an expression of xacro, so this is no"
                    " URDF yet"
                )
                raise RobotError(
                    f"{path}: {problem}; expand it first: xacro FILE.xacro > FILE.urdf"
                )


def _links(root: etree._Element) -> Iterator[Finding]:
    """Remove links without a name and with a name that is taken."""
    seen: set[str | None] = {None}
    for link in root.findall("link"):
        name = link.get("name")
        if name in seen:
            text = "has no name, or one that is used twice: left out"
            remedy = "give every link a name to itself"
            yield finding_of(link, "warning", "repeated-name", text, remedy)
            root.remove(link)
        seen.add(name)


def _joints(root: etree._Element) -> Iterator[Finding]:
    """Name joints that have no name or a repeated one; remove copies of joints."""
    seen: dict[str, tuple[str | None, str | None]] = {}
    names = {joint.get("name") for joint in root.findall("joint")}
    for joint in root.findall("joint"):
        name = joint.get("name")
        ends = ends_of(joint)
        if name is not None and seen.get(name) == ends:
            text = "given twice: the first is kept"
            yield finding_of(joint, "warning", "repeated-name", text, "remove the copy")
            root.remove(joint)
            continue
        # The number that makes a new name is the first that nobody has.
        base = new = name or "{}_to_{}".format(*ends)
        number = 2
        while new in seen or (new != name and new in names):
            new = f"{base}_{number}"
            number += 1
        if new != name:
            joint.set("name", new)
            text = f"no name, or one that is used twice: called {new!r}"
            yield finding_of(joint, "warning", "repeated-name", text, "name it in the URDF")
        seen[new] = ends


def _tree(root: etree._Element) -> Iterator[Finding]:
    """Add links that only joints name; remove links that no joint names, if others make the
    robot.
    """
    links = {link.get("name"): link for link in root.findall("link")}
    ends = [ends_of(joint) for joint in root.findall("joint")]
    for name in dict.fromkeys(end for pair in ends for end in pair if end is not None):
        if name not in links:
            links[name] = etree.SubElement(root, "link", name=name)
            text = "named by joints, but not in the file: added, without mass and shape"
            yield Finding(
                "warning", "missing-link", text, "correct the name, or add the link", link=name
            )
    # A robot of one link has no joints that could name it.
    joined = {end for pair in ends for end in pair}
    for name, link in links.items():
        if joined and name not in joined:
            yield finding_of(
                link, "warning", "loose-link", "held by no joint: left out", "join it, or remove it"
            )
            root.remove(link)
