"""Inputs of an identification: logs without joints that did not move, the robot that made them, and its control."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.checks.validate import choice, flag, instance, integer, number
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.identification.log import Log, LogWarning
from batchpid.sim.identification.log_checks import at_limits, checked
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.logs import read_logs
from batchpid.sim.robot.parts import FileDefaults
from batchpid.sim.robot.robot import Robot

STILL, SHARE, SHAKEN = {"rad": 1e-3, "m": 1e-4}, 0.01, 1.5
"""Standard deviation of the positions up to which a joint did not move: absolute, or as a share of the joint with the
largest one, whichever is less; or over the noise from row to row."""
FOLLOWS = 0.05
"""Standard deviation of the positions, over that of the setpoints, up to which a joint did not follow its setpoint: it
is stuck, and gives a little."""


class Inputs(NamedTuple):
    """Logs of the joints that moved, and the robot and control that made them."""

    robot: Robot
    """The robot, which rests where the joints that did not move are."""
    logs: list[Log]
    drive: LoggedDrive
    """Control, with the compensation outside of the motors."""
    still: list[str]
    """Names of the joints that did not move."""

    @property
    def joints(self) -> tuple[int, ...]:
        """Numbers of the joints that moved."""
        return self.logs[0].joints


def read_inputs(
    robot: Robot,
    logs: Iterable[str | os.PathLike[str] | Log],
    params: bp.PIDParams | None,
    compensate: str | None,
    timestep: float | None,
    sim_steps: int,
    hold: bool,
) -> Inputs:
    """Return the inputs; the arguments are those of :func:`batchpid.sim.identification.identify`, which calls this."""
    for package in ("scipy", "cmaes"):
        if find_spec(package) is None:
            raise MissingDependencyError(package, "identification", "tune")
    instance("robot", robot, Robot, "load one with Robot.load('panda') or a URDF path")
    sim_steps = integer("sim_steps", sim_steps, 1, 100)
    found = _logs(robot, logs, "effort" if params is None else "setpoint", flag("hold", hold))
    control = number("timestep", _recorded("timestep", timestep, found, 1 / 2000), 1e-5, 0.01, "seconds")
    compensate = _recorded("compensate", compensate, found, "gravity+coriolis+friction")
    choice("compensate", compensate, ("gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"))
    logged = found[0].joints
    found, resting, still = _without_still(robot, found)
    numbers = [logged.index(joint) for joint in found[0].joints]

    def of_logs(params: Any) -> Any:
        return None if params is None else _of_joints(params, robot, logged).for_joints(numbers)

    if params is not None:
        params = of_logs(instance("params", params, bp.PIDParams, "load them with load_params()"))
    own = {id(each): of_logs(each) for each in (log.settings.params for log in found)}
    found = [replace(log, settings=log.settings._replace(params=own[id(log.settings.params)])) for log in found]
    params = found[0].settings.params if params is None else params
    measured = params is not None and params.measurement_rate is not None
    forces = _forces(compensate)
    drive = LoggedDrive(control / sim_steps, params, forces, substeps=sim_steps, measured_rate=measured)
    return Inputs(resting, found, drive, still)


def _logs(robot: Robot, logs: Iterable[Any], kind: Any, hold: bool) -> list[Log]:
    given = [logs] if isinstance(logs, str | os.PathLike | Log) else list(logs)
    found = [
        log
        for each in given
        for log in (
            checked(each.settings.robot or robot, each)
            if isinstance(each, Log)
            else read_logs(robot, [each], kind, hold=hold)
        )
    ]
    if not found:
        raise InvalidArgumentError("logs", "are missing", remedy="name one file or more")
    held_out = {log.settings.held_out for log in found}
    if len(held_out) == 1 and held_out != {None}:
        problem = "are all held out" if True in held_out else "hold out nothing, which would test the fit"
        raise InvalidArgumentError("logs", problem, remedy="set held_out of some of them, or of none")
    for log in found:
        if log.joints != found[0].joints:
            raise InvalidArgumentError(
                log.source, f"holds other joints than {found[0].source}", remedy="fit them one by one"
            )
        if log.kind != ("effort" if kind == "effort" and log.settings.params is None else "setpoint"):
            remedy = "give the params that drove the robot" if log.kind == "setpoint" else "give no params"
            raise InvalidArgumentError(log.source, f"holds {log.kind}s", remedy=remedy)
        if (log.kind, log.sensor, log.is_measured) != (found[0].kind, found[0].sensor, found[0].is_measured):
            problem = f"holds other commands or measured efforts than {found[0].source}"
            raise InvalidArgumentError(log.source, problem, remedy="fit them one by one")
        if stopped := at_limits(log.settings.robot or robot, log):
            message = "; ".join(stopped) + ": stops are not part of the model; record between the limits"
            warn(message, LogWarning)
    return found


def _without_still(robot: Robot, logs: list[Log]) -> tuple[list[Log], Robot, list[str]]:
    """Return the logs without joints that do not move, the robot that rests where they are, and their names.

    Such a joint is jammed, braked or not driven: the model of a motor does not describe it.
    """
    joints, qpos = logs[0].joints, np.concatenate([log.qpos for log in logs])
    noise = np.sqrt(np.mean(np.concatenate([np.diff(log.qpos, axis=0) for log in logs]) ** 2, axis=0) / 2)
    moved = qpos.std(0)
    least = np.clip(SHARE * moved.max(), 1e-9, [STILL[robot.units[joint]] for joint in joints])
    stands = moved <= np.maximum(least, SHAKEN * noise)
    moves = ~stands
    if logs[0].kind == "setpoint":
        moves &= moved > FOLLOWS * np.concatenate([log.command for log in logs]).std(0)
    if moves.all():
        return logs, robot, []
    names = [robot.joint_names[joint] for joint in joints]
    still = [name for name, each in zip(names, moves, strict=True) if not each]
    if not moves.any():
        problem = f"show no motion of any joint ({_quoted(still)})"
        raise InvalidArgumentError("logs", problem, remedy="record a motion, such as one of batchpid excite")
    for fault, these in (("move", stands), ("follow its setpoint", ~moves & ~stands)):
        if these.any():
            listed = _quoted([name for name, each in zip(names, these, strict=True) if each])
            message = f"{listed} did not {fault}: left out, and held where the logs have it"
            warn(f"{message}; its motor cannot be identified", LogWarning)
    start = robot.start
    start[[joint for joint, each in zip(joints, moves, strict=True) if not each]] = qpos.mean(0)[~moves]

    def resting(robot: Robot) -> Robot:
        return replace(robot, settings=None, defaults=FileDefaults(start))

    found = [log.part(joints=moves) for log in logs]
    for index, log in enumerate(found):
        if (own := log.settings.robot) is not None:
            found[index] = replace(log, settings=log.settings._replace(robot=resting(own)))
    return found, resting(robot), still


def _quoted(names: list[str]) -> str:
    return ", ".join(map(repr, names))


def _recorded(name: str, given: Any, logs: list[Log], default: Any) -> Any:
    """Return the option ``name`` as given or as the recordings say, or the default."""
    for log in logs:
        known = getattr(log, name)
        if known is None:
            continue
        if given is None:
            given = known
        same = np.isclose(known, given) if name == "timestep" else _forces(known) == _forces(given)
        if not same:
            problem, remedy = f"contradicts {log.source}, which was made with {known!r}", "leave the option out"
            raise InvalidArgumentError(name, problem, value=given, remedy=f"{remedy}, and fit such recordings alone")
    return default if given is None else given


def _forces(compensate: Any) -> str:
    return str(compensate).removesuffix("+friction")


def _of_joints(params: bp.PIDParams, robot: Robot, joints: tuple[int, ...]) -> bp.PIDParams:
    """Return the params of ``joints``, one row."""
    if params.num_envs != 1:
        raise InvalidArgumentError("params", f"hold {params.num_envs} envs", remedy="give those of the logged robot")
    if params.num_joints == len(joints):
        return params
    if params.num_joints != robot.dof:
        problem = f"hold {params.num_joints} joints; the robot has {robot.dof}, the logs {len(joints)}"
        raise InvalidArgumentError("params", problem, remedy="give one gain per joint of the robot")
    return params.for_joints(list(joints))
