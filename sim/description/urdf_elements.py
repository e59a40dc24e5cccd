"""Joints, links and shapes of a URDF: their numbers, with a repair for each that cannot be used."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Document, Float64
from batchpid.sim.description.tables import (
    MOVING_TYPES,
    NO_TURN,
    ORIGIN,
    Body,
    Joint,
    Mimic,
    Visual,
    with_mass,
    without_mass,
)
from batchpid.sim.description.xml import fault, numbers, read_numbers
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.mesh_files import LARGEST_NUMBER, check_mesh, find_mesh
from batchpid.sim.geometry.shapes import MOMENTS, SMALLEST, Shape, from_entries
from batchpid.task_space.frames import from_rpy

GIVE_RANGE = "give <limit lower= upper=>"
"""Remedy for position limits that are missing or unreadable."""
SMALLEST_SIZE, LARGEST_SIZE = 1e-6, 1e6
"""Bounds of the sizes of shapes [m] and scales of meshes: engines hold no others."""
GREY = "0.6 0.6 0.6 1"
"""Colour of a material without one."""
SHAPES = {
    "box": {"size": "0 0 0"},
    "sphere": {"radius": "0"},
    "cylinder": {"radius": "0", "length": "0"},
    "capsule": {"radius": "0", "length": "0"},
    "mesh": {"scale": "1 1 1"},
}
"""Attributes of each shape, with as many numbers as each has."""


class ElementReader:
    """Reader of the elements of one file. It appends to ``findings``, ``shapes`` and ``visuals``."""

    def __init__(self, path: Path, package_dirs: tuple[Path, ...], findings: list[Finding]) -> None:
        self._path = path
        self._package_dirs = package_dirs
        self._findings = findings
        self._missing: list[str] = []
        self.shapes: list[Shape] = []
        self.visuals: dict[str, tuple[Visual, ...]] = {}

    def warn(
        self,
        code: str,
        text: str,
        remedy: str,
        joint: str | None = None,
        **place: Any,
    ) -> None:
        """Report a repair; ``place`` are further fields of the finding."""
        self._findings.append(Finding(code, text, remedy, joint, **place))

    def read_visuals(self, root: etree._Element) -> None:
        """Read the shapes that are drawn, without findings: they change no motion."""
        colours = {
            material.get("name"): numbers(color, "rgba", GREY)
            for material in root.iter("material")
            if (color := material.find("color")) is not None
        }
        for link in root.findall("link"):
            name = text_of(link, "name")
            rows = []
            for element in link.findall("visual"):
                shape, problem = _read_shape(element, name)
                if shape is not None and shape.kind == "mesh":
                    file = self._find_mesh(shape)
                    problem = None if file else f"{shape.file!r} not found"
                    shape = shape._replace(file=str(file)) if file else None
                material = element.find("material")
                rgba = None
                if material is not None:
                    rgba = colours.get(material.get("name"))
                    if (color := material.find("color")) is not None:
                        rgba = numbers(color, "rgba", GREY)
                rows.append(Visual(shape, rgba, problem))
            # The first of links with one name.
            self.visuals.setdefault(name, tuple(rows))

    def read_joint(self, name: str, element: etree._Element) -> Joint:
        """Return a joint with its repairs."""
        parent, child = ends_of(element)
        kind = element.get("type", "").strip().lower()
        if kind not in (*MOVING_TYPES, "fixed"):
            text = f"joints of type {kind!r} are not simulated: fixed instead"
            remedy = "use revolute, continuous or prismatic joints"
            if kind == "floating":
                remedy = "load with fixed_base=False for a robot that is free to move"
            self.warn("joint", text, remedy, name)
            kind = "fixed"
        # The other elements mean nothing for a fixed joint, and their faults are none.
        if kind == "fixed":
            if element.find("mimic") is not None:
                self._report_mimic(name, element.find("mimic"), "cannot move a fixed joint")
            return Joint(name, "fixed", parent, child)
        fields = self._read_limits(name, kind, element)
        axis = numbers(element.find("axis"), "xyz", "1 0 0")
        if axis is None or math.hypot(*axis) < 1e-3:
            text = f"<axis xyz={text_of(element.find('axis'), 'xyz')!r}> has no direction: the x"
            text += " axis is used, the URDF's default"
            self.warn("joint", text, "correct the axis", name)
            axis = (1.0, 0.0, 0.0)
        dynamics = element.find("dynamics")
        for key in ("damping", "friction"):
            values = numbers(dynamics, key, "0")
            # A negative damping would add energy in every step.
            if values is None or values[0] < 0:
                text = (
                    f"<dynamics {key}={text_of(dynamics, key)!r}> must be a number >= 0: 0 is used"
                )
                self.warn("dynamics", text, "correct the URDF", name)
                values = (0.0,)
            fields[key] = values[0]
        fields["mimic"] = self._read_mimic(name, element.find("mimic"))
        return Joint(
            name,
            kind,
            parent,
            child,
            axis=axis,
            **fields,
        )

    def _read_limits(self, name: str, kind: str, joint: etree._Element) -> Document:
        """Return the limits of a joint by field; missing and placeholder limits are infinite."""
        limit = joint.find("limit")
        limits: Document = {}
        placeholders = []
        for key in ("effort", "velocity", "acceleration", "deceleration"):
            values = numbers(limit, key, "inf", limit=True)
            # Exporters write 0 or -1 for "not set".
            if values is None or values[0] <= 0:
                placeholders.append(f"{key}={text_of(limit, key)!r}")
                values = (math.inf,)
            limits[f"{key}_limit"] = values[0]
        if placeholders:
            text = f"<limit {' '.join(placeholders)}> is a placeholder or not within"
            text += f" +-{LARGEST_NUMBER:g}: no limit"
            self.warn("limits", text, "give <limit effort= velocity=> of the motor", name)
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
                text = f"<limit {key}={text_of(limit, key)!r}> is not a number within +-{LARGEST_NUMBER:g}:"
                text += f" no {key} limit"
                self.warn("limits", text, GIVE_RANGE, name)
                values = (endless,)
            ends.append(values[0])
        lower, upper = ends
        # The URDF's default of a missing end is 0, which may be on the wrong side. Exporters write
        # 0 for all four numbers of a joint whose limits they do not know.
        is_given = bool(text_of(limit, "lower") and text_of(limit, "upper"))
        is_placeholder = lower == upper == 0 and is_unknown
        if is_placeholder or (lower >= upper and not is_given):
            self.warn("limits", "no position limits: motion without end", GIVE_RANGE, name)
            lower, upper = -math.inf, math.inf
        elif lower > upper:
            detail = f"{lower:g}, {upper:g}"
            self.warn("limits", "limits are swapped", "swap them", name, detail=detail)
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
        return Mimic(text_of(mimic, "joint"), multiplier[0], offset[0])

    def repair_mimics(self, joints: dict[str, Joint], elements: dict[str, etree._Element]) -> None:
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
                self._report_mimic(name, elements[name].find("mimic"), problem)
                joints[name] = replace(joint, mimic=None)

    def _report_mimic(self, name: str, mimic: etree._Element, problem: str) -> None:
        text = f"mimics {mimic.get('joint')!r}, which {problem}: moves independently"
        self.warn("mimic", text, "correct <mimic joint=>, or remove it", name)

    def read_link(self, body: Body, link: etree._Element) -> Body:
        """Return ``body`` with the inertia of its link, and append the link's shapes."""
        for collision in link.findall("collision"):
            self._read_collision(body.name, collision)
        if (inertial := link.find("inertial")) is None:
            return body
        mass, inertia = map(inertial.find, ("mass", "inertia"))
        center, turn = ORIGIN, NO_TURN
        if problem := _misplaced(inertial):
            text = f"{problem}: the centre of mass is taken at the origin of the link"
            self.warn("inertia", text, "correct <inertial><origin>", link=body.name)
        else:
            center, turn = read_origin(inertial, "")
        value = numbers(mass, "value", "0")
        if value is None or value[0] < 0 or 0 < value[0] < SMALLEST:
            text = f"<mass value={text_of(mass, 'value')!r}> is no mass from {SMALLEST:g} to {LARGEST_NUMBER:g}"
            text += ": it counts as missing"
            self.warn("inertia", text, "give a mass > 0 [kg]", link=body.name)
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
            self.warn("inertia", text, "correct <inertia>", link=body.name)
        return with_mass(
            body,
            value[0],
            center,
            tensor,
            turn,
            self._findings,
        )

    def _read_collision(self, link: str, collision: etree._Element) -> None:
        """Append a collision shape, unless it has no size or its mesh is missing."""
        shape, problem = _read_shape(collision, link)
        if shape is None:
            text = f"a collision shape is left out: {problem}"
            self.warn("collision", text, "correct <collision>", link=link)
            return
        if shape.kind == "mesh":
            file = self._find_mesh(shape)
            if file is None:
                self._missing.append(shape.file)
                return
            content, problem = check_mesh(file)
            if problem is not None:
                self._missing.append(f"{shape.file} ({problem})")
                return
            shape = shape._replace(file=str(file), content=content)
        self.shapes.append(shape)

    def _find_mesh(self, shape: Shape) -> Path | None:
        return find_mesh(shape.file, self._path, self._package_dirs)

    def report_missing(self) -> None:
        """Report meshes that are missing or cannot be read."""
        if self._missing:
            text = "collision meshes not found or not readable, simulated without: "
            remedy = "repair the files, pass package_dirs=[...] with the folder that holds the"
            remedy += " package, or name it in ROS_PACKAGE_PATH"
            self.warn("missing-mesh", text + ", ".join(self._missing), remedy)


def _read_shape(element: etree._Element, link: str) -> tuple[Shape | None, str | None]:
    """Return the shape of a ``<collision>`` or ``<visual>`` of a link, or None and the problem."""
    problem = _misplaced(element)
    geometry = next((part for part in element.iterfind("geometry/*") if part.tag in SHAPES), None)
    if geometry is None:
        return None, f"it has none of {', '.join(SHAPES)}"
    rows = []
    for key, default in SHAPES[geometry.tag].items():
        text = text_of(geometry, key) or default
        if key == "scale" and len(text.split()) == 1:
            geometry.set(key, " ".join([text] * 3))  # one factor for all axes
        sizes = numbers(geometry, key, default) or (0.0,)
        # A negative scale mirrors the mesh.
        smallest = min(map(abs, sizes)) if key == "scale" else min(sizes)
        if smallest < SMALLEST_SIZE or max(sizes) > LARGEST_SIZE:
            problem = f"<{geometry.tag} {key}={text!r}> is not from {SMALLEST_SIZE:g} to"
            problem += f" {LARGEST_SIZE:g}"
        rows.append(sizes)
    if problem is not None:
        return None, problem
    kind = geometry.tag
    place = read_origin(element, "")
    if kind == "mesh":
        file = geometry.get("filename", "").strip()
        return Shape(
            link,
            link,
            kind,
            (),
            *place,
            file,
            rows[0],
        ), None
    size = rows[0]
    if kind == "box":
        size = tuple(0.5 * side for side in size)
    elif kind != "sphere":
        size = (size[0], 0.5 * rows[1][0])
    return Shape(link, link, kind, size, *place), None


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


def ends_of(joint: etree._Element) -> tuple[str, str]:
    """Return the names of the parent and the child link of a joint, "" where they are missing."""
    return text_of(joint.find("parent"), "link"), text_of(joint.find("child"), "link")


def text_of(element: etree._Element | None, key: str) -> str:
    """Return an attribute without blanks around it, "" without one."""
    return "" if element is None else element.get(key, "").strip()
