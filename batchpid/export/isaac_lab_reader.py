"""Params and motors from the actuator configurations of Isaac Lab, of :mod:`batchpid.export.isaac_lab` or by hand.

The text is parsed, and not executed: configurations are found anywhere in it, also within an ``ArticulationCfg``. Their
arguments may be numbers, names of numbers defined at the top of the text, and arithmetic of these.
"""

from __future__ import annotations

import ast
import contextlib
import math
import operator
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.checks.validate import names, positive
from batchpid.errors import InvalidArgumentError
from batchpid.export.exported import ImportedMotors
from batchpid.export.isaac_lab import CLASSES, NO_LIMIT
from batchpid.law.params import make_params
from batchpid.motors.actuators import make_actuators

_JOINT_SIDE = {"armature": "armature", "friction": "static", "dynamic_friction": "coulomb"}
_JOINT_SIDE |= {"viscous_friction": "viscous"}
_FIGURES = {*_JOINT_SIDE, "stiffness", "damping", "effort_limit", "effort_limit_sim", "velocity_limit"}
_FIGURES |= {"saturation_effort", "min_delay", "max_delay"}
_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_MOST_POWER = 4
_CONSTANTS = {"pi": math.pi, "inf": math.inf}
_MODULES = ("math", "np", "numpy", "torch")
"""Modules with these constants."""
_OTHERS = ("joint_names_expr", "class_type", "velocity_limit_sim")
"""Arguments that hold no figures, and are not differences either."""


def from_isaac_lab(text: str, joint_names: Sequence[str], *, dt: float | None = None) -> ImportedMotors:
    """Return the params and motors of the actuator configurations in a Python text.

    Parameters
    ----------
    text
        With calls of ImplicitActuatorCfg, IdealPDActuatorCfg, DCMotorCfg or DelayedPDActuatorCfg.
    joint_names
        Names of the joints, which the regular expressions of the configurations match.
    dt
        Physics step [s], for delays. None: delays are listed as a difference, and not read.

    Raises
    ------
    InvalidArgumentError
        Text that is not Python or holds no configuration, a value other than arithmetic of numbers, a gain that is left
        to the USD file, or a joint that no configuration or several match.
    """
    joints = names("joint_names", joint_names)
    if dt is not None:
        positive("dt", dt, "s")
    groups = _groups(text)
    of_joint: dict[str, tuple[str, dict[str, Any]]] = {}
    for joint in joints:
        matching = [group for group in groups if _matches(group[1].get("joint_names_expr"), joint)]
        if len(matching) != 1:
            problem = f"{'several' if matching else 'no'} actuators of the text match"
            raise InvalidArgumentError("text", problem, joint=joint, remedy="correct joint_names_expr")
        of_joint[joint] = matching[0]
    found = _Figures(of_joint)
    differences = [*found.differences(), *_changes(text)]
    params = make_params(
        len(joints),
        found.column("stiffness"),
        None,
        found.column("damping") if found.column("damping").any() else None,
        effort_limit=found.effort_limit(),
        measurement_rate="measured",
        joint_names=joints,
    )
    motors: dict[str, Any] = {ours: found.column(key, 0.0) for key, ours in _JOINT_SIDE.items()}
    static, coulomb = motors["static"], motors["coulomb"]
    dynamic = found.given("dynamic_friction")
    motors["coulomb"] = np.where(dynamic, coulomb, static)
    motors["static"] = np.where(static > motors["coulomb"], static, 0.0)
    motors |= found.line()
    steps = found.column("max_delay", 0.0)
    if dt is not None and steps.any():
        motors["command_delay"] = (found.column("min_delay", 0.0) + steps) / 2 * dt
        differences.append("command_delay: of the effort here, of the setpoint in Isaac Lab")
    elif steps.any():
        differences.append("command_delay: in steps of the physics, whose length is not known: not read")
    return ImportedMotors(params, joints, tuple(differences), make_actuators(len(joints), **motors, joint_names=joints))


class _Figures:
    """Figures of the joints, each from the configuration that matches it: the name of its class and its arguments."""

    def __init__(self, of_joint: dict[str, tuple[str, dict[str, Any]]]) -> None:
        self.of_joint = of_joint

    def given(self, key: str) -> NDArray[np.bool_]:
        """Return the mask (joints,) of joints with a value for an argument."""
        return np.array([self._figure(joint, key) is not None for joint in self.of_joint])

    def column(self, key: str, off: float | None = None) -> NDArray[np.float64]:
        """Return the values (joints,) of an argument, ``off`` where it is missing; without ``off`` it is needed.

        With an infinite ``off`` it is a limit.
        """
        column, limits = [], off == math.inf
        for joint, (_, arguments) in self.of_joint.items():
            value = self._figure(joint, key)
            if value is None and limits and isinstance(arguments.get(key), dict):
                problem, remedy = f"{key} has no key for it, hence 0 in Isaac Lab", f"add one; {NO_LIMIT:g} is no limit"
                raise InvalidArgumentError("text", problem, joint=joint, remedy=remedy)
            if value is None and off is None:
                remedy = "write the number: without one, Isaac Lab takes it from the USD file"
                raise InvalidArgumentError("text", f"gives no {key}", joint=joint, remedy=remedy)
            if value is not None and not isinstance(value, int | float):
                raise InvalidArgumentError(
                    "text", f"{key} is not a number", joint=joint, value=value, remedy="give one"
                )
            column.append(off if value is None or (limits and value >= NO_LIMIT) else float(value))
        return np.array(column, np.float64)

    def _figure(self, joint: str, key: str) -> Any:
        value = self.of_joint[joint][1].get(key)
        if not isinstance(value, dict):
            return value
        matching = [figure for pattern, figure in value.items() if _matches([pattern], joint)]
        if len(matching) > 1:
            raise InvalidArgumentError("text", f"several keys of {key} match", joint=joint, remedy="leave one")
        return matching[0] if matching else None

    def effort_limit(self) -> NDArray[np.float64]:
        """Return the limits (joints,): of the simulator's drive for implicit actuators, else of the effort computed."""
        plain, drive = self.column("effort_limit", math.inf), self.column("effort_limit_sim", math.inf)
        implicit = np.array([cls == CLASSES["implicit"] for cls, _ in self.of_joint.values()])
        return np.where(implicit, np.minimum(plain, drive), plain)

    def line(self) -> dict[str, Any]:
        """Return the torque-speed lines and the motors' effort limits, where there are any."""
        is_motor = np.array([cls == CLASSES["dc_motor"] for cls, _ in self.of_joint.values()])
        if not is_motor.any():
            return {}
        keys = {
            "saturation_effort": "saturation_effort",
            "no_load_speed": "velocity_limit",
            "effort_limit": "effort_limit",
        }
        return {ours: np.where(is_motor, self.column(key, math.inf), math.inf) for ours, key in keys.items()}

    def differences(self) -> list[str]:
        """Return the differences of the law from the configurations."""
        found = []
        configurations = {id(arguments): arguments for _, arguments in self.of_joint.values()}.values()
        for arguments in configurations:
            found += [f"{key}: not read" for key in arguments if key not in _FIGURES and key not in _OTHERS]
            keys = [(key, pattern) for key, value in arguments.items() if isinstance(value, dict) for pattern in value]
            unused = [each for each in keys if not any(_matches([each[1]], joint) for joint in self.of_joint)]
            found += [f"{key}: no joint matches {pattern!r}" for key, pattern in unused]
        classes = {cls for cls, _ in self.of_joint.values()}
        if CLASSES["implicit"] in classes:
            found.append("law: stiffness and damping act implicitly in Isaac Lab, which damps more")
        if (self.column("min_delay", 0.0) != self.column("max_delay", 0.0)).any():
            found.append("command_delay: drawn from min_delay to max_delay at each reset there; here the middle")
        for key in ("velocity_limit", "velocity_limit_sim"):
            rows = [joint for joint, (cls, _) in self.of_joint.items() if cls != CLASSES["dc_motor"]]
            if any(self._figure(joint, key) is not None for joint in rows):
                found.append(f"{key}: a limit of the simulated speed, which is not read")
        return found


def _groups(text: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the class and the arguments of each configuration."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InvalidArgumentError("text", f"is not Python: {error}", remedy="give the text of a .py file") from None
    known: dict[str, Any] = {}
    groups: list[tuple[str, dict[str, Any]]] = []
    for statement in tree.body:
        calls = [node for node in ast.walk(statement) if isinstance(node, ast.Call)]
        of_actuators = [call for call in calls if any(each.arg == "joint_names_expr" for each in call.keywords)]
        given: dict[str, Any] = {}
        evaluated: ast.AST = statement
        if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            evaluated = statement.value  # before the targets are bound
            with contextlib.suppress(InvalidArgumentError):  # no number, such as the robot's configuration
                value = _value(statement.value, known)
                given = {target.id: value for target in targets if isinstance(target, ast.Name)}
        bound, inside = _bound(statement), _bound(evaluated)
        groups += [
            _group(call, {name: each for name, each in known.items() if name not in inside}) for call in of_actuators
        ]
        read = {id(node) for call in of_actuators for node in ast.walk(call)}
        loaded = {node.id for node in ast.walk(statement) if isinstance(node, ast.Name) and id(node) not in read}
        known = {
            name: each
            for name, each in known.items()
            if name not in bound and not (name in loaded and isinstance(each, list | dict)) and "*" not in bound
        } | given
    if not groups:
        raise InvalidArgumentError("text", "holds no actuators of Isaac Lab", remedy="give ImplicitActuatorCfg(...)")
    return groups


def _bound(tree: Any) -> set[str]:
    """Return the names that a syntax tree binds: variables, parameters, functions, classes and imports."""
    found = set()
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store() | ast.Del()) | ast.arg(arg=name):
                found.add(name)
            case ast.alias(name=name, asname=other):
                found.add(other or name.partition(".")[0])
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                found.add(name)
            case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)):
                found.add(name)
            case ast.MatchMapping(rest=str(name)):
                found.add(name)
    return found


def _changes(text: str) -> list[str]:
    """Return the statements that change a configuration after its call."""
    found = []
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.Call(func=ast.Attribute(attr="replace"), keywords=words) if {
                each.arg for each in words
            } & _FIGURES:
                found.append(f"line {node.lineno}: not read: {ast.unparse(node)}")
            case ast.Call(func=ast.Name(id="setattr"), args=[_, ast.Constant(value=str(name)), _]) if name in _FIGURES:
                found.append(f"line {node.lineno}: not read: {ast.unparse(node)}")
        if isinstance(node, ast.Assign | ast.AugAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(target, ast.Attribute) and target.attr in _FIGURES:
                found.append(f"line {node.lineno}: not read: {ast.unparse(node)}")
    return found


def _group(node: ast.Call, known: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the class and the arguments of a configuration."""
    cls, where = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", ""), node.lineno
    if cls not in CLASSES.values():
        problem, remedy = f"has the actuator {cls}", f"the classes known are {', '.join(CLASSES.values())}"
        raise InvalidArgumentError("text", problem, value=f"line {where}", remedy=remedy)
    if any(each.arg is None for each in node.keywords):
        problem, remedy = "has arguments that are unpacked from a dict (**)", "write them out"
        raise InvalidArgumentError("text", problem, value=f"line {where}", remedy=remedy)
    return cls, {each.arg: _value(each.value, known) for each in node.keywords if each.arg}


def _value(node: ast.expr, known: dict[str, Any]) -> Any:
    """Return the value of an expression of numbers, strings, lists and dicts."""
    match node:
        case ast.Constant(value=value) if value is None or isinstance(value, int | float | str):
            return value
        case ast.Name(id=name) if name in known:
            return known[name]
        case ast.Attribute(value=ast.Name(id=module), attr=name) if name in _CONSTANTS and module in _MODULES:
            return _CONSTANTS[name]
        case ast.List(elts=entries) | ast.Tuple(elts=entries):
            return [_value(entry, known) for entry in entries]
        case ast.Dict(keys=keys, values=entries) if all(keys):
            pairs = zip(keys, entries, strict=True)
            return {str(_value(key, known)): _value(entry, known) for key, entry in pairs if key is not None}
        case ast.UnaryOp(op=ast.USub(), operand=operand) if _is_number(inner := _value(operand, known)):
            return -inner
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            a, b = _value(left, known), _value(right, known)
            small = not isinstance(op, ast.Pow) or (_is_number(b) and abs(b) <= _MOST_POWER)
            if _is_number(a) and _is_number(b) and small and not (isinstance(op, ast.Div) and b == 0):
                return _OPERATORS[type(op)](float(a), float(b))
    problem, where = f"{ast.unparse(node)[:60]} is not a number", f"line {node.lineno}"
    raise InvalidArgumentError("text", problem, value=where, remedy="write the number")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def _matches(patterns: Any, joint: str) -> bool:
    """Return whether one of the regular expressions matches the whole name, as Isaac Lab requires."""
    try:
        return any(re.fullmatch(each, joint) for each in ([patterns] if isinstance(patterns, str) else patterns or ()))
    except (re.error, TypeError) as error:
        remedy = "give a list of regular expressions"
        raise InvalidArgumentError("text", f"a name is not a regular expression: {error}", remedy=remedy) from None
