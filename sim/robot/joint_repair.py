"""Repair of a URDF's joints: types, axes, limits, friction and damping, mimics."""

from __future__ import annotations

import math
from collections.abc import Iterator

from lxml import etree

from batchpid.sim.robot.findings import Finding, finding_of
from batchpid.sim.robot.parts import MOVING_TYPES
from batchpid.sim.robot.xml import numbers, readable
from batchpid.task_space.frames import from_rpy

FREE_TYPES = ("floating", "planar")
"""Types of a joint at the root that make a floating base."""
GIVE_RANGE = "give <limit lower= upper=>"
"""Remedy for position limits that are missing or unreadable."""


def repair(joint: etree._Element, root: etree._Element) -> Iterator[Finding]:
    """Repair a joint of the robot ``root``, except its mimic."""
    yield from _type(joint, root)
    if joint.get("type") == "fixed":
        for tag in ("axis", "limit", "dynamics"):
            if (element := joint.find(tag)) is not None:
                joint.remove(element)
        return
    yield from _axis(joint)
    yield from _limits(joint)
    yield from _soft_limits(joint)
    yield from _dynamics(joint)


def ends_of(joint: etree._Element) -> tuple[str | None, str | None]:
    """Return the names of the parent and the child link of a joint, None where they are not
    given.
    """
    parent, child = (
        None if end is None else end.get("link") for end in map(joint.find, ("parent", "child"))
    )
    return parent, child


def free_joint_of(root: etree._Element) -> etree._Element | None:
    """Return the floating or planar joint that leads from a link without mass and shapes at the
    root to all others.

    None without one. Such a joint and link say that the base is free to move.
    """
    joints = root.findall("joint")
    children = {ends_of(joint)[1] for joint in joints}
    at_root = [joint for joint in joints if ends_of(joint)[0] not in children]
    link = next(
        (
            link
            for link in root.findall("link")
            if at_root and link.get("name") == ends_of(at_root[0])[0]
        ),
        None,
    )
    if len(at_root) != 1 or at_root[0].get("type") not in FREE_TYPES or link is None:
        return None
    if link.find("inertial") is not None or link.find("collision") is not None:
        return None
    return at_root[0]


def free_base(
    root: etree._Element, joint: etree._Element, findings: list[Finding]
) -> tuple[float, ...] | None:
    """Remove the joint of :func:`free_joint_of`, and the link at the root, from the robot.

    Return the pose (7,) at which the joint places the base, None without one.
    """
    if joint.get("type") == "planar":
        text = "the base is free to move in all six directions"
        remedy = "expect it to leave its plane"
        findings.append(finding_of(joint, "note", "joint-type", text, remedy))
    parent = ends_of(joint)[0]
    origin = joint.find("origin")
    for element in (joint, *(link for link in root.findall("link") if link.get("name") == parent)):
        root.remove(element)
    if origin is None:
        return None
    name = f"joint {joint.get('name')!r}"
    return (
        *numbers(origin, "xyz", "0 0 0", name),
        *from_rpy(numbers(origin, "rpy", "0 0 0", name)).tolist(),
    )


def _type(joint: etree._Element, root: etree._Element) -> Iterator[Finding]:
    """Fix joints of types that SAPIEN lacks."""
    kind = joint.get("type", "")
    if kind.lower() in (*MOVING_TYPES, "fixed"):
        joint.set("type", kind.lower())
        return
    joint.set("type", "fixed")
    parent = ends_of(joint)[0]
    at_root = kind in FREE_TYPES and all(
        ends_of(other)[1] != parent for other in root.findall("joint")
    )
    severity = "warning"
    remedy = "use revolute, continuous or prismatic joints"
    if at_root:
        severity = "note"
        remedy = "load with fixed_base=False for a robot that is free to move"
    text = f"joints of type {kind!r} cannot be simulated by SAPIEN: fixed instead"
    yield finding_of(joint, severity, "joint-type", text, remedy)


def _axis(joint: etree._Element) -> Iterator[Finding]:
    """Replace an axis without direction by the URDF's default, x."""
    axis = joint.find("axis")
    if axis is None:
        return
    if axis.get("xyz") is None:
        joint.remove(axis)  # the default of the URDF, on which SAPIEN fails
        return
    direction = readable(axis, "xyz", "1 0 0")
    if direction is None:
        length = 0.0
    else:
        length = math.hypot(*direction)
    if direction is None or length < 1e-12:
        text = (
            f"<axis xyz={axis.get('xyz')!r}> has no direction: the x axis is used, the URDF's"
            " default"
        )
        yield finding_of(joint, "warning", "axis", text, "correct the axis")
        joint.remove(axis)
    elif length < 1e-3:  # SAPIEN's bound, below which it takes another axis
        axis.set("xyz", " ".join(repr(part / length) for part in direction))


def _limits(joint: etree._Element) -> Iterator[Finding]:
    """Repair the limits: missing and placeholder limits become infinite."""
    limit = joint.find("limit")
    kind = joint.get("type")
    if limit is None:
        limit = etree.SubElement(joint, "limit")
    placeholders = []
    for key in ("effort", "velocity"):
        values = readable(limit, key, "inf", limit=True)
        if values is not None and values[0] > 0:
            continue
        text = limit.attrib.pop(key)
        if values is None:
            problem = f"<limit {key}={text!r}> is not a number: no {key} limit"
            yield finding_of(
                joint, "warning", "limits", problem, f"give <limit {key}=> of the motor"
            )
        elif values[0] < 0 and values[0] != -1:  # exporters write -1 for "not set"
            limit.set(key, repr(-values[0]))
            problem = f"{key} limit is negative: its magnitude is used"
            yield finding_of(joint, "warning", "limits", problem, "make it positive", text)
        else:
            placeholders.append(f"{key}={text!r}")
    if placeholders:
        problem = f"<limit {' '.join(placeholders)}> is a placeholder and counts as not given"
        yield finding_of(
            joint, "warning", "placeholder", problem, "give <limit effort= velocity=> of the motor"
        )
    if kind in ("revolute", "prismatic"):
        yield from _range(joint, limit)


def _range(joint: etree._Element, limit: etree._Element) -> Iterator[Finding]:
    """Repair the position limits of a revolute or prismatic joint, and write them out."""
    given = {key: limit.get(key) for key in ("lower", "upper")}
    low, high = (readable(limit, key, "0", limit=True) for key in given)
    for key, values in zip(given, (low, high), strict=True):
        if values is None:
            text = f"<limit {key}={given[key]!r}> is not a number: no {key} limit"
            yield finding_of(joint, "warning", "limits", text, GIVE_RANGE)
    lower = -math.inf if low is None else low[0]
    upper = math.inf if high is None else high[0]
    efforts = [limit.get(key) for key in ("effort", "velocity")]
    if lower == upper == 0 and (None in given.values() or efforts == [None, None]):
        if None in given.values():
            text = "no position limits"
        else:
            text = "position limits of 0, placeholders"
        yield finding_of(joint, "warning", "limits", f"{text}: motion without end", GIVE_RANGE)
        lower, upper = -math.inf, math.inf
    elif lower > upper and None in given.values():
        missing = "lower" if given["lower"] is None else "upper"
        yield finding_of(
            joint, "warning", "limits", f"no {missing} limit: no end there", GIVE_RANGE
        )
        if missing == "lower":
            lower, upper = (-math.inf, upper)
        else:
            lower, upper = (lower, math.inf)
    elif lower > upper:
        yield finding_of(
            joint, "warning", "limits", "limits are swapped", "swap them", f"{lower:g}, {upper:g}"
        )
        lower, upper = upper, lower
    limit.set("lower", repr(lower))
    limit.set("upper", repr(upper))


def _soft_limits(joint: etree._Element) -> Iterator[Finding]:
    """Report soft limits without a range, which have no effect."""
    safety = joint.find("safety_controller")
    low, high = (readable(safety, f"soft_{key}_limit", "0") for key in ("lower", "upper"))
    if (
        safety is not None
        and low is not None
        and high is not None
        and low >= high
        and (low, high) != ((0,), (0,))
    ):
        text = "soft limits without a range have no effect"
        yield finding_of(
            joint,
            "warning",
            "limits",
            text,
            "correct <safety_controller>",
            f"{low[0]:g}, {high[0]:g}",
        )


def _dynamics(joint: etree._Element) -> Iterator[Finding]:
    """Set invalid friction and damping to zero."""
    dynamics = joint.find("dynamics")
    for key in ("damping", "friction") if dynamics is not None else ():
        values = readable(dynamics, key, "0")
        if values is None or values[0] < 0:
            text = f"<dynamics {key}={dynamics.get(key)!r}> must be a number >= 0: 0 is used"
            yield finding_of(joint, "warning", "dynamics", text, "correct the URDF")
            dynamics.set(key, "0")


def mimics(root: etree._Element) -> Iterator[Finding]:
    """Remove mimics of joints that cannot lead."""
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    sound: set[str | None] = set()  # joints whose chain of leaders ends
    for name, joint in joints.items():
        if (problem := _mimic_problem(joint, joints)) is not None:
            yield _independent(joint, problem)
            continue
        chain = {name}
        each = _leader(joint)
        while each in joints and each not in sound and each not in chain:
            chain.add(each)
            each = _leader(joints[each])
        if each in chain:
            yield _independent(
                joints[each], "mimics it in turn" if len(chain) > 1 else "is this joint itself"
            )
        sound |= chain


def _leader(joint: etree._Element) -> str | None:
    mimic = joint.find("mimic")
    if mimic is None:
        return None
    return mimic.get("joint")


def _mimic_problem(joint: etree._Element, joints: dict[str | None, etree._Element]) -> str | None:
    """Return the reason for which the leader of a joint cannot lead it, or None."""
    if (mimic := joint.find("mimic")) is None:
        return None
    if joint.get("type") == "fixed":
        return "cannot be followed by a fixed joint"
    leader = joints.get(mimic.get("joint"))
    if leader is None:
        return "is not in the file"
    if leader.get("type") == "fixed":
        return "does not move"
    multiplier = readable(mimic, "multiplier", "1")
    offset = readable(mimic, "offset", "0")
    if multiplier in (None, (0.0,)) or offset is None:
        return (
            f"with multiplier {mimic.get('multiplier')!r}, offset {mimic.get('offset')!r} cannot"
            " lead it"
        )
    return None


def _independent(joint: etree._Element, problem: str) -> Finding:
    """Remove the mimic of a joint and return the finding of it."""
    mimic = joint.find("mimic")
    joint.remove(mimic)
    if joint.get("type") == "fixed":
        text = f"a fixed joint does not mimic {mimic.get('joint')!r}"
        return finding_of(joint, "note", "mimic", text, "remove <mimic>")
    text = f"mimics {mimic.get('joint')!r}, which {problem}: moves independently"
    return finding_of(joint, "warning", "mimic", text, "correct <mimic joint=>, or remove it")
