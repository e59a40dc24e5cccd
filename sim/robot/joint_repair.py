"""Repair of a URDF's joints: types, axes, limits, friction and damping, mimics."""

from __future__ import annotations

import math
from collections.abc import Iterator

from lxml import etree

from batchpid.sim.robot.findings import Finding, finding_of
from batchpid.sim.robot.parts import MOVING_TYPES
from batchpid.sim.robot.xml import numbers, readable
from batchpid.task_space.frames import from_rpy

GIVE_RANGE = "give <limit lower= upper=>"
"""Remedy for position limits that are missing or unreadable."""


def repair(joint: etree._Element) -> Iterator[Finding]:
    """Repair a joint, except its mimic."""
    yield from _type(joint)
    # They mean nothing for a fixed joint, and their faults are none.
    if joint.get("type") == "fixed":
        for tag in ("axis", "limit", "dynamics"):
            if (element := joint.find(tag)) is not None:
                joint.remove(element)
        return
    yield from _axis(joint)
    yield from _limits(joint)
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
    """Return the floating joint that leads from a link without mass and shapes at the root to all
    others.

    None without one. Such a joint and link say that the base is free to move.
    """
    joints = root.findall("joint")
    children = {ends_of(joint)[1] for joint in joints}
    at_root = [joint for joint in joints if ends_of(joint)[0] not in children]
    # With a second joint at the root, the link there is a part of the robot.
    if len(at_root) != 1 or at_root[0].get("type") != "floating":
        return None
    for link in root.findall("link"):
        if link.get("name") == ends_of(at_root[0])[0]:
            is_bare = link.find("inertial") is None and link.find("collision") is None
            return at_root[0] if is_bare else None
    return None


def free_base(root: etree._Element, joint: etree._Element) -> tuple[float, ...] | None:
    """Remove the joint of :func:`free_joint_of`, and the link at the root, from the robot.

    Return the pose (7,) at which the joint places the base, None without one.
    """
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


def _type(joint: etree._Element) -> Iterator[Finding]:
    """Fix joints of types that SAPIEN lacks."""
    kind = joint.get("type", "")
    if kind.lower() in (*MOVING_TYPES, "fixed"):
        joint.set("type", kind.lower())
        return
    joint.set("type", "fixed")
    text = f"joints of type {kind!r} cannot be simulated by SAPIEN: fixed instead"
    remedy = "use revolute, continuous or prismatic joints"
    if kind == "floating":
        remedy = "load with fixed_base=False for a robot that is free to move"
    yield finding_of(joint, "warning", "joint-type", text, remedy)


def _axis(joint: etree._Element) -> Iterator[Finding]:
    """Replace an axis without direction by the URDF's default, x."""
    axis = joint.find("axis")
    if axis is None:
        return
    if axis.get("xyz") is None:
        joint.remove(axis)  # the default of the URDF, on which SAPIEN fails
        return
    direction = readable(axis, "xyz", "1 0 0")
    # SAPIEN takes another axis below this length.
    if direction is None or math.hypot(*direction) < 1e-3:
        text = (
            f"<axis xyz={axis.get('xyz')!r}> has no direction: the x axis is used, the URDF's"
            " default"
        )
        yield finding_of(joint, "warning", "axis", text, "correct the axis")
        joint.remove(axis)


def _limits(joint: etree._Element) -> Iterator[Finding]:
    """Repair the limits: missing and placeholder limits become infinite."""
    limit = joint.find("limit")
    if limit is None:
        limit = etree.SubElement(joint, "limit")
    placeholders = []
    for key in ("effort", "velocity"):
        values = readable(limit, key, "inf", limit=True)
        # Exporters write 0 or -1 for "not set".
        if values is None or values[0] <= 0:
            placeholders.append(f"{key}={limit.attrib.pop(key)!r}")
    if placeholders:
        text = f"<limit {' '.join(placeholders)}> is a placeholder and counts as not given"
        remedy = "give <limit effort= velocity=> of the motor"
        yield finding_of(joint, "warning", "placeholder", text, remedy)
    if joint.get("type") in ("revolute", "prismatic"):
        yield from _range(joint, limit)


def _range(joint: etree._Element, limit: etree._Element) -> Iterator[Finding]:
    """Repair the position limits of a revolute or prismatic joint, and write them out."""
    ends = []
    for key, endless in (("lower", -math.inf), ("upper", math.inf)):
        values = readable(limit, key, "0", limit=True)
        if values is None:
            text = f"<limit {key}={limit.get(key)!r}> is not a number: no {key} limit"
            yield finding_of(joint, "warning", "limits", text, GIVE_RANGE)
        ends.append(endless if values is None else values[0])
    lower, upper = ends
    # The URDF's default of a missing end is 0, which may be on the wrong side.
    is_given = limit.get("lower") is not None and limit.get("upper") is not None
    # Exporters write 0 for all four numbers of a joint whose limits they do not know.
    is_placeholder = lower == upper == 0 and not {"effort", "velocity"} & set(limit.attrib)
    if is_placeholder or (lower >= upper and not is_given):
        text = "no position limits: motion without end"
        yield finding_of(joint, "warning", "limits", text, GIVE_RANGE)
        lower, upper = -math.inf, math.inf
    elif lower > upper:
        detail = f"{lower:g}, {upper:g}"
        yield finding_of(joint, "warning", "limits", "limits are swapped", "swap them", detail)
        lower, upper = upper, lower
    limit.set("lower", repr(lower))
    limit.set("upper", repr(upper))


def _dynamics(joint: etree._Element) -> Iterator[Finding]:
    """Set invalid friction and damping to zero."""
    dynamics = joint.find("dynamics")
    for key in ("damping", "friction") if dynamics is not None else ():
        values = readable(dynamics, key, "0")
        # A negative damping would add energy in every step.
        if values is None or values[0] < 0:
            text = f"<dynamics {key}={dynamics.get(key)!r}> must be a number >= 0: 0 is used"
            yield finding_of(joint, "warning", "dynamics", text, "correct the URDF")
            dynamics.set(key, "0")


def mimics(root: etree._Element) -> Iterator[Finding]:
    """Remove mimics of joints that cannot lead."""
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    sound: set[str | None] = set()  # joints whose chain of leaders ends
    for name, joint in joints.items():
        problem = _mimic_problem(joint, joints)
        if problem is not None:
            yield _independent(joint, problem)
            continue
        # A chain of leaders that comes back to a joint in it is cut there.
        chain = {name}
        leader = _leader(joint)
        while leader in joints and leader not in sound | chain:
            chain.add(leader)
            leader = _leader(joints[leader])
        if leader in chain:
            yield _independent(joints[leader], "mimics it in turn")
        sound |= chain


def _leader(joint: etree._Element) -> str | None:
    mimic = joint.find("mimic")
    if mimic is None:
        return None
    return mimic.get("joint")


def _mimic_problem(joint: etree._Element, joints: dict[str | None, etree._Element]) -> str | None:
    """Return the reason for which the leader of a joint cannot lead it, or None."""
    mimic = joint.find("mimic")
    if mimic is None:
        return None
    if joint.get("type") == "fixed":
        return "cannot move a fixed joint"
    leader = joints.get(mimic.get("joint"))
    if leader is None:
        return "is not in the file"
    if leader.get("type") == "fixed":
        return "does not move"
    multiplier, offset = (mimic.get(key) for key in ("multiplier", "offset"))
    if readable(mimic, "multiplier", "1") in (None, (0.0,)) or not readable(mimic, "offset", "0"):
        return f"with multiplier {multiplier!r}, offset {offset!r} cannot lead it"
    return None


def _independent(joint: etree._Element, problem: str) -> Finding:
    """Remove the mimic of a joint and return the finding of it."""
    mimic = joint.find("mimic")
    joint.remove(mimic)
    text = f"mimics {mimic.get('joint')!r}, which {problem}: moves independently"
    return finding_of(joint, "warning", "mimic", text, "correct <mimic joint=>, or remove it")
