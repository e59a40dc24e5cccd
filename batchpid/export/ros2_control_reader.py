"""Params from the controllers of a ros2_control file, of :mod:`batchpid.export.ros2_control` or by hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import choice, names
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Imported
from batchpid.export.ros2_control import LEAVES, NEUTRAL, STRATEGIES
from batchpid.io import documents
from batchpid.law.params import PIDParams, make_params

_KNOWN: Document = {
    **NEUTRAL,
    "ff_velocity_scale": 0.0,
    "feedforward_gain": 0.0,
    "angle_wraparound": False,
    "save_i_term": True,
    "activate_state_publisher": False,
}
"""Gains of both controllers, with their defaults."""
_ANTI_WINDUP = {theirs: ours for ours, theirs in STRATEGIES.items()}


def from_ros2_control(
    text: str,
    joint_names: Sequence[str] | None = None,
    *,
    controller: str | None = None,
    continuous: ArrayLike | None = None,
) -> Imported:
    """Return the params of a ros2_control file: its PIDs on effort, of all controllers together.

    Parameters
    ----------
    text
        YAML of controllers with ``gains``.
    joint_names
        Order of the joints. Default: the file's order.
    controller
        Name of the controller to read. Default: all that have gains, of different joints.
    continuous
        Bools: joints of type continuous, of which the trajectory controller knows from the robot's description.

    Raises
    ------
    InvalidArgumentError
        Text without controllers, a key or strategy unknown to control_toolbox 6, or gains of another interface than
        effort.
    """
    document = documents.parse("text", text, "yaml")
    found = {name: body for name, body in _controllers(document, "") if controller in (None, name)}
    if not found:
        remedy = "give the YAML of a controller with gains" if controller is None else "check the controller's name"
        raise InvalidArgumentError("text", "holds no controller with gains", value=controller, remedy=remedy)
    joints: dict[str, Document] = {}
    inputs: dict[str, bool] = {}
    for name, body in found.items():
        for joint, gains in _joints(name, body).items():
            if joint in joints:
                remedy = f"choose one of {', '.join(found)}: controller=NAME"
                raise InvalidArgumentError("text", "several controllers have gains", joint=joint, remedy=remedy)
            joints[joint] = gains
        inputs[name] = "joints" in body or len(body["reference_and_state_interfaces"]) == 2
    if len(set(inputs.values())) > 1:
        remedy = "choose one: controller=NAME"
        raise InvalidArgumentError(
            "text", "some controllers read velocities, others do not", value=inputs, remedy=remedy
        )
    order = list(joints) if joint_names is None else names("joint_names", joint_names)
    if missing := sorted(set(order) - set(joints)):
        problem = f"has no gains of these joints: {', '.join(missing)}"
        raise InvalidArgumentError("text", problem, remedy=f"the file's joints are {', '.join(joints)}")
    rows = [joints[joint] for joint in order]
    columns = {key: np.array([row[key] for row in rows]) for key in (*NEUTRAL, "feedforward", "angle_wraparound")}
    differences = _differences(columns, order)
    return Imported(_params(columns, order, inputs.popitem()[1], continuous), order, differences)


def is_ros2_control(document: Any) -> bool:
    """Return whether a YAML document holds controllers with gains."""
    return any(True for _ in _controllers(document, ""))


def _controllers(document: Any, name: str) -> Iterator[tuple[str, Document]]:
    """Yield the controllers with gains below ``document``, which may be in namespaces."""
    if not isinstance(document, dict):
        return
    body = document.get("ros__parameters")
    if isinstance(body, dict) and isinstance(body.get("gains"), dict):
        yield name, body
    for key, inner in document.items():
        if isinstance(key, str) and key != "ros__parameters":
            yield from _controllers(inner, key)


def _joints(name: str, body: Document) -> dict[str, Document]:
    """Return the checked gains of each joint of a controller."""
    trajectory = "joints" in body
    joints = names(f"{name}.{'joints' if trajectory else 'dof_names'}", body.get("joints", body.get("dof_names")))
    if (driven := body.get("command_joints") or joints) != joints:
        remedy = "the law needs gains from a joint's position to its own effort"
        raise InvalidArgumentError(f"{name}.command_joints", "are not its joints", value=driven, remedy=remedy)
    commands = body.get("command_interfaces", ["effort"]) if trajectory else [body.get("command_interface", "effort")]
    if commands != ["effort"]:
        remedy = "the law needs gains from positions to efforts"
        raise InvalidArgumentError(f"{name}: command interface", "is not effort", value=commands, remedy=remedy)
    states = body.get("reference_and_state_interfaces")
    if not trajectory and states not in (["position"], ["position", "velocity"]):
        where, remedy = f"{name}: reference_and_state_interfaces", "use position, or position and velocity"
        raise InvalidArgumentError(where, "are not those of a position", value=states, remedy=remedy)
    two = trajectory or len(states or ()) == 2
    return {joint: _gains(name, joint, body["gains"].get(joint), two) for joint in joints}


def _gains(name: str, joint: str, gains: Any, two: bool) -> Document:
    where = f"{name}.gains"
    if not isinstance(gains, dict):
        raise InvalidArgumentError(where, "has no gains", joint=joint, remedy="give 'JOINT: {p: 1.0}'")
    for key, value in gains.items():
        if key not in _KNOWN:
            problem, remedy = f"{key} is unknown to control_toolbox 6", f"use one of {', '.join(_KNOWN)}"
            raise InvalidArgumentError(where, problem, joint=joint, remedy=remedy)
        kind = type(_KNOWN[key])
        if not (documents.is_number(value) if kind is float else isinstance(value, kind)):
            problem, remedy = f"{key} is not a {kind.__name__}", f"give a value as in '{key}: {_KNOWN[key]}'"
            raise InvalidArgumentError(where, problem, joint=joint, value=value, remedy=remedy)
    own = {**_KNOWN, **gains}
    choice(f"{where}.{joint}.antiwindup_strategy", own["antiwindup_strategy"], _ANTI_WINDUP)
    own["feedforward"] = float(own["ff_velocity_scale"]) + float(own["feedforward_gain"])
    if own["feedforward"] and not (two and own["d"]):
        what = "of the desired velocity is not weighted by d" if two else "of the desired position"
        remedy = "leave it out, and give the effort as feedforward"
        raise InvalidArgumentError(where, f"a feedforward {what}", joint=joint, value=own["feedforward"], remedy=remedy)
    return own


def _params(columns: Document, order: list[str], two: bool, continuous: ArrayLike | None) -> PIDParams:
    d, i, p = (columns[key].astype(float) for key in ("d", "i", "p"))
    strategy = [_ANTI_WINDUP[each] for each in columns["antiwindup_strategy"]]
    # Back-calculation has no effect without i; make_params would let it move the integral.
    strategy = ["none" if s == "back_calculation" and not g else s for s, g in zip(strategy, i, strict=True)]
    options: Document = {leaf: columns[key].astype(float) for key, leaf in LEAVES.items()}
    options["anti_windup"] = strategy
    if "back_calculation" in strategy:
        given, safe = columns["tracking_time_constant"].astype(float), np.where(i > 0, i, 1.0)
        rule = np.where(d > 0, np.sqrt(np.maximum(d, 0.0) / safe), p / safe)
        options["tracking_time"] = np.where(given > 0, given, rule)
    for key in ("ki", "kd"):
        if not options[key].any():
            del options[key]
    if two:
        options["measurement_rate"] = "measured"
        if columns["feedforward"].any():
            options["setpoint_weight_derivative"] = 1.0 + columns["feedforward"] / np.where(d > 0, d, 1.0)
    else:
        options["setpoint_weight_derivative"] = 1.0
    wraps = columns["angle_wraparound"] if continuous is None else np.asarray(continuous)
    if wraps.any():
        options["continuous"] = wraps
    return make_params(len(order), **options, joint_names=order)


def _differences(columns: Document, order: list[str]) -> tuple[str, ...]:
    """Return the differences of the params from the file."""
    zone = columns["error_deadband"].astype(float)
    zone = columns["error_deadband"] = np.where(zone <= np.finfo(float).eps, 0.0, zone)  # a default of control_toolbox
    found = []
    if (on := zone > 0).any():
        joints = ", ".join(f"{joint} {each:g}" for joint, each in zip(order, zone, strict=True) if each)
        effort = (columns["p"].astype(float) * zone)[on].max()
        found.append(f"deadband: P acts on the error beyond it too, up to {effort:.3g} N m or N less: {joints}")
    limits = columns["u_clamp_max"].astype(float), -columns["u_clamp_min"].astype(float)
    if any(np.isfinite(each).any() for each in limits):
        found.append("effort_limit: limits the sum with a feedforward, where u_clamp limits the PID alone")
    conditional = columns["antiwindup_strategy"] == STRATEGIES["conditional"]
    if any((conditional & (each <= 0)).any() for each in limits):
        found.append("anti_windup: conditional integration follows the excess of the effort, not its sign")
    return tuple(found)
