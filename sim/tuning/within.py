"""Evaluation of gains on many drawn sets of motors: stability at their delay, settling, and the worst draw."""

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
"""Number of poses, starts and targets of moves, at which the stability of each draw is evaluated."""


class Within(NamedTuple):
    """Stability and settling of gains on drawn sets of motors."""

    stability: StabilityReport
    """Report for the least stable draw and pose; ``env`` is the number of the draw."""
    settling: Float64
    """Settling time of the slowest joint of the arm in the slowest move of each draw (draws,) [s]; inf: never."""
    excess: Float64
    """Largest settling time over the requested time, in each draw (draws,)."""
    joints: tuple[str, ...]
    """Joint that settles last in the move with the largest excess, by draw."""
    moves: tuple[str, ...]
    """Move with the largest excess, by draw."""

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
        """Key for sorting, smallest for the best gains: not :attr:`holds`, largest excess, mean excess."""
        return not self.holds, float(self.excess.max()), float(np.mean(np.minimum(self.excess, 1e6)))


def within(
    robot: Robot, params: bp.PIDParams, motors: bp.Actuators, moves: Moves, seconds: float = 2.0, **options: Any
) -> Within:
    """Run all ``moves`` as setpoint steps from rest with each row of ``motors``, and evaluate them.

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
