"""Identification of a robot's motors from logs, as a function of the library."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from importlib.util import find_spec
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import choice, flag, instance, integer, number
from batchpid.checks.warn import warn
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.sim.identification.fit import MOST_WINDOWS, Problem, windows_of
from batchpid.sim.identification.intervals import intervals_of
from batchpid.sim.identification.log import Log, LogWarning, checked
from batchpid.sim.identification.logs import Reading, read_logs
from batchpid.sim.identification.regression import (
    STRENGTHS,
    Guess,
    Motion,
    Regression,
    better_reading,
    smooth,
)
from batchpid.sim.identification.result import Identification
from batchpid.sim.identification.simulator import LogControl, Plant
from batchpid.sim.identification.unknowns import BASIC, EXTRAS, LAW, Unknowns
from batchpid.sim.options.groups import Compensation
from batchpid.sim.robot.parts import FileDefaults
from batchpid.sim.robot.robot import Robot

STILL = {"rad": 1e-3, "m": 1e-4}
"""Standard deviation of the positions up to which a joint did not move."""
SHARE, SHAKEN = 0.01, 1.5
"""The same as a share of the joint that moved most, and over the noise from row to row."""
BEYOND = 3.0
"""Effort over the robot's limit from which it looks like another unit."""
FOLLOWS = 0.02
"""Ratio of the standard deviation of positions to the setpoints', up to which a joint counts as
stuck.
"""


class Data(NamedTuple):
    """Logs of the joints that moved, and the robots and control that made them."""

    robot: Robot
    """The robot, whose start pose has the positions of the joints that did not move."""
    logs: list[Log]
    motions: list[Motion]
    plants: list[Plant]
    drives: list[LogControl]
    """Motion, plant and drive of each log."""
    still: list[str]
    """Names of the joints that did not move."""


def identify(
    robot: Robot,
    logs: Iterable[str | os.PathLike[str] | Log],
    params: bp.PIDParams | None = None,
    *,
    compensate: Compensation | None = None,
    timestep: float | None = None,
    payload: bool = True,
    extras: Sequence[str] = (),
    reading: Reading | None = None,
    evaluations: int = 30,
    workers: int = 0,
    progress: Callable[[], Any] | None = None,
) -> Identification:
    """Find the motors of ``robot`` from logs of its motion.

    Parameters
    ----------
    logs
        Files (:mod:`batchpid.sim.identification.logs`), or logs from :func:`read_logs`, each with
        separate settings.
    params
        Params of the PID law that drove the robot, of all its joints or of those in the logs: the
        setpoints of the logs are used. None: the params of a recording, or the logged efforts.
    compensate
        Forces that the robot compensates by itself, or "none", as for logs of the complete efforts.
        Default: as the recordings say, else "gravity+coriolis+friction".
    timestep
        Time step of the control that drove the robot [s]. Default: as the recordings say, else
        1/2000.
    payload
        Find a payload at the tool, too.
    extras
        Further unknowns: "load_friction", "stribeck" (friction at rest and the speed at which it
        has fallen), "offset" (of the encoder), "mass" (factors of the links' masses); and of the
        law, for logs of setpoints, "saturation" (its effort limit), "slew" (the limit of the
        setpoints' rate), "kd", and "gain", a factor of all gains.
    reading
        Units and names in the files.
    evaluations
        Largest number of evaluations of the fit.
    workers
        Number of processes, 0 for this one.
    progress
        Called after each evaluation.

    Raises
    ------
    InvalidArgumentError
        An option is out of range or contradicts a recording, or a file holds no log of this robot.
    MissingDependencyError
        SciPy is missing.

    Warns
    -----
    LogWarning
        A log was changed when it was read, or a joint did not move.
    """
    for name in extras:
        choice("extras", name, [*EXTRAS])
    data = _read(robot, logs, params, compensate, timestep, reading)
    guess = _guess(data)
    # An effect of the law, which the regression does not have, may look like another reading.
    if {*LAW}.isdisjoint(extras) and _is_odd(data, guess) and (words := _better_reading(data)):
        raise InvalidArgumentError(
            "logs", f"make sense with {words}", remedy="correct the log or its options"
        )
    unknowns = _unknowns(data, guess, [*extras], flag("payload", payload))
    pool: Any = nullcontext()
    if integer("workers", workers, 0, 1000) > 1:
        pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    with pool as executor:
        run = map if executor is None else executor.map
        problem = Problem(data.plants, data.drives, _windows(data), unknowns, run)
        found = _fitted(data, problem, integer("evaluations", evaluations, 2, 1000), progress)
    if not found.explains and (words := _better_reading(data)):
        return replace(
            found, advice=f"the logs make more sense with {words}: correct the log or its options"
        )
    return found


def _read(
    robot: Robot,
    logs: Iterable[Any],
    params: bp.PIDParams | None,
    compensate: str | None,
    timestep: float | None,
    reading: Reading | None,
) -> Data:
    """Return the inputs for the arguments of :func:`identify`."""
    if find_spec("scipy") is None:
        raise MissingDependencyError("scipy", "identification", "tune")
    instance("robot", robot, Robot, "load one with Robot.load('panda') or a URDF path")
    sources = [logs] if isinstance(logs, str | os.PathLike | Log) else list(logs)
    read = list[Log]()
    for source in sources:
        if isinstance(source, Log):
            read += checked(source.settings.robot or robot, source)
        else:
            read += read_logs(
                robot, [source], None if params is None else "setpoint", reading=reading
            )
    if not read:
        raise InvalidArgumentError("logs", "are missing", remedy="name one file or more")
    if params is not None:
        params = _of_joints(
            instance("params", params, bp.PIDParams, "load them with load_params()"), robot, read[0]
        )
    forces = str(
        _recorded("compensate", compensate, read, "gravity+coriolis+friction")
    ).removesuffix("+friction")
    choice("compensate", forces, ("gravity+coriolis", "gravity", "none"))
    dt = number("timestep", _recorded("timestep", timestep, read, 1 / 2000), 1e-5, 0.01, "seconds")
    laws = [_law(robot, log, params) for log in read]
    for log, law in zip(read, laws, strict=True):
        if log.joints != read[0].joints or log.kind != read[0].kind:
            problem = f"holds other joints or commands than {read[0].source}"
            raise InvalidArgumentError(log.source, problem, remedy="fit them one by one")
        if (law is None) != (log.kind == "effort"):
            remedy = "give the params that drove the robot" if law is None else "give no params"
            raise InvalidArgumentError(log.source, f"holds {log.kind}s", remedy=remedy)
        if law is not None and law.gain_units is not None:
            problem = "have gains per inertia or mass matrix, which a fit does not simulate"
            raise InvalidArgumentError(
                "params", problem, remedy="log the efforts, and give no params"
            )
    if all(log.settings.held_out for log in read):
        raise InvalidArgumentError(
            "logs", "are all held out", remedy="set held_out of some of them"
        )
    moves = _moves(robot, read)
    still = [
        robot.joint_names[joint]
        for joint, moving in zip(read[0].joints, moves, strict=True)
        if not moving
    ]
    start = robot.start
    places = np.concatenate([log.qpos for log in read]).mean(0)
    start[np.array(read[0].joints)[~moves]] = places[~moves]
    parts = [log.part(joints=moves) for log in read]
    resting = _resting(robot, start) if still else robot
    robots = [
        resting if log.settings.robot is None else _resting(log.settings.robot, start)
        for log in parts
    ]
    plants = dict[Any, Plant]()
    for log, at_rest in zip(parts, robots, strict=True):
        plants.setdefault(
            (id(log.settings.robot), log.settings.payload),
            Plant(at_rest, log.joints, log.settings.payload),
        )
    drives = [
        LogControl(dt, None if law is None else law.for_joints(moves), forces) for law in laws
    ]
    chosen = [plants[id(log.settings.robot), log.settings.payload] for log in parts]
    return Data(resting, parts, [smooth(log, dt) for log in parts], chosen, drives, still)


def _resting(robot: Robot, start: Float64) -> Robot:
    """Return ``robot`` with the start pose ``start`` (dof,)."""
    return replace(robot, settings=None, defaults=FileDefaults(start))


def _law(robot: Robot, log: Log, params: bp.PIDParams | None) -> bp.PIDParams | None:
    """Return the params that drove a log; raise InvalidArgumentError if a recording contradicts
    them.
    """
    chosen = params if log.settings.params is None else log.settings.params
    recorded, law = (
        None if one is None else _of_joints(one, robot, log) for one in (log.params, chosen)
    )
    if recorded is None or law is None:
        return recorded if law is None else law
    for name in ("kp", "ki", "kd"):
        before, now = (
            0.0 if gain is None else gain for gain in (getattr(recorded, name), getattr(law, name))
        )
        if not np.allclose(before, now, rtol=1e-6):
            problem = f"contradict {log.source}, which was recorded with another {name}"
            raise InvalidArgumentError(
                "params", problem, remedy="leave them out: a recording has its own"
            )
    return law


def _of_joints(params: bp.PIDParams, robot: Robot, log: Log) -> bp.PIDParams:
    """Return the params of the joints of a log, one row."""
    if params.num_envs != 1:
        raise InvalidArgumentError(
            "params", f"hold {params.num_envs} envs", remedy="give those of the logged robot"
        )
    if params.num_joints == len(log.joints):
        return params
    if params.num_joints != robot.dof:
        problem = (
            f"hold {params.num_joints} joints; the robot has {robot.dof}, the logs"
            f" {len(log.joints)}"
        )
        raise InvalidArgumentError("params", problem, remedy="give one gain per joint of the robot")
    return params.for_joints(list(log.joints))


def _recorded(name: str, value: Any, logs: list[Log], default: Any) -> Any:
    """Return an option as the recordings say, or its ``value``, or the default."""
    for log in logs:
        recorded = getattr(log, name)
        if recorded is None:
            continue
        value = recorded if value is None else value
        same = np.isclose(recorded, value) if name == "timestep" else recorded == value
        if not same:
            problem = f"contradicts {log.source}, which was made with {recorded!r}"
            raise InvalidArgumentError(name, problem, value=value, remedy="leave the option out")
    return default if value is None else value


def _moves(robot: Robot, logs: list[Log]) -> Any:
    """Return the mask (joints,) of the joints that moved; warn about the others, which are jammed
    or not driven.
    """
    joints, qpos = logs[0].joints, np.concatenate([log.qpos for log in logs])
    noise = np.sqrt(
        np.mean(np.concatenate([np.diff(log.qpos, axis=0) for log in logs]) ** 2, axis=0) / 2
    )
    spread = qpos.std(0)
    least = np.clip(SHARE * spread.max(), 1e-9, [STILL[robot.units[joint]] for joint in joints])
    moves = spread > np.maximum(least, SHAKEN * noise)
    if logs[0].kind == "setpoint":
        commanded = np.concatenate([log.command for log in logs]).std(0)
        degrees = moves & (commanded > 30 * spread) & (commanded < 90 * spread)
        if degrees.any():
            name = robot.joint_names[joints[int(np.argmax(degrees))]]
            problem = f"have setpoints of joint {name!r} that move 57 times as far as its positions"
            raise InvalidArgumentError(
                "logs", problem, remedy="setpoints look like degrees: give both in rad"
            )
        moves &= spread > FOLLOWS * commanded
    names = ", ".join(
        repr(robot.joint_names[joint])
        for joint, moving in zip(joints, moves, strict=True)
        if not moving
    )
    if not moves.any():
        raise InvalidArgumentError(
            "logs", f"show no motion of any joint ({names})", remedy="record a motion"
        )
    if names:
        warn(
            f"{names} did not move, or did not follow its setpoint: left out, and held in place",
            LogWarning,
        )
    return moves


def _guess(data: Data) -> Guess:
    """Return the motors by the regression, and set whether the compensation passes through them."""
    fitted = [at for at, log in enumerate(data.logs) if not log.settings.held_out]
    guesses = []
    for through in (True, False) if data.drives[0].compensate != "none" else (True,):
        drives = [drive._replace(through=through) for drive in data.drives]
        parts = zip(
            *[(data.plants[at], drives[at], data.logs[at], data.motions[at]) for at in fitted],
            strict=True,
        )
        guess = Regression(*parts).best()
        guesses.append((guess.cost - (0.1 if through else 0.0), drives, guess))
    _, data.drives[:], best = min(guesses, key=lambda option: option[0])
    return best


def _is_odd(data: Data, guess: Guess) -> bool:
    """Return whether a strength is at its bound, or efforts are far beyond the limits of the
    robot.
    """
    if data.logs[0].kind == "effort":
        most = np.quantile(np.abs(np.concatenate([log.command for log in data.logs])), 0.99, axis=0)
        limits = data.robot.effort_limit[list(data.logs[0].joints)]
        if (most > BEYOND * np.where(limits > 0, limits, np.inf)).any():
            return True
    return bool(np.isin(guess.values["strength"], STRENGTHS).any())


def _better_reading(data: Data) -> str:
    names = [data.robot.joint_names[joint] for joint in data.logs[0].joints]
    return better_reading(data.plants[0], data.drives[0], data.logs[0], names)


def _unknowns(data: Data, guess: Guess, extras: list[str], payload: bool) -> Unknowns:
    """Return the unknowns with typical sizes from the motion."""
    first = data.logs[0]
    if first.kind == "effort" and (of_law := [name for name in extras if name in LAW]):
        remedy = "leave it out, or give the params of the law"
        raise InvalidArgumentError(
            "extras", "is of a law, and the logs hold efforts", value=of_law[0], remedy=remedy
        )
    kinds = [kind for kind in BASIC if not (kind == "delay" and first.measured)]
    kinds = [kind for kind in kinds if not (kind == "strength" and "gain" in extras)]
    kinds += ["setpoint_delay"] * (first.kind == "setpoint") + ["payload"] * payload
    kinds += [kind for name in extras for kind in EXTRAS[name]]
    qpos, qvel, qacc = (
        np.concatenate([motion[part] for motion in data.motions]) for part in range(3)
    )
    poses = np.ascontiguousarray(qpos[:: max(1, len(qpos) // 200)])
    dynamics = data.plants[0].dynamics([()] * len(poses), poses, np.zeros_like(poses))
    dynamics.update()
    links = np.diagonal(dynamics.matrix, axis1=1, axis2=2).mean(0)
    speed = np.maximum(np.sqrt((qvel**2).mean(0)), 1e-3)
    inertia = links + guess.values["armature"]
    effort = np.maximum(
        inertia * np.sqrt((qacc**2).mean(0)) + guess.values["friction"], 0.1 * inertia
    )
    sizes = {"inertia": links, "damping": effort / speed, "effort": effort, "speed": 0.1 * speed}
    sizes |= {"friction": 0.3 * np.maximum(guess.values["friction"], 0.05 * effort)}
    sizes |= {"top_speed": np.quantile(np.abs(qvel), 0.99, axis=0)}
    if first.kind == "setpoint":
        errors = np.concatenate([np.abs(motion.command - motion.qpos) for motion in data.motions])
        sizes["error"] = 0.7 * np.quantile(errors, 0.95, axis=0)
    starts = dict(guess.values)
    if "gain" in extras:
        starts["gain"] = starts.pop("strength")
    return Unknowns.of(data.robot, first.joints, kinds, starts, sizes, data.plants[0].heavy_links)


def _windows(data: Data) -> list[Any]:
    dt, whole = data.drives[0].timestep, data.logs[0].kind == "setpoint"
    windows = [
        window
        for at, (log, motion) in enumerate(zip(data.logs, data.motions, strict=True))
        for window in windows_of(at, log, motion, dt, whole)
    ]
    return windows[:: 1 + len(windows) // MOST_WINDOWS]


def _fitted(
    data: Data, problem: Problem, evaluations: int, progress: Callable[[], Any] | None
) -> Identification:
    """Return the fit: first of all unknowns, then of those that the logs show."""
    fitted = replace(problem, windows=[window for window in problem.windows if window.fitted.any()])
    rough = fitted.solve(problem.unknowns.start, max(evaluations // 4, 1), progress=progress)
    shown = intervals_of(fitted, rough).shown
    unknowns, hidden = problem.unknowns.only(shown), problem.unknowns.only(~shown)
    fitted = replace(fitted, unknowns=unknowns)
    solution = fitted.solve(rough.point[shown], evaluations, rough.size, progress)
    intervals, problem = intervals_of(fitted, solution), replace(problem, unknowns=unknowns)
    return Identification.of(data.logs, data.still, problem, solution, intervals, hidden, fitted)
