"""Runs of ``demo`` and ``rollout``: every env moves from a seeded pose to one setpoint."""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.validate import integer, number
from sim import Robot, Rollout, Runner, SetpointWarning
from sim.cli.progress import bar


def start_poses(robot: Robot, num_envs: int, spread: float, seed: int) -> NDArray[np.float64]:
    """Return poses (envs, dof) [rad or m] around the robot's start pose, inside its limits; env 0 is that pose itself.

    Uniform within ``spread`` [rad or m], and within a quarter of the joint's range where that is less. Row k is the
    same for any ``num_envs``.
    """
    num_envs = integer("num_envs", num_envs, 1, 1_000_000)
    spread = number("spread", spread, 0.0, 10.0, "rad or m")
    random = np.random.default_rng(integer("seed", seed, 0, 2**63 - 1))
    reach = np.minimum(spread, (robot.upper - robot.lower) / 4)
    poses = robot.start + reach * random.uniform(-1.0, 1.0, (num_envs, robot.dof))
    poses[0] = robot.start
    return np.clip(poses, robot.lower, robot.upper)


def hold_setpoint(runner: Runner, start: NDArray[Any], setpoint: NDArray[Any], seconds: float) -> tuple[Rollout, float]:
    """Reset ``runner`` to ``start`` and hold ``setpoint``, each (dof,) or (envs, dof), for ``seconds``.

    Runs whole ticks, two at least, under a progress bar. Returns the rollout and the wall-clock time it took [s].
    """
    ticks = max(2, round(seconds / (runner.timestep * runner.substeps)))
    setpoints = np.broadcast_to(setpoint, (ticks, runner.num_envs, runner.robot.dof))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SetpointWarning)  # the report lists setpoints out of limits
        runner.reset(qpos=start)
        began = time.perf_counter()
        rollout = runner.rollout(setpoints, progress=bar("simulating", unit="tick"))
        return rollout, time.perf_counter() - began
