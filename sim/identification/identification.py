"""Identification of motors from logs: regression, fit, uncertainty, and the error on the held-out part."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.arrays.digest import digest
from batchpid.checks.validate import choice, flag, integer
from batchpid.errors import InvalidArgumentError
from batchpid.io.versions import package_versions
from batchpid.motors.actuator_files import dumps_actuators, loads_actuators
from batchpid.native.availability import obstacle
from batchpid.sim.identification.diagnosis import diagnose
from batchpid.sim.identification.effort_ratios import EffortRatios, effort_ratios
from batchpid.sim.identification.fit import FitStep, Solution
from batchpid.sim.identification.fit_search import (
    NEIGHBOUR_EVALUATIONS,
    Progress,
    State,
    begin,
    best_drive,
    extended,
    hypotheses,
    search,
    variants,
)
from batchpid.sim.identification.held_out import error_of, ideal_motors, motors_of, residuals_of_ideal
from batchpid.sim.identification.inputs import read_inputs
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.plant import Plant, plants_of
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import Motion, Regression, smooth
from batchpid.sim.identification.result import Fit, Identification, actuators_at
from batchpid.sim.identification.statistics import LARGEST_MISFIT, misfits, uncertainty
from batchpid.sim.identification.unknowns import EXTRAS, KINDS, LAW, Motors, Unknowns
from batchpid.sim.identification.windows import rows_of
from batchpid.sim.options import worker_count
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner_keywords import Compensation
from batchpid.sim.tuning.history import HistoryFile


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
    extras: Sequence[str] = (),
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
        Files (:mod:`batchpid.sim.identification.logs`), lists of logs with settings of their own
        (:mod:`batchpid.sim.identification.log_lists`), or logs that were read.
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
        Find a payload at the tool, too. Efforts that were measured then count as exact; otherwise their scale is found
        as strength.
    hold
        Commands hold from row to row of a file: :func:`batchpid.sim.identification.logs.read_logs`.
    extras
        Effects to try beside those of every fit, by name. Each is kept at the joints whose error on the held-out part
        falls: "load_friction", "stribeck" (friction at rest and the speed at which it has fallen), "offset" (of the
        encoder); and of the law in the robot, for logs of setpoints, "saturation" (its effort limit), "slew" (the limit
        of the setpoints' rate), "kd" (a factor of that gain). "gain" is a factor of all gains of a law of which only
        the form is known; the strength, which has the same effect, is then 1.
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
        A joint is at a limit, or did not move.
    """
    evaluations, seed = integer("evaluations", evaluations, 1, 1000), integer("seed", seed, 0, 2**31 - 1)
    processes = worker_count(workers)
    payload, gains_known = flag("payload", payload), "gain" not in extras
    for name in extras:
        choice("extras", name, [*EXTRAS, "gain"])
    resting, found, assumed, still = inputs = read_inputs(robot, logs, params, compensate, timestep, sim_steps, hold)
    if params is None and (of_law := [name for name in extras if name in LAW]):
        remedy = "leave it out, or give the params of the law"
        raise InvalidArgumentError("extras", "is of a law, and the logs hold efforts", value=of_law[0], remedy=remedy)
    joints, params, timestep = inputs.joints, assumed.params, assumed.timestep
    settings = {
        **resting.describe(),
        "still": still,
        "logs": [log.source for log in found],
        "data": digest([replace(log, source="", settings=log.settings._replace(robot=None)) for log in found]),
        "robots": digest([own and own.describe() for own in (log.settings.robot for log in found)]),
        "command": found[0].kind,
        "params": None if params is None else digest(params),
        "compensate": assumed.compensate,
        "timestep": assumed.timestep * assumed.substeps,
        "sim_steps": assumed.substeps,
        "payload": payload,
        "extras": [*extras],
        "evaluations": evaluations,
        "seed": seed,
        "native": not obstacle(),
        "versions": package_versions(("batchpid", "sapien", "numpy", "scipy", "cmaes")),
    }
    record = HistoryFile(history, "fit", settings)
    motions = [smooth(log, timestep) for log in found]
    fitted = [log for log in found if not log.settings.held_out]
    fitted_motions = [each for each, log in zip(motions, found, strict=True) if not log.settings.held_out]
    drive, regression = best_drive(resting, joints, assumed, fitted, fitted_motions, payload, gains_known)
    unknowns = _unknowns(resting, joints, drive, regression, motions, payload)
    if not gains_known:
        unknowns = unknowns.plus(["gain"], range(len(joints)), {})
    ratios = None if found[0].measured is None else effort_ratios(inputs)
    unknowns = unknowns.without(_known(found[0], payload, ratios))
    ideal = ideal_motors(robot, joints)
    pool: Any = nullcontext()
    if processes > 1:
        pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"))
    with pool as executor:

        def fit_under(drive: LoggedDrive, regression: Regression, record: HistoryFile) -> tuple[Problem, Solution]:
            """Return the likeliest fit under ``drive``."""
            problems = [
                Problem(resting, joints, each, found, motions, unknowns, executor) for each in variants(drive, motions)
            ]
            counts = len(unknowns.names), max(evaluations, NEIGHBOUR_EVALUATIONS), len(problems)
            known = record.state(lambda found: State.of_plain(found, *counts))
            state = known or State(FitStep.first(begin(problems[0], regression, ideal, seed), evaluations))
            return search(problems, state, evaluations, record, Progress(len(problems), evaluations, progress))

        fits_of_ways, regressions = [fit_under(drive, regression, record)], {drive.compensation: regression}
        if misfits(*fits_of_ways[0]).max() > LARGEST_MISFIT:  # the compensation may be wrong
            for way in hypotheses(assumed, payload):
                if way.compensation != drive.compensation:
                    plants = plants_of(resting, joints, way, fitted)
                    regression = Regression(plants, fitted, fitted_motions, payload, gains_known)
                    regressions[way.compensation] = regression
                    fits_of_ways.append(fit_under(way, regression, HistoryFile(None, "fit", settings)))
        problem, best = min(fits_of_ways, key=lambda each: each[1].cost)
        for name in extras:
            if name in EXTRAS:
                problem, best = extended(problem, best, EXTRAS[name])
        unknowns = problem.unknowns
        before, after = residuals_of_ideal(problem, robot), [window.residual for window in best.windows]
        sure = uncertainty(problem, best)
        saved = problem.residuals(_saved(robot, joints, unknowns, best.theta)[None])
    errors = error_of(problem, before), error_of(problem, saved)
    if not errors[1] < errors[0]:  # the fit failed: nothing is known
        sure = sure._replace(identified=np.zeros_like(sure.identified))
    fits = tuple(
        Fit(w.log, found[w.log].time[rows_of(w)], w.fitted, b[0], a)
        for w, b, a in zip(problem.windows, before, after, strict=True)
    )
    errors_of_fit = np.concatenate([r[w.fitted] for r, w in zip(after, problem.windows, strict=True)])
    noise = np.sqrt((errors_of_fit**2).mean(0))
    names = [robot.joint_names[joint] for joint in joints]
    diagnosis = diagnose(regressions[problem.drive.compensation], fitted, names)
    estimate = best.theta
    if ratios is not None:
        own = [at for at, (kind, _) in enumerate(ratios.names) if kind in unknowns.known]
        unknowns = unknowns.plus_known(tuple(ratios.names[at] for at in own))
        more = [ratios.names[at][0] for at in own], ratios.estimate[own], ratios.deviation[own]
        estimate, sure = np.append(estimate, more[1]), sure.plus(*more)
    return Identification(
        robot,
        joints,
        unknowns,
        estimate,
        sure,
        (errors[0], errors[1]),
        misfits(problem, best),
        noise,
        problem.drive,
        settings,
        fits,
        diagnosis,
    )


def _known(log: Log, payload: bool, ratios: EffortRatios | None) -> Motors:
    """Return the values of kinds that are no unknowns of a fit of logs such as ``log``.

    Measured efforts have no delay, and count as exact if a payload is to be found; else the strength is their scale.
    Behind the gear they are free of the motor's inertia and friction.
    """
    if ratios is not None:
        return ratios.values(("strength", "delay", "lag"))
    if not log.is_measured:
        return {}
    of_motor = ("armature", "damping", "friction") if log.sensor == "link" else ()
    kinds = ("delay", *of_motor, *(("strength",) if payload else ()))
    return {kind: np.full((1, 1), KINDS[kind].neutral) for kind in kinds}


def _unknowns(
    robot: Robot, joints: tuple[int, ...], drive: LoggedDrive, start: Regression, motions: list[Motion], payload: bool
) -> Unknowns:
    """Return the unknowns with typical sizes from the motion."""
    plant, motors = Plant(robot, joints, drive), start.best.motors
    qpos = np.concatenate([motion.qpos[::200] for motion in motions])
    matrix = plant.mass_matrix(qpos, np.zeros((len(qpos), 1)))
    links, armature = np.diagonal(matrix, axis1=1, axis2=2).mean(0), motors["armature"][0]
    inertia = links + armature
    speed, acceleration = (
        np.sqrt(np.mean(np.concatenate([getattr(motion, name) for motion in motions]) ** 2, axis=0))
        for name in ("qvel", "qacc")
    )
    speed = np.maximum(speed, 1e-3)
    effort = np.maximum(inertia * acceleration + motors["friction"][0], inertia * 0.1)
    known = np.flatnonzero(start.ratios_only) if start.gains_known else range(len(joints))
    return Unknowns.of(links, armature, effort, speed, payload, [*known])


def _saved(robot: Robot, joints: tuple[int, ...], unknowns: Unknowns, theta: Float64) -> Float64:
    """Return ``theta`` as its actuators file describes it, with the stopping time and payload of ``theta``."""
    text = dumps_actuators(actuators_at(robot, joints, unknowns, theta), robot.joint_names)
    found = unknowns.motors(theta[None])
    common = float(found["stopping"][0, 0]), float(found["payload"][0, 0])
    motors = motors_of(loads_actuators(text, robot.joint_names)[0], robot, joints, *common)
    return unknowns.point(motors | {name: found[name] for name in LAW if name in found})
