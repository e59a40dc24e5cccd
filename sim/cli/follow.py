"""Robots follow one setpoint from seeded poses: what the commands that run a simulation share."""

from __future__ import annotations

import time
import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.validate import integer, number
from sim import Robot, Rollout, Runner, SetpointWarning
from sim.cli.progress import bar


class Followed(NamedTuple):
    """A rollout, where it began (envs, dof) [rad or m], its sim steps per env, and the seconds it took."""

    rollout: Rollout
    start: NDArray[np.float64]
    steps: int
    wall: float


def start_poses(robot: Robot, num_envs: int, spread: float, seed: int) -> NDArray[np.float64]:
    """Poses (envs, dof) [rad or m] around the robot's start pose, inside its limits; env 0 is that pose itself.

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


def duration(seconds: float) -> float:
    """``seconds`` if a run can last so long; checked before anything is started."""
    return number("seconds", seconds, 1e-6, 1e6, "simulated time")


def follow(runner: Runner, setpoint: NDArray[Any], start: NDArray[np.float64], seconds: float, label: str) -> Followed:
    """Reset a fresh runner to ``start`` and hold ``setpoint`` (dof,) or (envs, dof) for ``seconds``, under a bar.

    Runs whole ticks, two at least.
    """
    ticks = max(2, round(seconds / (runner.timestep * runner.substeps)))
    shape = (ticks, runner.num_envs, runner.robot.dof)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SetpointWarning)  # the report at the end says it
        runner.reset(qpos=start)
        began = time.perf_counter()
        rollout = runner.rollout(np.broadcast_to(setpoint, shape), progress=bar(label, unit="tick"))
        wall = time.perf_counter() - began
    return Followed(rollout, start, ticks * runner.substeps, wall)
