"""Runs of the commands: to setpoints, over the moves that gains are compared on, or read from a
recording.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Rows
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Rollout, Runner, read_recording
from batchpid.sim.cli.flags import MeshOptions
from batchpid.sim.cli.outputs import bar
from batchpid.sim.cli.report import run_report
from batchpid.sim.diagnosis.run_checks import SetpointWarning
from batchpid.sim.engine.protocol import load_engine
from batchpid.sim.options.groups import DEFAULT_ENGINE
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.tuning.evaluation import Evaluation, evaluate_gains
from batchpid.sim.tuning.gain_sets import GainSet
from batchpid.sim.tuning.moves import random_moves, tutorial_move
from batchpid.sim.tuning.randomization_files import at_the_joints, reseeded


def start_poses(
    robot: Robot, num_envs: int, spread: float, seed: int, center: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return poses (envs, dof) [rad or m] around ``center``, inside the limits; env 0 is that pose
    itself.

    The center is by default the robot's start pose. Uniform within ``spread`` [rad or m], and
    within a quarter of the joint's range where that is less. Row k is the same for any
    ``num_envs``.
    """
    random = np.random.default_rng(seed)
    reach = np.minimum(spread, (robot.upper - robot.lower) / 4)
    center = robot.start if center is None else center
    poses = center + reach * random.uniform(-1.0, 1.0, (num_envs, robot.dof))
    poses[0] = center
    return robot.coupled(np.clip(poses, robot.lower, robot.upper))


def simulate(
    runner: Runner, start: Rows, setpoints: Rows, **rates: Rows | None
) -> tuple[Rollout, str]:
    """Run ``setpoints`` (ticks, size) from rest at ``start`` (envs, dof); return the rollout and a
    report on it.
    """
    began = time.perf_counter()
    runner.reset(start, seed=None if runner.options.randomization is None else 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SetpointWarning)  # the report has the finding
        rollout = runner.rollout(setpoints, progress=bar("simulating", unit="tick"), **rates)
    return rollout, run_report(runner, rollout, time.perf_counter() - began)


def held(setpoint: Rows, seconds: float, tick: float) -> Rows:
    """Return rows (ticks, size) that hold ``setpoint`` (size,) for ``seconds``, two ticks at
    least.
    """
    return np.tile(setpoint, (max(2, round(seconds / tick)), 1))


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
    """Evaluate ``sets`` in ``engines``, on the tutorial's move and random ``moves`` that no search
    with ``seed`` sees.

    ``options`` go to :func:`batchpid.sim.tuning.evaluation.evaluate_gains`. Of the actuators, those
    at the joints act on drives.
    """
    titles = {engine: load_engine(engine).title for engine in engines}
    unseen = tutorial_move(robot) + random_moves(robot, moves, seed + 1)

    def evaluate(gains: GainSet, engine: str) -> Evaluation:
        draws = reseeded(randomization, seed + 1)
        draws = at_the_joints(draws) if gains.control == "drive" else draws
        name = gains.name if len(titles) == 1 else f"{gains.name}, {titles[engine]}"
        further = options | {"control": gains.control, "randomization": draws, "engine": engine}
        return evaluate_gains(robot, gains.params, unseen, name=name, follow=True, **further)

    return [evaluate(*pair) for pair in bar("comparing", unit="set")(list(product(sets, titles)))]


def read_run(
    path: Path, robot: str | None, meshes: MeshOptions, usage: str
) -> tuple[Rollout, Robot]:
    """Return the run in a file and its robot: that name or URDF, or the bundled robot that was
    recorded.

    ``usage`` is a command that names the robot, for the error message. A recording is untrusted
    input, so no path in it is opened. Raises InvalidArgumentError if the file cannot be read; or no
    robot is named, and the recorded one is not a bundled robot, or differs from the bundled robot
    of the same name.
    """
    rollout = read_recording(path)
    name, digest = rollout.info.robot, rollout.info.digest
    if robot is not None:
        return rollout, Robot.load(robot, **vars(meshes))
    bundled = Robot.load(name, **vars(meshes)) if name in Robot.bundled() else None
    if bundled is None or digest not in (None, bundled.digest):
        problem = (
            "is not bundled"
            if bundled is None
            else "is another one than the bundled robot of that name"
        )
        raise InvalidArgumentError(
            "robot", f"{name!r} of the recording {problem}", remedy=f"name its URDF: {usage}"
        )
    return rollout, bundled
