"""Identification of a robot's motors from logs, as a function of the library."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from importlib.util import find_spec
from multiprocessing import get_context
from typing import Any, get_args

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64
from batchpid.arrays.elementwise import TURN
from batchpid.checks import choice, flag, instance, integer, number
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.identification.fit import fit
from batchpid.sim.identification.log import CommandKind, Log, checked
from batchpid.sim.identification.log_files import read_logs
from batchpid.sim.identification.regression import (
    Guess,
    cost_of,
    regress,
    smooth,
)
from batchpid.sim.identification.result import Identification
from batchpid.sim.identification.simulator import Exact, LogData, LogPlant, Motion, windows_of
from batchpid.sim.identification.unknowns import (
    BASIC,
    EXTRAS,
    SENDER,
    Problem,
    Unknowns,
    kinds_of,
)
from batchpid.sim.options.groups import Compensation
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.robot_model import link_tree
from batchpid.sim.robot.robot_options import FRICTION_BAND, known_joints
from batchpid.stages import Control
from batchpid.task_space.tree_quantities import mass_matrix

STILL = {"rad": 1e-3, "m": 1e-4}
"""Standard deviation of the positions up to which a joint did not move."""
FOLLOWS = 0.01
"""A joint is stuck if the standard deviation of its positions is at most this share of its
setpoints'.
"""
LONGEST_STEP, USUAL_STEP = 2.5e-3, 5e-4
"""Period up to which the rows of a log count as steps of the control, and the longest time step
otherwise [s].
"""
DETOUR = 0.1
"""Decrease of the regression's cost from which the compensation counts as exact, not through the
motors.
"""


def identify(
    robot: Robot,
    logs: Iterable[str | os.PathLike[str] | Log],
    params: bp.PIDParams | None = None,
    *,
    compensate: Compensation | None = None,
    timestep: float | None = None,
    hold: bool = False,
    payload: bool = True,
    extras: Sequence[str] = (),
    evaluations: int = 60,
    workers: int = 0,
    progress: Callable[[], object] | None = None,
) -> Identification:
    """Find the motors of ``robot`` from logs of its motion.

    Parameters
    ----------
    logs
        Files (:mod:`batchpid.sim.identification.log_files`), or logs from :func:`read_logs`, each with
        separate settings.
    params
        Params of the PID law that drove the robot, of all its joints or of those in the logs: the
        setpoints of the logs are used. None: the params of a log, or the logged efforts.
    compensate
        Forces that the robot compensates by itself, or "none", as for logs of the complete efforts.
        Default: as a recording says, else "gravity+coriolis+friction".
    timestep
        Time step of the control that drove the robot [s]. Default: as a recording says, else the
        period of the rows up to 2.5 ms, or a part of a longer one of at most 0.5 ms.
    hold
        True if the commands of CSV files hold from row to row, False to interpolate between rows.
    payload
        Find a payload, too, at the center of mass of the last link with a mass that is fixed behind
        the last moving one, or of the tool, whichever explains the logs better.
    extras
        Further unknowns: "load_friction", "stribeck" (friction at rest and the speed at which it
        has fallen), "offset" (of the encoder), "mass" (factors of the links' masses); and for logs
        of setpoints "slew" (the limit of the setpoints' rate).
    evaluations
        Largest number of evaluations of each fit: of all unknowns, and of more or fewer of them.
    workers
        Number of processes, 0 for this one.
    progress
        Called after each evaluation.

    Raises
    ------
    InvalidArgumentError
        An option is out of range, a file holds no log of this robot, or setpoints were logged late.
    MissingDependencyError
        SciPy is not installed.
    """
    if find_spec("scipy") is None:
        raise MissingDependencyError("scipy", "identification", "tune")
    instance("robot", robot, Robot, "load one with Robot.load('panda') or a URDF path")
    kinds = [choice("extras", name, EXTRAS) for name in dict.fromkeys(extras)]
    evaluations = integer("evaluations", evaluations, 2, 1000)
    if timestep is not None:
        timestep = number("timestep", timestep, 1e-5, 0.01, "seconds")
    if compensate is not None:
        choice("compensate", compensate, get_args(Compensation))
    places: list[str | None] = [None]
    if flag("payload", payload):
        kinds.append("payload")
        places = _payload_links(robot)
    read = _read(robot, logs, params, hold)
    moves, still = _moving(robot, read)
    robot, data = _prepared(
        robot,
        read,
        moves,
        params,
        compensate,
        timestep,
    )
    data, guess = _regress(data)
    windows = windows_of(data)
    with ExitStack() as stack:
        run = _map(stack, integer("workers", workers, 0, 1000))
        starts = []
        for place in places:
            unknowns = _unknowns(robot, data, guess, kinds, place)
            starts.append(Problem(data, windows, unknowns, run))
        solution = fit(starts, evaluations, progress or (lambda: None))
    # Worker processes end with the fit.
    return Identification(solution._replace(problem=replace(solution.problem, run=map)), still)


def _payload_links(robot: Robot) -> list[str | None]:
    """Return the links where a payload may be: the last link with a mass on the body of the tool,
    and the tool.
    """
    tree = link_tree(robot)
    body = tree.link_bodies[tree.index(tree.tool)]
    links = zip(tree.links, tree.link_bodies, tree.mass, strict=True)
    fixed = [link for link, of_body, mass in links if of_body == body and mass > 0]
    return list(dict.fromkeys([*fixed[-1:], tree.tool]))


def _read(
    robot: Robot,
    logs: Iterable[Any],
    params: bp.PIDParams | None,
    hold: bool,
) -> list[Log]:
    """Return the logs of the arguments of :func:`identify`."""
    kind: CommandKind | None = None
    if params is not None:
        instance("params", params, bp.PIDParams, "load them with load_params()")
        kind = "setpoint"
    read = list[Log]()
    for source in [logs] if isinstance(logs, str | os.PathLike | Log) else logs:
        if isinstance(source, Log):
            read += checked(source.robot or robot, source)
        else:
            read += read_logs(robot, [source], kind, hold=hold)
    if all(log.held_out for log in read):
        raise InvalidArgumentError("logs", "are missing or held out", remedy="name some to fit")
    first = read[0]
    for log in read:
        if (log.joints, log.kind, log.measured) != (first.joints, first.kind, first.measured):
            problem = f"holds other joints or commands than {first.source}"
            raise log.error(problem, "fit them one by one")
    return read


def _moving(robot: Robot, logs: list[Log]) -> tuple[Bool, tuple[str, ...]]:
    """Return the mask (joints,) of the logged joints that moved, and the names of the others, which
    are jammed or not driven.
    """
    joints = logs[0].joints
    spread = np.concatenate([log.qpos for log in logs]).std(0)
    moves = spread > [STILL[robot.units[joint]] for joint in joints]
    if logs[0].kind == "setpoint":
        moves &= spread > FOLLOWS * np.concatenate([log.command for log in logs]).std(0)
    still = tuple(robot.joint_names[joint] for joint in np.array(joints)[~moves])
    names = ", ".join(map(repr, still))
    if not moves.any():
        problem = f"show no motion of any joint ({names})"
        raise InvalidArgumentError("logs", problem, remedy="record a motion")
    return moves, still


def _prepared(
    robot: Robot,
    logs: list[Log],
    moves: Bool,
    params: bp.PIDParams | None,
    compensate: str | None,
    timestep: float | None,
) -> tuple[Robot, list[LogData]]:
    """Return the robot with its still joints at their mean positions, and the moving joints of each
    log with plant and control.
    """
    # Joints that did not move are held at their mean position, with the unlogged ones.
    qpos = np.concatenate([log.qpos for log in logs])
    joints = np.array(logs[0].joints)
    start = robot.start
    start[joints[~moves]] = qpos.mean(0)[~moves]
    joints = joints[moves]
    # Joints whose positions leave the limits have none in the simulation.
    qpos = qpos[:, moves]
    free = (qpos.min(0) < robot.lower[joints]) | (qpos.max(0) > robot.upper[joints])
    # A Runner compensates the friction of the description and of the robot's motors, too.
    friction = (robot.friction + known_joints(robot)["coulomb"])[joints]
    band = np.array([FRICTION_BAND[robot.units[joint]] for joint in joints])
    modelled = {"modelled": friction, "band": band, "turns": robot.continuous[joints] / TURN}
    plants = dict[Robot, LogPlant]()
    data = list[LogData]()
    for log in logs:
        law = _law(robot, log, params)
        forces = compensate or log.compensate or "gravity+coriolis+friction"
        dt = timestep or log.timestep or _own_timestep(log)
        drive = Control(
            timestep=dt,
            envs=1,
            coupling=robot.coupling,
            params=bp.PIDParams(kp=None) if law is None else law.for_joints(moves),
            mode="effort" if law is None else "pid",
            gravity="gravity" in forces,
            coriolis="coriolis" in forces,
            **(modelled if "friction" in forces and friction.any() else {}),
        )
        key = log.robot or robot
        if key not in plants:
            plants[key] = LogPlant(_resting(key, start), tuple(joints.tolist()), free)
        part = log.part(joints=moves)
        data.append(LogData(part, smooth(part, dt), plants[key], drive))
    return _resting(robot, start), data


def _own_timestep(log: Log) -> float:
    """Return the time step for a log that does not say it: the period of its rows, or a part of a
    long one.
    """
    period = float(np.median(np.diff(log.time)))
    if period > LONGEST_STEP:
        return float(period / np.ceil(period / USUAL_STEP))
    return max(period, 1e-4)


def _resting(robot: Robot, start: Float64) -> Robot:
    """Return ``robot`` with the start pose ``start`` (dof,)."""
    return replace(robot, settings=None, source=robot.source._replace(start=start))


def _law(robot: Robot, log: Log, params: bp.PIDParams | None) -> bp.PIDParams | None:
    """Return the params that drove a log, of its joints, one row; None for efforts."""
    law = log.params if params is None else params
    if (law is None) == (log.kind == "setpoint"):
        remedy = "give no params" if law is not None else "give the params that drove the robot"
        raise log.error(f"holds {log.kind}s", remedy)
    if law is None:
        return None
    if law.num_joints != len(log.joints):
        if law.num_joints != robot.dof or law.num_envs != 1:
            problem = f"hold {law.num_joints} joints of {law.num_envs} envs"
            remedy = f"give one gain for each of the robot's {robot.dof} joints"
            raise InvalidArgumentError("params", problem, remedy=remedy)
        law = law.for_joints(list(log.joints))
    if law.gain_units is not None:
        problem = "have gains per inertia or mass matrix, which a fit does not simulate"
        raise InvalidArgumentError("params", problem, remedy="log the efforts, and give no params")
    return law


def _regress(data: list[LogData]) -> tuple[list[LogData], Guess]:
    """Return the logs, marked whether the compensation passes through the motors, and the guess of
    the regression.

    Raises InvalidArgumentError where setpoints acted before they were logged.
    """
    guess = regress(_fitted(data))
    if any(part.drive.gravity for part in data):
        # A robot that adds the compensation by itself may do so exactly, whatever its motors.
        none = np.zeros(data[0].plant.joints)
        exact = []
        for part in data:
            drive = part.drive._replace(powered=none, further=(Exact(),))
            exact.append(part._replace(drive=drive))
        other = regress(_fitted(exact))
        if cost_of(other) < cost_of(guess) - DETOUR:
            data = exact
            guess = other
    delay = round(1e3 * float(guess["setpoint_delay"][0]))
    if delay < 0:
        problem = f"have setpoints that were logged about {-delay} ms late"
        raise InvalidArgumentError("logs", problem, remedy="correct their times")
    return data, guess


def _fitted(data: list[LogData]) -> list[LogData]:
    """Return the logs that are not held out as a whole."""
    return [part for part in data if not part.log.held_out]


def _unknowns(
    robot: Robot,
    data: list[LogData],
    guess: Guess,
    extras: Sequence[str],
    payload_link: str | None,
) -> Unknowns:
    """Return the unknowns with starts from the regression, and typical sizes from the motion."""
    data = _fitted(data)
    log, _, plant, drive = data[0]
    starts = dict(guess)
    kinds = list(BASIC)
    if drive.mode == "pid":
        kinds += SENDER
        starts["setpoint_lag"] = np.zeros(1)
    for name in extras:
        kinds += kinds_of(name)
        if name == "slew" and drive.mode == "effort":
            problem = "is of setpoints, and the logs hold efforts"
            remedy = "leave it out, or give the params of the law"
            raise InvalidArgumentError("extras", problem, value=name, remedy=remedy)
    if log.measured:
        # Measured efforts are late by nothing, and say nothing of the motor's strength.
        kinds.remove("delay")
        kinds[kinds.index("strength")] = "effort_scale"
        starts["effort_scale"] = starts["strength"]
    motion = Motion(*map(np.concatenate, zip(*(part.motion for part in data), strict=True)))
    # The mean inertia of the links, on 200 poses of the motion.
    poses = plant.spread(motion.qpos[:: 1 + len(motion.qpos) // 200])
    links = np.einsum("nii->i", mass_matrix(plant.tree, poses))[plant.columns] / len(poses)
    speed = np.maximum(np.sqrt((motion.qvel**2).mean(0)), 1e-3)
    acceleration = np.maximum(np.sqrt((motion.qacc**2).mean(0)), 0.1)
    friction = starts["friction"]
    effort = (links + starts["armature"]) * acceleration + friction
    sizes = {
        "inertia": links,
        "damping": effort / speed,
        "effort": effort,
        "friction": 0.3 * np.maximum(friction, 0.05 * effort),
        "speed": 0.1 * speed,
        "top_speed": np.quantile(np.abs(motion.qvel), 0.99, axis=0),
    }
    unknowns = Unknowns(
        robot,
        log.joints,
        sizes,
        plant.heavy_links,
        payload_link,
    )
    return unknowns.adding(kinds, starts)


def _map(stack: ExitStack, workers: int) -> Callable[..., Any]:
    """Return the map over tasks: of worker processes that end with ``stack``, or of this one."""
    if workers < 2:
        return map
    return stack.enter_context(ProcessPoolExecutor(workers, mp_context=get_context("spawn"))).map
