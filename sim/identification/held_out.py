"""Errors of motors on the held-out part of logs: of ideal motors, and of the motors in an actuators file."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.motors.actuators import FIELDS
from batchpid.sim.identification.fit_search import hypotheses, variants
from batchpid.sim.identification.inputs import read_inputs
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import smooth
from batchpid.sim.identification.unknowns import ADDED, DESCRIBED, KINDS, Motors, Unknowns
from batchpid.sim.robot.actuator_checks import load_robot_actuators
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner_keywords import Compensation

ASSUMED = "simulated_with"
"""Key of an actuators file, under "about": how the error that it states was simulated."""


def held_out_error(
    robot: Robot,
    logs: Iterable[str | os.PathLike[str] | Log],
    actuators: str | os.PathLike[str],
    *,
    params: bp.PIDParams | None = None,
    compensate: Compensation | None = None,
    timestep: float | None = None,
    sim_steps: int = 1,
    hold: bool = False,
) -> tuple[float, float]:
    """Return the position errors of ideal motors and of an actuators file on the held-out part of logs; fit nothing.

    Both are root mean squares [rad or m], inf if the simulation diverges. A file of
    :meth:`~batchpid.sim.identification.result.Identification.save` says with which payload, compensation and noise it
    was fitted. Of other files the payload is 0, and the likeliest compensation and noise are taken.

    Parameters
    ----------
    actuators
        Actuators file (.yaml or .json).

    The other arguments are those of :func:`batchpid.sim.identification.identify`.

    Raises
    ------
    InvalidArgumentError
        As for :func:`batchpid.sim.identification.identify`; or the file holds actuators of another robot, of several
        envs, or effects that the model lacks.
    FileNotFoundError
        A file does not exist.
    MissingDependencyError
        A package is missing.
    """
    inputs = read_inputs(robot, logs, params, compensate, timestep, sim_steps, hold)
    joints, source = inputs.joints, str(actuators)
    own = load_robot_actuators(source, robot)
    assumed = _assumed(source, documents.read(source))
    _check_modelled(source, own, robot, joints)
    motors = motors_of(own, robot, joints, float(assumed["stopping"]), float(assumed["payload"]))
    if (slew := _slew(source, assumed, [robot.joint_names[joint] for joint in joints])) is not None:
        motors["slew"] = slew
    one = np.ones(len(joints))
    more = [name for name in motors if name in ADDED]
    sizes = {"speed": one, "error": one, "friction": one}
    unknowns = Unknowns.of(one, one, one, one, payload=True).plus(more, range(len(joints)), sizes)
    motions = [smooth(log, inputs.drive.timestep) for log in inputs.logs]
    ways = [each for way in hypotheses(inputs.drive, payload=True) for each in variants(way, motions)]
    stated = [way for way in ways if way.assumptions.items() <= assumed.items()]
    point, tried = unknowns.point(motors)[None], []
    for way in stated or ways:
        problem = Problem(inputs.robot, joints, way, inputs.logs, motions, unknowns)
        residuals = problem.residuals(point)
        tried.append((problem.costs(problem.sizes(residuals)).sum(), problem, residuals))
    _, problem, residuals = min(tried, key=lambda each: each[0])
    before = residuals_of_ideal(problem, robot)
    return error_of(problem, before), error_of(problem, residuals)


def error_of(problem: Problem, residuals: list[Float64]) -> float:
    """Return the root mean square of the residuals (1, rows, joints) of each window on the held-out rows."""
    return float(np.sqrt((problem.held_out_errors([each[0] for each in residuals]) ** 2).mean()))


def residuals_of_ideal(problem: Problem, robot: Robot) -> list[Float64]:
    """Return the residuals (1, rows, joints) of each window for the motors according to the robot's description."""
    plain = replace(problem, unknowns=replace(problem.unknowns, known={}))
    return plain.residuals(plain.unknowns.point(ideal_motors(robot, problem.joints))[None])


def ideal_motors(robot: Robot, joints: tuple[int, ...]) -> Motors:
    """Return the motors according to the robot's description."""
    return motors_of(bp.Actuators(), robot, joints, 0.0, 0.0)


def motors_of(
    actuators: bp.Actuators, robot: Robot, joints: tuple[int, ...], stopping: float, payload: float
) -> Motors:
    """Return the motors of ``joints`` with ``actuators`` of ``robot``, a stopping time [s] and a payload [kg]."""
    own, motors = list(joints), {"stopping": np.array([[stopping]]), "payload": np.array([[payload]])}
    for name, kind in (KINDS | ADDED).items():
        leaf = None if kind.field is None else getattr(actuators, kind.field)
        if kind.field is None or (name in ADDED and leaf is None):
            continue
        row = np.full((1, len(own)), kind.neutral) if leaf is None else np.array(leaf, float)[:1, own]
        row = row + getattr(robot, DESCRIBED[name])[own] if name in DESCRIBED else row
        motors[name] = row if kind.per_joint else row[:, :1]
    return motors


def _assumed(source: str, document: Any) -> Document:
    """Return the assumptions of an actuators file; stopping time and payload alone if it states none."""
    stated = document.get("about", {}).get(ASSUMED, {})
    found = {name: KINDS[name].start for name in ("stopping", "payload")} | (stated if isinstance(stated, dict) else {})
    for name in ("stopping", "payload"):
        low, high = KINDS[name].low, KINDS[name].high
        if not documents.is_number(found[name]) or not low <= float(found[name]) <= high:
            remedy = f"give a number from {low:g} to {high:g}, or leave out {ASSUMED}"
            raise InvalidArgumentError(f"{source}: {name}", "is out of range", value=found[name], remedy=remedy)
    return found


def _slew(source: str, assumed: Document, joints: list[str]) -> Float64 | None:
    """Return the limits of the setpoints' rate that an actuators file states (1, joints); None without such limits."""
    if "slew" not in assumed:
        return None
    rates = assumed["slew"] if isinstance(assumed["slew"], dict) else {}
    if not all(documents.is_number(rates.get(joint)) and rates[joint] > 0 for joint in joints):
        remedy = f"give a number > 0 by joint: {', '.join(joints)}"
        raise InvalidArgumentError(f"{source}: slew", "is not valid", value=assumed["slew"], remedy=remedy)
    return np.array([[float(rates[joint]) for joint in joints]])


def _check_modelled(source: str, actuators: bp.Actuators, robot: Robot, joints: tuple[int, ...]) -> None:
    """Raise InvalidArgumentError if ``joints`` have effects in ``actuators`` that the model lacks."""
    modelled = {kind.field: kind for kind in (KINDS | ADDED).values() if kind.field is not None}
    for name, field in FIELDS.items():
        leaf = getattr(actuators, name)
        if leaf is None:
            continue
        values = np.array(leaf, float)[:, list(joints)]
        if name not in modelled and (values != field.neutral).any():
            joint = robot.joint_names[joints[int((values != field.neutral).any(0).argmax())]]
            remedy = f"leave it out; the model has {', '.join(modelled)}"
            raise InvalidArgumentError(f"{source}: {name}", "is not part of the model", joint=joint, remedy=remedy)
        if name in modelled and not modelled[name].per_joint and np.ptp(values) > 0:
            problem = "differs between joints, and the model has one for all"
            raise InvalidArgumentError(f"{source}: {name}", problem, remedy="give every joint the same")
    if actuators.limit_positions is not None:
        raise InvalidArgumentError(f"{source}: position_limit", "is not part of the model", remedy="leave it out")
