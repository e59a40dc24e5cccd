"""Reader of URDF and MJCF files.

A published URDF has faults. All that can be repaired without a guess about the robot's geometry is
repaired while it is read, with a finding each; the rest is an error.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Document, Float64
from batchpid.checks.validate import is_name
from batchpid.errors import RobotError
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.inertia import MOMENTS, SMALLEST, from_entries, possible_inertia
from batchpid.sim.geometry.mesh_files import LARGEST_NUMBER, check_mesh, find_mesh
from batchpid.sim.geometry.shapes import Shape
from batchpid.sim.robot.mjcf.model import unique
from batchpid.sim.robot.mjcf.reader import read_mjcf
from batchpid.sim.robot.parts import MOVING_TYPES, Joint, Mimic
from batchpid.sim.robot.tables import (
    NO_TURN,
    ORIGIN,
    Body,
    Source,
    Tables,
    breadth_first,
    without_mass,
)
from batchpid.sim.robot.xml import fault, numbers, parse_xml, read_numbers
from batchpid.task_space.frames import from_rpy

MOST_READ = 4096  # links and joints of a file
GIVE_RANGE = "give <limit lower= upper=>"
"""Remedy for position limits that are missing or unreadable."""
SMALLEST_SIZE, LARGEST_SIZE = 1e-6, 1e6
"""Bounds of the sizes of shapes [m] and scales of meshes: engines hold no others."""
SHAPES = {
    "box": {"size": "0 0 0"},
    "sphere": {"radius": "0"},
    "cylinder": {"radius": "0", "length": "0"},
    "capsule": {"radius": "0", "length": "0"},
    "mesh": {"scale": "1 1 1"},
}
"""Attributes of each shape, with as many numbers as each has."""
UNUSED = {"visual", "material", "transmission", "gazebo", "sensor", "ros2_control", "calibration"}
"""Elements of a URDF that have no effect here."""
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
    "inertia": {*MOMENTS},
    "safety_controller": {
        "soft_lower_limit",
        "soft_upper_limit",
        "k_position",
        "k_velocity",
    },
}
"""Attributes of the same kind, of the elements that have numbers of the motion."""
_EXPAND = "expand it first: xacro FILE.xacro > FILE.urdf"


def read_robot(
    path: Path,
    fixed_base: bool | None,
    package_dirs: tuple[Path, ...],
    missing_meshes: str,
) -> Source:
    """Return the robot in the URDF or MJCF file at ``path``.

    For the arguments see :meth:`batchpid.sim.Robot.load`. Raises RobotError for a file that cannot
    be read, a structure or number without repair, a bad mesh, or an MJCF file that MuJoCo does not
    compile.
    """
    source = _read(path, fixed_base, package_dirs, missing_meshes)
    joints = [joint.name for joint in source.tables.joints]
    for name in (source.name, *joints, *(body.name for body in source.tables.bodies)):
        if not is_name(name):
            raise RobotError(
                f"{path}: the name {name!r} has a control character or a line break; rename it"
            )
    return source


def _read(
    path: Path,
    fixed_base: bool | None,
    package_dirs: tuple[Path, ...],
    missing_meshes: str,
) -> Source:
    findings: list[Finding] = []
    root = parse_xml(path, findings)
    if not is_mjcf(root):
        return read_urdf(root, path, findings, fixed_base, package_dirs, missing_meshes)
    # MuJoCo opens the file by its path, and workers do so again.
    if not path.is_file():
        raise RobotError(f"{path}: an MJCF file is read several times; save it as a file first")
    name = root.get("model") or path.stem
    try:
        source = read_mjcf(path, name, fixed_base, missing_meshes)
    except UnicodeDecodeError as error:
        raise RobotError(
            f"{path}: a name is not UTF-8, which MuJoCo requires: {error}; save it as UTF-8"
        ) from error
    return source._replace(repairs=(*findings, *source.repairs))


def is_mjcf(root: etree._Element) -> bool:
    """Return whether a root element is an MJCF file's; MuJoCo ignores a default namespace."""
    return root.prefix is None and etree.QName(root).localname == "mujoco"


def read_urdf(
    root: etree._Element,
    path: Path,
    findings: list[Finding],
    fixed_base: bool | None,
    package_dirs: tuple[Path, ...],
    missing_meshes: str,
) -> Source:
    """Return the robot of the root element of a URDF, with ``findings`` of reading the file.

    Raises RobotError for a structure or number without repair, and for a bad mesh.
    """
    reader = _Reader(root, path, package_dirs, findings)
    # The root may be a bare link that says, with its floating joint, that the base is free.
    start = reader.free_base(fixed_base)
    if fixed_base is None:
        fixed_base = start is None
    tables = reader.read()
    reader.report_missing(missing_meshes)
    name = root.get("name", "").strip() or path.stem
    return Source(name, tables, tuple(findings), fixed_base, start or None)


class _Reader:
    """Links and joints of one file, by name."""

    def __init__(
        self,
        root: etree._Element,
        path: Path,
        package_dirs: tuple[Path, ...],
        findings: list[Finding],
    ) -> None:
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
        self._path = path
        self._package_dirs = package_dirs
        self._findings = findings
        self._missing: list[str] = []
        self._drop_unused(root)
        self._report_repeated(root)
        self._refuse_xacro(root)
        self._links = self._name_links(root)
        self._joints = self._name_joints(root)
        if not self._joints:
            remedy = f"if it is a xacro, {_EXPAND}"
            raise RobotError(f"{path}: a robot without joints cannot be controlled; {remedy}")
        self._match_links()

    def _warn(
        self,
        code: str,
        text: str,
        remedy: str,
        joint: str | None = None,
        link: str | None = None,
        detail: str = "",
    ) -> None:
        self._findings.append(Finding(code, text, remedy, joint, link, detail))

    # -- Structure

    def _drop_unused(self, root: etree._Element) -> None:
        """Remove elements that are not read, visuals above all; report them, and attributes."""
        unknown: Counter[str] = Counter()
        motors = root.iterfind("transmission"), root.iterfind("transmission/actuator")
        for parent in (root, *root.findall("link"), *root.findall("joint"), *chain(*motors)):
            for child in list(parent):
                if child.tag in _ELEMENTS[parent.tag]:
                    continue
                name = etree.QName(child)
                if "xacro" in (name.namespace or ""):
                    unknown[f"<xacro:{name.localname}>"] += 1
                elif name.localname not in UNUSED:
                    unknown[f"<{name.localname}>"] += 1
                parent.remove(child)
        for element in root.iter(*_ATTRIBUTES):
            for key in {*element.attrib} - _ATTRIBUTES[element.tag]:
                unknown[f"{key} of <{element.tag}>"] += 1
        for transmission in root.findall("transmission"):
            root.remove(transmission)
        if unknown:
            # A robot may lack the parts of a macro that is not expanded.
            is_xacro = any(name.startswith("<xacro:") for name in unknown)
            listed = ", ".join(f"{count} {name}" for name, count in unknown.most_common(8))
            text = f"elements that the simulation does not use are left out: {listed}"
            remedy = _EXPAND if is_xacro else "remove them, or expect no effect"
            self._findings.append(Finding("xml" if is_xacro else "unknown-element", text, remedy))

    def _report_repeated(self, root: etree._Element) -> None:
        """Report elements of which the first is read."""
        for part in (*root.findall("link"), *root.findall("joint")):
            for parent in part.iter():
                tags = ("shapes" if child.tag in SHAPES else f"<{child.tag}>" for child in parent)
                for tag, count in Counter(tags).items():
                    if count > 1 and tag != "<collision>":
                        text = f"<{parent.tag}> has several {tag}: the first is used"
                        owner = {part.tag: _text(part, "name")}
                        self._warn("repeated", text, "remove the others", **owner)

    def _refuse_xacro(self, root: etree._Element) -> None:
        for element in root.iter():
            for key, value in element.items():
                # find_mesh reads $(find PACKAGE).
                if "${" in value or ("$(" in value and key != "filename"):
                    problem = f"<{element.tag} {key}={value!r}> is an expression of xacro"
                    raise RobotError(f"{self._path}: {problem}; {_EXPAND}")

    def _name_links(self, root: etree._Element) -> dict[str, etree._Element]:
        """Return the links by name, without those whose name is taken or missing."""
        links: dict[str, etree._Element] = {}
        for element in root.findall("link"):
            name = _text(element, "name")
            if not name or name in links:
                text = "has no name, or a repeated one: left out"
                remedy = "give every link a unique name"
                self._warn("repeated", text, remedy, link=name or None)
                continue
            links[name] = element
        return links

    def _name_joints(self, root: etree._Element) -> dict[str, etree._Element]:
        """Return the joints by name, without copies; other joints of one name get new ones."""
        joints: dict[str, etree._Element] = {}
        names = {_text(element, "name") for element in root.findall("joint")}
        for element in root.findall("joint"):
            name = _text(element, "name")
            ends = _ends(element)
            if name in joints and _ends(joints[name]) == ends:
                self._warn("repeated", "given twice: the first is kept", "remove it", name)
                continue
            new = name
            if not name or name in joints:
                new = unique(name or "{}_to_{}".format(*ends), names)
                text = f"no name, or a repeated one: renamed {new!r}"
                self._warn("repeated", text, "name it in the URDF", name or None)
            joints[new] = element
        return joints

    def _match_links(self) -> None:
        """Add links that only joints name, remove links that no joint names."""
        joined = {}
        for name, element in self._joints.items():
            ends = _ends(element)
            if not all(ends):
                raise RobotError(
                    f"{self._path}: joint {name!r}: needs <parent link=...> and <child link=...>;"
                    " add them"
                )
            joined.update(dict.fromkeys(ends))
        for name in joined:
            if name not in self._links:
                self._links[name] = etree.Element("link")
                text = "named by joints, but not in the file: added, without mass and shape"
                self._warn("loose-link", text, "correct the name, or add the link", link=name)
        for name in [name for name in self._links if name not in joined]:
            text = "no joint holds it: left out"
            self._warn("loose-link", text, "join it, or remove it", link=name)
            del self._links[name]

    def free_base(self, fixed_base: bool | None) -> tuple[float, ...] | None:
        """Remove a floating joint that leads from a link without mass and shapes at the root to all
        others, with this link, unless the base is to be fixed.

        Return the pose (7,) at which the joint places the base, () if it does not, None without
        such a joint.
        """
        children = {_ends(element)[1] for element in self._joints.values()}
        at_root = [name for name, joint in self._joints.items() if _ends(joint)[0] not in children]
        # With a second joint at the root, the link there is a part of the robot.
        if len(at_root) != 1 or fixed_base:
            return None
        (name,) = at_root
        joint = self._joints[name]
        link = _ends(joint)[0]
        if joint.get("type") != "floating" or len(self._links[link]):
            return None
        del self._joints[name], self._links[link]
        if joint.find("origin") is None:
            return ()
        position, turn = read_origin(joint, f"{self._path}: joint {name!r}")
        return (*position.tolist(), *turn.tolist())

    def read(self) -> Tables:
        """Return the tables.

        Raises RobotError unless the joints make one tree.
        """
        joints = {name: self._read_joint(name, element) for name, element in self._joints.items()}
        self._repair_mimics(joints)
        parents = Counter(joint.child_link for joint in joints.values())
        if twice := sorted(name for name, count in parents.items() if count > 1):
            raise RobotError(
                f"{self._path}: link with two parents: {', '.join(twice)}; a robot must be a tree"
            )
        roots = [name for name in self._links if name not in parents]
        if len(roots) != 1:
            missing = [name for name, link in self._links.items() if not link.attrib]
            raise RobotError(
                f"{self._path}: needs exactly one root link, found {roots or 'a loop'}; a robot must"
                f" be one tree; links that joints name, not in the file: {missing}"
            )
        # Siblings are in the order of their joints.
        shapes: list[Shape] = []
        bodies = [self._read_link(Body(roots[0], None), shapes)]
        for joint in joints.values():
            place = read_origin(self._joints[joint.name], f"{self._path}: joint {joint.name!r}")
            bodies.append(self._read_link(Body(joint.child_link, joint, *place), shapes))
        tables = breadth_first(bodies, shapes)
        # Links of a loop are below no root, and so left behind.
        if len(tables.bodies) != len(bodies):
            raise RobotError(
                f"{self._path}: some joints form a loop apart from the root {roots[0]!r}; a robot"
                " must be one tree"
            )
        return tables

    # -- Joints

    def _read_joint(self, name: str, element: etree._Element) -> Joint:
        parent, child = _ends(element)
        kind = element.get("type", "").strip().lower()
        if kind not in (*MOVING_TYPES, "fixed"):
            text = f"joints of type {kind!r} are not simulated: fixed instead"
            remedy = "use revolute, continuous or prismatic joints"
            if kind == "floating":
                remedy = "load with fixed_base=False for a robot that is free to move"
            self._warn("joint", text, remedy, name)
            kind = "fixed"
        # The other elements mean nothing for a fixed joint, and their faults are none.
        if kind == "fixed":
            if element.find("mimic") is not None:
                self._report_mimic(name, element.find("mimic"), "cannot move a fixed joint")
            return Joint(name, "fixed", parent, child)
        fields = self._read_limits(name, kind, element)
        axis = numbers(element.find("axis"), "xyz", "1 0 0")
        if axis is None or math.hypot(*axis) < 1e-3:
            text = f"<axis xyz={_text(element.find('axis'), 'xyz')!r}> has no direction: the x"
            text += " axis is used, the URDF's default"
            self._warn("joint", text, "correct the axis", name)
            axis = (1.0, 0.0, 0.0)
        dynamics = element.find("dynamics")
        for key in ("damping", "friction"):
            values = numbers(dynamics, key, "0")
            # A negative damping would add energy in every step.
            if values is None or values[0] < 0:
                text = f"<dynamics {key}={_text(dynamics, key)!r}> must be a number >= 0: 0 is used"
                self._warn("dynamics", text, "correct the URDF", name)
                values = (0.0,)
            fields[key] = values[0]
        fields["mimic"] = self._read_mimic(name, element.find("mimic"))
        return Joint(name, kind, parent, child, axis=axis, **fields)

    def _read_limits(self, name: str, kind: str, joint: etree._Element) -> Document:
        """Return the limits of a joint by field; missing and placeholder limits are infinite."""
        limit = joint.find("limit")
        limits: Document = {}
        placeholders = []
        for key in ("effort", "velocity", "acceleration", "deceleration"):
            values = numbers(limit, key, "inf", limit=True)
            # Exporters write 0 or -1 for "not set".
            if values is None or values[0] <= 0:
                placeholders.append(f"{key}={_text(limit, key)!r}")
                values = (math.inf,)
            limits[f"{key}_limit"] = values[0]
        if placeholders:
            text = f"<limit {' '.join(placeholders)}> is a placeholder or not within"
            text += f" +-{LARGEST_NUMBER:g}: no limit"
            self._warn("limits", text, "give <limit effort= velocity=> of the motor", name)
        # A guard has one limit for both.
        braking = limits.pop("deceleration_limit")
        limits["acceleration_limit"] = min(limits["acceleration_limit"], braking)
        is_unknown = all(map(math.isinf, limits.values()))
        safety = joint.find("safety_controller")
        if safety is not None:
            where = f"{self._path}: joint {name!r}"
            (low,) = read_numbers(safety, "soft_lower_limit", "0", where)
            (high,) = read_numbers(safety, "soft_upper_limit", "0", where)
            if low < high:  # both are 0 where they are left out
                limits |= {"soft_lower": low, "soft_upper": high}
        if kind == "continuous":
            return limits
        ends = []
        for key, endless in (("lower", -math.inf), ("upper", math.inf)):
            values = numbers(limit, key, "0", limit=True)
            if values is None:
                text = f"<limit {key}={_text(limit, key)!r}> is not a number within"
                text += f" +-{LARGEST_NUMBER:g}: no {key} limit"
                self._warn("limits", text, GIVE_RANGE, name)
                values = (endless,)
            ends.append(values[0])
        lower, upper = ends
        # The URDF's default of a missing end is 0, which may be on the wrong side. Exporters write
        # 0 for all four numbers of a joint whose limits they do not know.
        is_given = bool(_text(limit, "lower") and _text(limit, "upper"))
        is_placeholder = lower == upper == 0 and is_unknown
        if is_placeholder or (lower >= upper and not is_given):
            self._warn("limits", "no position limits: motion without end", GIVE_RANGE, name)
            lower, upper = -math.inf, math.inf
        elif lower > upper:
            detail = f"{lower:g}, {upper:g}"
            self._warn("limits", "limits are swapped", "swap them", name, detail=detail)
            lower, upper = upper, lower
        return limits | {"lower": lower, "upper": upper}

    def _read_mimic(self, name: str, mimic: etree._Element | None) -> Mimic | None:
        if mimic is None:
            return None
        multiplier = numbers(mimic, "multiplier", "1")
        offset = numbers(mimic, "offset", "0")
        if multiplier is None or offset is None or multiplier[0] == 0:
            texts = ", ".join(f"{key} {mimic.get(key)!r}" for key in ("multiplier", "offset"))
            self._report_mimic(name, mimic, f"cannot lead it with {texts}")
            return None
        return Mimic(_text(mimic, "joint"), multiplier[0], offset[0])

    def _repair_mimics(self, joints: dict[str, Joint]) -> None:
        """Remove mimics of joints that cannot lead."""
        for name, joint in joints.items():
            if joint.mimic is None:
                continue
            leader = joints.get(joint.mimic.joint)
            problem = None
            if leader is None:
                problem = "is not in the file"
            elif not leader.moves:
                problem = "does not move"
            # A chain of leaders that comes back to the joint is cut there.
            leaders = set[str]()
            while leader is not None and leader.mimic is not None and leader.name not in leaders:
                leaders.add(leader.name)
                leader = joints.get(leader.mimic.joint)
            if name in leaders:
                problem = "mimics it in turn"
            if problem is not None:
                self._report_mimic(name, self._joints[name].find("mimic"), problem)
                joints[name] = replace(joint, mimic=None)

    def _report_mimic(self, name: str, mimic: etree._Element, problem: str) -> None:
        text = f"mimics {mimic.get('joint')!r}, which {problem}: moves independently"
        self._warn("mimic", text, "correct <mimic joint=>, or remove it", name)

    # -- Links

    def _read_link(self, body: Body, shapes: list[Shape]) -> Body:
        """Return ``body`` with the inertia of its link, and append the link's shapes."""
        link = self._links[body.name]
        for collision in link.findall("collision"):
            shape = self._read_collision(body.name, collision)
            shapes += [] if shape is None else [shape]
        if (inertial := link.find("inertial")) is None:
            return body
        mass, inertia = map(inertial.find, ("mass", "inertia"))
        center, turn = ORIGIN, NO_TURN
        if problem := _misplaced(inertial):
            text = f"{problem}: the centre of mass is taken at the origin of the link"
            self._warn("inertia", text, "correct <inertial><origin>", link=body.name)
        else:
            center, turn = read_origin(inertial, "")
        value = numbers(mass, "value", "0")
        if value is None or value[0] < 0 or 0 < value[0] < SMALLEST:
            text = f"<mass value={_text(mass, 'value')!r}> is no mass from {SMALLEST:g} to"
            text += f" {LARGEST_NUMBER:g}: it counts as missing"
            self._warn("inertia", text, "give a mass > 0 [kg]", link=body.name)
            return body
        if value[0] == 0:
            return without_mass(body)
        # One unreadable entry makes the whole tensor unknown.
        entries = [numbers(inertia, key, "0") for key in MOMENTS]
        tensor = np.zeros((3, 3))
        if None not in entries:
            tensor = from_entries([entry[0] for entry in entries if entry])
        for problem in filter(None, (fault(inertia, key, "0") for key in MOMENTS)):
            text = f"{problem}: the inertia tensor counts as missing"
            self._warn("inertia", text, "correct <inertia>", link=body.name)
        tensor, repair = possible_inertia(value[0], tensor)
        if repair is not None:
            text, detail = repair
            self._warn("inertia", text, "correct <inertia>", link=body.name, detail=detail)
        return body._replace(mass=value[0], center=center, inertia=tensor, inertia_wxyz=turn)

    def _read_collision(self, link: str, collision: etree._Element) -> Shape | None:
        """Return a collision shape, None if it has no size or its mesh is missing."""
        geometry = next(
            (part for part in collision.iterfind("geometry/*") if part.tag in SHAPES), None
        )
        problem = _misplaced(collision)
        if geometry is None:
            problem = f"it has none of {', '.join(SHAPES)}"
        else:
            for key, default in SHAPES[geometry.tag].items():
                text = _text(geometry, key) or default
                if key == "scale" and len(text.split()) == 1:
                    geometry.set(key, " ".join([text] * 3))  # one factor for all axes
                sizes = numbers(geometry, key, default) or (0.0,)
                # A negative scale mirrors the mesh.
                smallest = min(map(abs, sizes)) if key == "scale" else min(sizes)
                if smallest < SMALLEST_SIZE or max(sizes) > LARGEST_SIZE:
                    problem = f"<{geometry.tag} {key}={text!r}> is not from {SMALLEST_SIZE:g} to"
                    problem += f" {LARGEST_SIZE:g}"
        if geometry is None or problem is not None:
            text = f"a collision shape is left out: {problem}"
            self._warn("collision", text, "correct <collision>", link=link)
            return None
        shape = read_shape(geometry, link, read_origin(collision, ""), "")
        if shape.kind != "mesh":
            return shape
        file = find_mesh(shape.file, self._path, self._package_dirs)
        if file is None:
            self._missing.append(shape.file)
            return None
        content, problem = check_mesh(file)
        if problem is not None:
            self._missing.append(f"{shape.file} ({problem})")
            return None
        return shape._replace(file=str(file), content=content)

    def report_missing(self, missing_meshes: str) -> None:
        """Report meshes that are missing or cannot be read, or raise RobotError if that is
        "error".
        """
        if not self._missing:
            return
        listed = ", ".join(self._missing)
        remedy = "repair the files, pass package_dirs=[...] with the folder that holds the package"
        remedy += ", or name it in ROS_PACKAGE_PATH"
        if missing_meshes == "error":
            problem = f"collision mesh not found or not readable: {listed}"
            raise RobotError(
                f"{self._path}: {problem}; {remedy}, or missing_meshes='skip' to simulate without"
            )
        text = f"collision meshes not found or not readable, simulated without: {listed}"
        self._warn("missing-mesh", text, remedy)


def read_shape(
    geometry: etree._Element,
    link: str,
    place: tuple[Float64, Float64],
    where: str,
) -> Shape:
    """Return the shape of a ``<geometry>`` of ``link``, at a position and orientation."""
    kind = geometry.tag
    sizes = [read_numbers(geometry, key, text, where) for key, text in SHAPES[kind].items()]
    if kind == "mesh":
        return Shape(
            link,
            link,
            kind,
            (),
            *place,
            geometry.get("filename", "").strip(),
            sizes[0],
        )
    if kind == "box":
        return Shape(
            link,
            link,
            kind,
            tuple(0.5 * side for side in sizes[0]),
            *place,
        )
    size = sizes[0]
    if kind != "sphere":
        size = (sizes[0][0], 0.5 * sizes[1][0])
    return Shape(link, link, kind, size, *place)


def read_origin(element: etree._Element, where: str) -> tuple[Float64, Float64]:
    """Return position (3,) [m] and orientation (4,) of an element's ``<origin>``."""
    origin = element.find("origin")
    position = np.array(read_numbers(origin, "xyz", "0 0 0", where))
    rpy = read_numbers(origin, "rpy", "0 0 0", where)
    return position, from_rpy(rpy) if any(rpy) else NO_TURN  # mostly


def _misplaced(element: etree._Element) -> str | None:
    """Return the fault of an ``<origin>`` that cannot be read, or None."""
    origin = element.find("origin")
    return fault(origin, "xyz", "0 0 0") or fault(origin, "rpy", "0 0 0")


def _ends(joint: etree._Element) -> tuple[str, str]:
    """Return the names of the parent and the child link of a joint, "" where they are missing."""
    return _text(joint.find("parent"), "link"), _text(joint.find("child"), "link")


def _text(element: etree._Element | None, key: str) -> str:
    """Return an attribute without blanks around it, "" without one."""
    return "" if element is None else element.get(key, "").strip()
