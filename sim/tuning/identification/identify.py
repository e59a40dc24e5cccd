"""Identification of motors from logs: regression, fit, uncertainty, and the error on the part that was kept."""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.validate import choice, flag, instance, integer, number
from batchpid.versions import package_versions
from sim.options import Compensation
from sim.robot.robot import Robot
from sim.tuning.identification.fit import MAX_ITERATIONS, Problem, State, cost_of, fit
from sim.tuning.identification.history import History
from sim.tuning.identification.logs import Log, read_logs
from sim.tuning.identification.plant import Drive, Motors, Plant
from sim.tuning.identification.regression import STRONG_PRIOR, Motion, best_start, regress
from sim.tuning.identification.result import Fit, Identification
from sim.tuning.identification.statistics import uncertainty
from sim.tuning.identification.unknowns import Unknowns
from sim.tuning.identification.windows import rows_of

Float64 = NDArray[np.float64]
RANDOM_STARTS, START_SPREAD = 8, 0.3
"""Random points at which a fit may begin, and their standard deviation in typical sizes of the unknowns."""


def identify(
    robot: Robot,
    logs: Iterable[str | os.PathLike[str] | Log],
    *,
    params: bp.PIDParams | None = None,
    compensate: Compensation = "gravity+coriolis+friction",
    timestep: float = 1 / 2000,
    payload: bool = True,
    hold: bool = False,
    iterations: int = MAX_ITERATIONS,
    seed: int = 0,
    workers: int | None = None,
    history: Path | str | None = None,
    progress: Callable[[Any], Any] | None = None,
) -> Identification:
    """Find the motors of ``robot`` from logs of its motion.

    Parameters
    ----------
    logs
        Files (:mod:`sim.tuning.identification.logs`), or logs that were read.
    params
        Params of the PID law that drove the robot, of all its joints or of those in the logs: the setpoints of the logs
        are used. None: the efforts.
    compensate
        What the robot compensates by itself, "none" for nothing. Whether that passes through its motors is found. A
        log of efforts that holds them in full has "none"; where the log tells, this is found, too.
    timestep
        Time step of the control that drove the robot, and of the simulation [s].
    payload
        Find a payload at the tool, too.
    hold
        Commands hold from row to row of a file: :func:`sim.tuning.identification.logs.read_logs`.
    iterations
        Most Gauss-Newton steps.
    seed
        Of the random starts. The fit begins where the simulated motion is nearest to the log: at the regression's
        result, at ideal motors, or at one of RANDOM_STARTS points around the first.
    workers
        Number of processes, 0 for this one; the result does not depend on it. Default: one per available core.
    history
        JSON file, written after each step. If it exists the fit resumes from it.
    progress
        Wraps the range of steps, e.g. ``tqdm.tqdm``; it may have ``set_postfix``.

    Raises
    ------
    InvalidArgumentError
        An option is out of range, a file holds no log of this robot, or a history is of another fit.
    MissingDependencyError
        The package ``scipy`` is missing.
    """
    if find_spec("scipy") is None:
        raise MissingDependencyError("scipy", "identification", "tune")
    instance("robot", robot, Robot, "load one with Robot.load('panda') or a URDF path")
    choice("compensate", compensate, ("gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"))
    timestep = number("timestep", timestep, 1e-5, 0.01, "seconds")
    iterations, seed = integer("iterations", iterations, 1, 1000), integer("seed", seed, 0, 2**31 - 1)
    if workers is not None:
        integer("workers", workers, 0, 1024)
    payload, kind = flag("payload", payload), "effort" if params is None else "setpoint"
    found = _logs(robot, logs, kind, flag("hold", hold))
    joints = found[0].joints
    if params is not None:
        params = _of_joints(instance("params", params, bp.PIDParams, "load them with load_params()"), robot, joints)
    measured = params is not None and params.measurement_rate is not None
    drive = Drive(timestep, params, compensate.removesuffix("+friction"), measured_rate=measured)
    drive, start, motions = best_start(robot, joints, drive, found, payload)
    unknowns = _unknowns(robot, joints, drive, start.motors, motions, payload)
    settings = {
        "robot": robot.name,
        "logs": [log.source for log in found],
        "command": kind,
        "compensate": compensate,
        "timestep": timestep,
        "payload": payload,
        "iterations": iterations,
        "seed": seed,
        "data": hashlib.sha256(
            pickle.dumps([(m.command, log.qpos) for m, log in zip(motions, found, strict=True)])
        ).hexdigest(),
        "versions": package_versions(("batchpid", "sapien", "numpy", "scipy")),
    }
    record = History(history, settings)
    processes = len(os.sched_getaffinity(0)) if workers is None else workers
    pool: Any = ProcessPoolExecutor(processes, mp_context=get_context("spawn")) if processes > 1 else nullcontext()
    with pool as executor:
        problem = Problem(robot, joints, drive, found, motions, unknowns, executor)
        nominal = unknowns.point(_nominal(robot, joints))
        safe = regress(Plant(robot, joints, drive), found, motions, payload, STRONG_PRIOR)
        points = [*map(unknowns.point, (start.motors, safe.motors)), nominal]
        points += _random_starts(unknowns, points[0], seed)
        begin = record.state or State(min(map(unknowns.clip, points), key=lambda theta: _cost(problem, theta)))
        best = fit(problem, begin, iterations=iterations, record=record.write, progress=progress)
        before, after = (problem.evaluate(theta, jacobian=False) for theta in (nominal, best.theta))
        sure = uncertainty(problem, best)
    errors = tuple(_held_out(problem, windows) for windows in (before, after))
    if not errors[1] < errors[0]:  # the fit failed: nothing is known
        sure = sure._replace(identified=np.zeros_like(sure.identified))
    fits = tuple(
        Fit(w.log, found[w.log].time[rows_of(w)], w.fitted, b, a)
        for w, (b, _), (a, _) in zip(problem.windows, before, after, strict=True)
    )
    return Identification(
        robot, joints, unknowns, best.theta, sure, (errors[0], errors[1]), best.sigma, drive, settings, fits
    )


def _logs(robot: Robot, logs: Iterable[Any], kind: Any, hold: bool) -> list[Log]:
    given = [logs] if isinstance(logs, str | os.PathLike | Log) else list(logs)
    found = [
        log
        for each in given
        for log in ([each] if isinstance(each, Log) else read_logs(robot, [each], kind, hold=hold))
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
    return found


def _of_joints(params: bp.PIDParams, robot: Robot, joints: tuple[int, ...]) -> bp.PIDParams:
    """Return the params of ``joints``, one row."""
    if params.num_envs != 1:
        raise InvalidArgumentError("params", f"hold {params.num_envs} envs", remedy="give those of the logged robot")
    if params.num_joints == len(joints):
        return params
    if params.num_joints != robot.dof:
        problem = f"hold {params.num_joints} joints; the robot has {robot.dof}, the logs {len(joints)}"
        raise InvalidArgumentError("params", problem, remedy="give one gain per joint of the robot")
    return bp.PIDParams(*(leaf[:, list(joints)] if getattr(leaf, "ndim", 0) == 2 else leaf for leaf in params))


def _unknowns(
    robot: Robot, joints: tuple[int, ...], drive: Drive, motors: Motors, motions: list[Motion], payload: bool
) -> Unknowns:
    """Return the unknowns with typical sizes from the motion."""
    plant = Plant(robot, joints, drive)
    qpos = np.concatenate([motion.qpos[::200] for motion in motions])
    matrix = plant.mass_matrix(qpos, np.zeros((len(qpos), 1)))
    inertia = np.diagonal(matrix, axis1=1, axis2=2).mean(0) + motors.armature[0]
    speed, acceleration = (
        np.sqrt(np.mean(np.concatenate([getattr(motion, name) for motion in motions]) ** 2, axis=0))
        for name in ("qvel", "qacc")
    )
    speed = np.maximum(speed, 1e-3)
    effort = np.maximum(inertia * acceleration + motors.friction[0], inertia * 0.1)
    return Unknowns.of(inertia, effort, speed, payload)


def _nominal(robot: Robot, joints: tuple[int, ...]) -> Motors:
    """Return the motors of the robot as it is described."""
    zero, own = np.zeros((1, len(joints))), list(joints)
    damping, friction, none = robot.damping[None, own], robot.friction[None, own], np.zeros((1, 1))
    return Motors(zero, damping, friction, zero + 1, zero, none, none, none)


def _random_starts(unknowns: Unknowns, center: Float64, seed: int) -> list[Float64]:
    """Return points around ``center``."""
    draws = np.random.default_rng(seed).standard_normal((RANDOM_STARTS, len(center)))
    return list(center + START_SPREAD * unknowns.scale * draws)


def _cost(problem: Problem, theta: Float64) -> float:
    """Return the cost of a point."""
    return cost_of(problem, problem.evaluate(theta, jacobian=False))[0]


def _held_out(problem: Problem, windows: list[Any]) -> float:
    """Return the root mean square of the residuals on the rows that were kept."""
    kept = [r[~w.fitted] for (r, _), w in zip(windows, problem.windows, strict=True)]
    with np.errstate(invalid="ignore", over="ignore"):
        error = float(np.sqrt((np.concatenate(kept) ** 2).mean()))
    return error if np.isfinite(error) else float("inf")
