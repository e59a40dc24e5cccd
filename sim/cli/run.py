"""Runs of the commands: to a setpoint, over the moves that gains are compared on, or read from a recording."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Document, Rows
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Rollout, Runner, read_recording
from batchpid.sim.cli.flags import MeshOptions
from batchpid.sim.cli.outputs import bar
from batchpid.sim.cli.report import run_report, tool_report, trajectory_report
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.runner_keywords import DEFAULT_ENGINE
from batchpid.sim.setpoint_files import Setpoints
from batchpid.sim.tuning.evaluation import (
    Evaluation,
    evaluate_gains,
    following_error,
    run_moves,
    step_response_metrics,
)
from batchpid.sim.tuning.gain_sets import GainSet
from batchpid.sim.tuning.moves import Moves, random_moves, tutorial_move
from batchpid.sim.tuning.randomization_presets import at_the_joints, reseeded
from batchpid.task_space.frames import pose_error

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Axes of the error of a pose."""


def start_poses(
    robot: Robot, num_envs: int, spread: float, seed: int, center: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return poses (envs, dof) [rad or m] around ``center``, inside the limits; env 0 is that pose itself.

    The center is by default the robot's start pose. Uniform within ``spread`` [rad or m], and within a quarter of the
    joint's range where that is less. Row k is the same for any ``num_envs``.
    """
    random = np.random.default_rng(seed)
    reach = np.minimum(spread, (robot.upper - robot.lower) / 4)
    center = robot.start if center is None else center
    poses = center + reach * random.uniform(-1.0, 1.0, (num_envs, robot.dof))
    poses[0] = center
    return robot.coupled(np.clip(poses, robot.lower, robot.upper))


def hold_setpoint(runner: Runner, start: Rows, setpoint: Rows, seconds: float) -> tuple[Rollout, str]:
    """Hold ``setpoint`` (dof,) from ``start`` (envs, dof) for ``seconds``; return the rollout and a report on it."""
    moves = Moves(start, np.broadcast_to(setpoint, start.shape), ("to the setpoint",) * len(start))
    began = time.perf_counter()
    rollout, metrics = run_moves(runner, moves, seconds, bar("simulating", unit="tick"))
    return rollout, run_report(runner, rollout, metrics, time.perf_counter() - began)


def hold_pose(runner: Runner, start: Rows, goal: Rows, seconds: float) -> tuple[Rollout, str]:
    """Hold the pose ``goal`` (7,) of a tool from ``start`` (envs, dof) for ``seconds``; return rollout and report."""
    began = time.perf_counter()
    runner.reset(start, seed=None if runner.options.randomization is None else 0)
    ticks = max(2, round(seconds / (runner.timestep * runner.substeps)))
    rollout = runner.rollout(np.tile(goal, (ticks, 1)), progress=bar("simulating", unit="tick"))
    return rollout, tool_report(runner, rollout, time.perf_counter() - began)


def follow(runner: Runner, start: Rows, setpoints: Setpoints, rates: bool) -> tuple[Rollout, str]:
    """Follow setpoints of a file from ``start`` (envs, dof), with rates or without; return the rollout and a report."""
    began = time.perf_counter()
    runner.reset(start, seed=None if runner.options.randomization is None else 0)
    rollout = runner.rollout(
        setpoints.position,
        setpoint_rates=setpoints.rate if rates else None,
        setpoint_accelerations=setpoints.acceleration if rates else None,
        progress=bar("simulating", unit="tick"),
    )
    return rollout, trajectory_report(runner, rollout, setpoints if rates else None, time.perf_counter() - began)


def run_figures(robot: Robot, rollout: Rollout) -> Document:
    """Return the figures of a rollout for --json, lists by env: of steps, or of setpoints that move, or of a tool."""
    info, failed = rollout.info, np.flatnonzero(~rollout.ok.all(0))
    about = {name: getattr(info, name) for name in ("robot", "control", "engine", "physics")}
    seconds = rollout.tick * len(rollout.time)
    figures: Document = about | {"num_envs": rollout.num_envs, "seconds": seconds, "failed": failed}
    if rollout.tool_pose is not None:
        error = np.abs(pose_error(rollout.setpoint[-1, :, :7], rollout.tool_pose[-1].astype(float)))
        return figures | {"tool": info.tool, "final_error": dict(zip(AXES, error.T, strict=True))}
    if (rollout.setpoint != rollout.setpoint[0]).any():
        columns = {"following_error": following_error(robot, rollout)}
    else:
        start = robot.start if info.start is None else info.start.astype(np.float64)
        with_effort = info.control != "drive"
        columns = step_response_metrics(robot, rollout, start, with_effort=with_effort)._asdict()
    joints = zip(robot.joint_names, robot.units, strict=True)
    of_joints = {name: {"unit": unit} for name, unit in joints}
    for column, rows in columns.items():
        for name, figure in zip(robot.joint_names, np.asarray(rows).T, strict=True):
            of_joints[name][column] = figure
    return figures | {"joints": of_joints}


def evaluate_sets(
    robot: Robot,
    sets: Sequence[GainSet],
    *,
    moves: int,
    seed: int,
    randomization: Randomization | None,
    engines: Sequence[str] = (DEFAULT_ENGINE,),
    **options: Any,
) -> list[Evaluation]:
    """Evaluate ``sets`` in ``engines``, on the tutorial's move and random ``moves`` that no search with ``seed`` sees.

    ``options`` go to :func:`batchpid.sim.tuning.evaluation.evaluate_gains`. Of the actuators, those at the joints act
    on drives.
    """
    titles = {engine: load_engine(engine).title for engine in engines}
    unseen = tutorial_move(robot) + random_moves(robot, moves, seed + 1)

    def evaluate(each: GainSet, engine: str) -> Evaluation:
        drawn = reseeded(randomization, seed + 1)
        drawn = at_the_joints(drawn) if each.control == "drive" else drawn
        name = each.name if len(titles) == 1 else f"{each.name}, {titles[engine]}"
        known = options | {"name": name, "control": each.control, "randomization": drawn, "engine": engine}
        known["follow"] = True
        return evaluate_gains(robot, each.params, unseen, **known)

    return [evaluate(*each) for each in bar("comparing", unit="set")(list(product(sets, titles)))]


def read_run(path: Path, robot: str | None, meshes: MeshOptions, usage: str) -> tuple[Rollout, Robot]:
    """Return the run in a file and its robot: that name or URDF, or the bundled robot that was recorded.

    ``usage`` is a command that names the robot, for the error message. A recording is untrusted input, so no path in it
    is opened. Raises InvalidArgumentError if the file cannot be read; or no robot is named, and the recorded one is not
    a bundled robot, or differs from the bundled robot of the same name.
    """
    rollout = read_recording(path)
    name, description = rollout.info.robot, rollout.info.urdf
    if robot is not None:
        return rollout, Robot.load(robot, **vars(meshes))
    found = Robot.load(name, **vars(meshes)) if name in Robot.bundled() else None
    if found is None or description not in (None, found.urdf):
        problem = "is not bundled" if found is None else "is another one than the bundled robot of that name"
        raise InvalidArgumentError("robot", f"{name!r} of the recording {problem}", remedy=f"name its URDF: {usage}")
    return rollout, found
