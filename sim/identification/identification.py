"""Identification of motors from logs: regression, fit, uncertainty, and the error on the held-out part."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.arrays.digest import digest
from batchpid.checks.validate import choice, flag, instance, integer, number
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.io.versions import package_versions
from batchpid.motors.actuator_files import dumps_actuators, loads_actuators
from batchpid.sim.engine import native
from batchpid.sim.identification.fit import Solution, Step
from batchpid.sim.identification.fit_history import History, State
from batchpid.sim.identification.fit_search import NEIGHBOUR_EVALUATIONS, Progress, search
from batchpid.sim.identification.logged_control import Drive
from batchpid.sim.identification.logs import Log, LogWarning, at_limits, checked, read_logs
from batchpid.sim.identification.plant import Motors, Plant
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import Motion, Regression, best_drive, hypotheses, smooth
from batchpid.sim.identification.result import Fit, Identification, actuators_at
from batchpid.sim.identification.start import begin
from batchpid.sim.identification.statistics import EXPLAINED, misfit, uncertainty
from batchpid.sim.identification.unknowns import Unknowns
from batchpid.sim.identification.windows import rows_of
from batchpid.sim.robot.parts import FileDefaults
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner_keywords import Compensation

STILL, SHARE, SHAKEN = {"rad": 1e-3, "m": 1e-4}, 0.01, 1.5
"""Standard deviation of the positions up to which a joint did not move: absolute, or as a share of the joint with the
largest one, whichever is less; or over the noise from row to row."""


def identify(
    robot: Robot,
    logs: Iterable[str | os.PathLike[str] | Log],
    *,
    params: bp.PIDParams | None = None,
    compensate: Compensation | None = None,
    timestep: float | None = None,
    sim_steps: int = 1,
    payload: bool = True,
    hold: bool = False,
    evaluations: int = 25,
    seed: int = 0,
    workers: int | None = None,
    history: Path | str | None = None,
    progress: Callable[[Any], Any] | None = None,
) -> Identification:
    """Find the motors of ``robot`` from logs of its motion.

    Parameters
    ----------
    logs
        Files (:mod:`batchpid.sim.identification.logs`), or logs that were read.
    params
        Params of the PID law that drove the robot, of all its joints or of those in the logs: the setpoints of the logs
        are used. None: the efforts.
    compensate
        Forces that the robot compensates by itself, or "none". The fit determines whether the compensation passes
        through the motors. For a log of the complete efforts, compensation included, use "none"; where the log shows
        it, the fit determines this, too. Default: as the recordings say, else "gravity+coriolis+friction".
    timestep
        Time step of the control that drove the robot [s]. Default: as the recordings say, else 1/2000.
    sim_steps
        Number of sim steps in each. Use more than one if the robot, or its simulator, moved in smaller steps than its
        control, as a real robot under control at 500 Hz or less. Otherwise half the difference of the steps counts as
        delay.
    payload
        Find a payload at the tool, too.
    hold
        Commands hold from row to row of a file: :func:`batchpid.sim.identification.logs.read_logs`.
    evaluations
        Largest number of evaluations of each fit, with and without noise in the law. An evaluation simulates the robot
        and, for each unknown, a perturbed robot.
    seed
        Seed of CMA-ES, which finds the start of the fit.
    workers
        Number of processes, 0 for this one; the result does not depend on it. Default: one per available core.
    history
        File (.json), written before each step. If it exists the fit resumes from it.
    progress
        Wraps the range of evaluations, e.g. ``tqdm.tqdm``; it may have ``set_postfix``.

    Raises
    ------
    InvalidArgumentError
        An option is out of range or contradicts a recording, a file holds no log of this robot, or a history is of
        another fit.
    MissingDependencyError
        A package is missing.

    Warns
    -----
    LogWarning
        A joint is at a limit.
    """
    for package in ("scipy", "cmaes"):
        if find_spec(package) is None:
            raise MissingDependencyError(package, "identification", "tune")
    instance("robot", robot, Robot, "load one with Robot.load('panda') or a URDF path")
    sim_steps = integer("sim_steps", sim_steps, 1, 100)
    evaluations, seed = integer("evaluations", evaluations, 1, 1000), integer("seed", seed, 0, 2**31 - 1)
    if workers is not None:
        integer("workers", workers, 0, 1024)
    payload, kind = flag("payload", payload), "effort" if params is None else "setpoint"
    found = _logs(robot, logs, kind, flag("hold", hold))
    control = number("timestep", _recorded("timestep", timestep, found, 1 / 2000), 1e-5, 0.01, "seconds")
    compensate = _recorded("compensate", compensate, found, "gravity+coriolis+friction")
    choice("compensate", compensate, ("gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"))
    timestep = control / sim_steps
    logged = found[0].joints
    found, resting, still = _without_still(robot, found)
    joints = found[0].joints
    if params is not None:
        params = _of_joints(instance("params", params, bp.PIDParams, "load them with load_params()"), robot, logged)
        params = params.for_joints([logged.index(joint) for joint in joints])
    measured = params is not None and params.measurement_rate is not None
    settings = {
        **resting.describe(),
        "still": still,
        "logs": [log.source for log in found],
        "data": digest([replace(log, source="") for log in found]),
        "command": kind,
        "params": None if params is None else digest(params),
        "compensate": compensate,
        "timestep": control,
        "sim_steps": sim_steps,
        "payload": payload,
        "evaluations": evaluations,
        "seed": seed,
        "native": native.status().active,
        "versions": package_versions(("batchpid", "sapien", "numpy", "scipy", "cmaes")),
    }
    record = History(history, settings)
    assumed = Drive(timestep, params, compensate.removesuffix("+friction"), substeps=sim_steps, measured_rate=measured)
    motions = [smooth(log, timestep) for log in found]
    drive, regression = best_drive(resting, joints, assumed, found, motions, payload)
    unknowns = _unknowns(resting, joints, drive, regression.best.motors, motions, payload)
    ideal = _ideal(robot, joints)
    processes = len(os.sched_getaffinity(0)) if workers is None else workers
    pool: Any = nullcontext()
    if processes > 1:
        verdict: Any = {"initializer": native.take_verdict, "initargs": (native.environment(),)}
        pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), **verdict)
    with pool as executor:

        def fit_under(drive: Drive, regression: Regression, record: History) -> tuple[Problem, Solution]:
            """Return the likeliest fit under ``drive``."""
            problems = [
                Problem(resting, joints, each, found, motions, unknowns, executor) for each in _variants(drive, motions)
            ]
            known = record.state(len(unknowns.names), max(evaluations, NEIGHBOUR_EVALUATIONS), len(problems))
            state = known or State(Step.first(begin(problems[0], regression, ideal, seed), evaluations))
            return search(problems, state, evaluations, record, Progress(len(problems), evaluations, progress))

        fits_of_ways = [fit_under(drive, regression, record)]
        if misfit(*fits_of_ways[0]) > EXPLAINED:  # then the regression may have chosen the wrong compensation
            for way in hypotheses(assumed, payload):
                if way.compensation != drive.compensation:
                    other = Regression(Plant(resting, joints, way), found, motions, payload)
                    fits_of_ways.append(fit_under(way, other, History(None, settings)))
        problem, best = min(fits_of_ways, key=lambda each: each[1].cost)
        before, after = problem.residuals(unknowns.point(ideal)[None]), [window.residual for window in best.windows]
        sure = uncertainty(problem, best)
        saved = problem.residuals(_saved(robot, joints, unknowns, best.theta)[None])
    before = [residual[0] for residual in before]
    errors = _held_out(problem, before), _held_out(problem, [residual[0] for residual in saved])
    if not errors[1] < errors[0]:  # the fit failed: nothing is known
        sure = sure._replace(identified=np.zeros_like(sure.identified))
    fits = tuple(
        Fit(w.log, found[w.log].time[rows_of(w)], w.fitted, b, a)
        for w, b, a in zip(problem.windows, before, after, strict=True)
    )
    fitted = np.concatenate([r[w.fitted] for r, w in zip(after, problem.windows, strict=True)])
    noise = np.sqrt((fitted**2).mean(0))
    return Identification(
        robot,
        joints,
        unknowns,
        best.theta,
        sure,
        (errors[0], errors[1]),
        misfit(problem, best),
        noise,
        problem.drive,
        settings,
        fits,
    )


def _variants(drive: Drive, motions: list[Motion]) -> list[Drive]:
    """Return the possible measurements of the law: with or without sensor noise, rates or differences of positions.

    Without noise, the law gets the simulated positions and rates.
    """
    if drive.params is None:
        return [drive]
    quiet = replace(drive, measured_rate=False)
    seen = any(motion.sensor.size.any() for motion in motions)
    return [*([replace(quiet, noisy=True)] if seen else []), quiet, *([drive] if drive.measured_rate else [])]


def _logs(robot: Robot, logs: Iterable[Any], kind: Any, hold: bool) -> list[Log]:
    given = [logs] if isinstance(logs, str | os.PathLike | Log) else list(logs)
    found = [
        log
        for each in given
        for log in (checked(robot, each) if isinstance(each, Log) else read_logs(robot, [each], kind, hold=hold))
    ]
    if not found:
        raise InvalidArgumentError("logs", "are missing", remedy="name one file or more")
    for log in found:
        if log.joints != found[0].joints:
            raise InvalidArgumentError(
                log.source, f"holds other joints than {found[0].source}", remedy="fit them one by one"
            )
        if log.kind != kind:
            remedy = "give the params that drove the robot" if log.kind == "setpoint" else "give no params"
            raise InvalidArgumentError(log.source, f"holds {log.kind}s", remedy=remedy)
        if stopped := at_limits(robot, log):
            message = "; ".join(stopped) + ": stops are not part of the model; record between the limits"
            warnings.warn(message, LogWarning, stacklevel=4)
    return found


def _without_still(robot: Robot, logs: list[Log]) -> tuple[list[Log], Robot, list[str]]:
    """Return the logs without joints that do not move, the robot that rests where they are, and their names.

    Such a joint is jammed, braked or not driven: the model of a motor does not describe it.
    """
    joints, qpos = logs[0].joints, np.concatenate([log.qpos for log in logs])
    noise = np.sqrt(np.mean(np.concatenate([np.diff(log.qpos, axis=0) for log in logs]) ** 2, axis=0) / 2)
    moved = qpos.std(0)
    least = np.clip(SHARE * moved.max(), 1e-9, [STILL[robot.units[joint]] for joint in joints])
    moves = moved > np.maximum(least, SHAKEN * noise)
    if moves.all():
        return logs, robot, []
    names = [robot.joint_names[joint] for joint, each in zip(joints, moves, strict=True) if not each]
    listed = ", ".join(map(repr, names))
    if not moves.any():
        problem = f"show no motion of any joint ({listed})"
        raise InvalidArgumentError("logs", problem, remedy="record a motion, such as one of batchpid excite")
    start = robot.start
    start[[joint for joint, each in zip(joints, moves, strict=True) if not each]] = qpos.mean(0)[~moves]
    message = f"{listed} did not move: left out, and held where the logs have it; its motor cannot be identified"
    warnings.warn(message, LogWarning, stacklevel=3)
    kept = tuple(joint for joint, each in zip(joints, moves, strict=True) if each)
    found = [
        replace(
            log,
            joints=kept,
            qpos=log.qpos[:, moves],
            qvel=None if log.qvel is None else log.qvel[:, moves],
            command=log.command[:, moves],
        )
        for log in logs
    ]
    return found, replace(robot, settings=None, defaults=FileDefaults(start)), names


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


def _unknowns(
    robot: Robot, joints: tuple[int, ...], drive: Drive, motors: Motors, motions: list[Motion], payload: bool
) -> Unknowns:
    """Return the unknowns with typical sizes from the motion."""
    plant = Plant(robot, joints, drive)
    qpos = np.concatenate([motion.qpos[::200] for motion in motions])
    matrix = plant.mass_matrix(qpos, np.zeros((len(qpos), 1)))
    links, armature = np.diagonal(matrix, axis1=1, axis2=2).mean(0), motors.armature[0]
    inertia = links + armature
    speed, acceleration = (
        np.sqrt(np.mean(np.concatenate([getattr(motion, name) for motion in motions]) ** 2, axis=0))
        for name in ("qvel", "qacc")
    )
    speed = np.maximum(speed, 1e-3)
    effort = np.maximum(inertia * acceleration + motors.friction[0], inertia * 0.1)
    return Unknowns.of(links, armature, effort, speed, payload)


def _ideal(robot: Robot, joints: tuple[int, ...]) -> Motors:
    """Return the motors according to the robot's description."""
    zero, own = np.zeros((1, len(joints))), list(joints)
    damping, friction, none = robot.damping[None, own], robot.friction[None, own], np.zeros((1, 1))
    return Motors(zero, damping, friction, zero + 1, zero, none, none, none)


def _saved(robot: Robot, joints: tuple[int, ...], unknowns: Unknowns, theta: Float64) -> Float64:
    """Return ``theta`` as its actuators file describes it, with the stopping time and payload of ``theta``."""
    text = dumps_actuators(actuators_at(robot, joints, unknowns, theta), robot.joint_names)
    read = loads_actuators(text, robot.joint_names)[0]
    own, found = list(joints), unknowns.motors(theta[None])
    columns = {
        "armature": read.armature,
        "damping": robot.damping + (0.0 if read.viscous is None else read.viscous),
        "friction": robot.friction + (0.0 if read.coulomb is None else read.coulomb),
        "strength": read.strength,
        "bias": read.bias,
    }
    ideal = {"strength": 1.0}
    per_joint = {
        kind: np.full((1, len(own)), ideal.get(kind, 0.0)) if leaf is None else np.atleast_2d(leaf)[:, own]
        for kind, leaf in columns.items()
    }
    delay = np.zeros((1, 1)) if read.command_delay is None else np.asarray(read.command_delay, float)[:1, :1]
    return unknowns.point(found._replace(**per_joint, delay=delay))


def _held_out(problem: Problem, residuals: list[Float64]) -> float:
    """Return the root mean square of the residuals on the held-out rows."""
    kept = [r[~w.fitted] for r, w in zip(residuals, problem.windows, strict=True)]
    with np.errstate(invalid="ignore", over="ignore"):
        error = float(np.sqrt((np.concatenate(kept) ** 2).mean()))
    return error if np.isfinite(error) else float("inf")
