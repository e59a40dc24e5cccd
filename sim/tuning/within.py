"""Gains on many drawn motors: stability at their delay, settling, and the motors that bind."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.sim.robot.loop_stability import StabilityReport, stability_report
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner import Runner
from batchpid.sim.tuning.evaluation import SUBSTEPS, arm_joints, run_moves, settling_limits
from batchpid.sim.tuning.moves import Moves

POSES = 3
"""Poses at which the stability bound of each draw is taken: starts and targets of the moves."""


class Within(NamedTuple):
    """Gains on drawn motors."""

    stability: StabilityReport
    """Of the least stable draw and pose; ``env`` is the number of the draw."""
    settling: Float64
    """Settling time of the slowest joint of the arm in the slowest move of each draw (draws,) [s]; inf: never."""
    excess: Float64
    """The largest settling time over the time asked for, of each draw (draws,)."""
    joints: tuple[str, ...]
    """The joint that settles last in that move, by draw."""
    moves: tuple[str, ...]
    """That move."""

    @property
    def binding(self) -> int:
        """Number of the draw with the largest excess."""
        return int(np.argmax(self.excess))

    @property
    def holds(self) -> bool:
        """True if all draws are stable, and settle in every move."""
        return self.stability.robot_ratio < 1 and bool(np.isfinite(self.settling).all())

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Figure that is less for the better gains: the settling of the worst draw, if they hold for all."""
        return not self.holds, float(self.excess.max()), float(np.mean(np.minimum(self.excess, 1e6)))


def within(
    robot: Robot, params: bp.PIDParams, motors: bp.Actuators, moves: Moves, seconds: float = 2.0, **options: Any
) -> Within:
    """Run every one of ``moves`` with every row of ``motors``, as steps from rest, and return what holds for all.

    ``params`` have one row. ``options`` go to :class:`batchpid.sim.Runner`.
    """
    draws, count = motors.num_envs, len(moves.start)
    every = moves.take(np.tile(np.arange(count), draws))
    known: Document = {
        "substeps": SUBSTEPS,
        "params": params,
        "actuators": motors.for_envs(np.repeat(np.arange(draws), count)),
    }
    with Runner(robot, draws * count, **known | options) as runner:
        metrics, timestep = run_moves(runner, every, seconds)[1], runner.timestep
    arm = np.flatnonzero(arm_joints(robot))
    settled = np.nan_to_num(metrics.settling_time[:, arm], nan=0.0, posinf=np.inf)
    settled = settled.reshape(draws, count, len(arm))
    excess = settled / settling_limits(robot, moves)[:, None]
    slowest = [np.unravel_index(int(each.argmax()), each.shape) for each in excess]
    poses = np.concatenate([moves.start[:POSES], moves.target[:POSES]])[:POSES]
    reports = [stability_report(robot, params, pose, timestep, actuators=motors) for pose in poses]
    return Within(
        max(reports, key=lambda report: report.robot_ratio),
        settled.max((1, 2)),
        excess.max((1, 2)),
        tuple(robot.joint_names[arm[joint]] for _, joint in slowest),
        tuple(moves.names[move] for move, _ in slowest),
    )
