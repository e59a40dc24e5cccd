"""Gains on evaluation: a set of moves, run at once, each in an env of its own, and judged."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.metrics import StepMetrics, step_metrics
from sim.observation import Rollout
from sim.robot.limits import SetpointWarning
from sim.robot.robot import Robot
from sim.runner import Runner
from sim.tuning.moves import OVERSHOOT, Moves, fastest, smooth_effort

Float64 = NDArray[np.float64]
SUBSTEPS = 5
"""Sim steps of a tick: an odd number, so that an effort that alternates from step to step shows in the samples."""
REVOLUTE_BAND, PRISMATIC_BAND = 1e-3, 1e-4
"""Least half width of the settling band [rad], [m]."""
SETTLE_SECONDS, SETTLE_SLACK = 1.0, 1.2
"""A move should settle within a second, or within this multiple of the shortest that its effort limits allow."""


class Evaluation(NamedTuple):
    """How a set of gains did on a set of moves; arrays are (moves, dof) unless said otherwise."""

    name: str
    moves: Moves
    rollout: Rollout
    metrics: StepMetrics
    chatter: Float64
    """Total variation of the effort, over that of the smooth (minimum-jerk) motion of the same move and duration."""
    allowed: Float64
    """(moves,): the settling time asked for [s]."""

    def shortfalls(self, arm: NDArray[np.bool_]) -> list[str]:
        """What the arm's joints miss of the usual demands, worst first; empty if nothing.

        Settling within ``allowed``, overshoot <= 5 %, steady-state error <= 1e-3, chatter <= 2.
        """
        demands = (
            ("settling time", self.metrics.settling_time / self.allowed[:, None], 1.0),
            ("overshoot", self.metrics.overshoot, OVERSHOOT),
            ("steady-state error", self.metrics.steady_state_error, 1e-3),
            ("chatter", self.chatter, 2.0),
        )
        found = []
        for what, figure, limit in demands:
            excess = np.where(arm, np.nan_to_num(figure, nan=0.0, posinf=np.inf), 0.0) / limit
            for move, joint in np.argwhere(excess > 1):
                text = f"{what} of move {self.moves.names[move]!r}, joint {joint}: {excess[move, joint]:.2f} x limit"
                found.append((float(excess[move, joint]), text))
        return [text for _, text in sorted(found, reverse=True)]


def absolute_band(robot: Robot) -> Float64:
    """Least half width of the settling band, per joint (dof,) [rad or m]."""
    return np.array([PRISMATIC_BAND if j.type == "prismatic" else REVOLUTE_BAND for j in robot.joints])


def judge(robot: Robot, rollout: Rollout, start: NDArray[Any], *, efforts: bool = True) -> StepMetrics:
    """Figures of merit of a ``rollout`` from rest at ``start`` (envs, dof); what diverged has inf.

    Without ``efforts`` those of the efforts are undefined: PhysX keeps its drive's to itself.
    """
    tick = rollout.time[1] - rollout.time[0]
    return step_metrics(
        tick * np.arange(1, len(rollout.time) + 1),
        rollout.setpoint,
        np.where(rollout.ok[..., None], rollout.qpos, np.nan),
        start=start,
        effort=rollout.effort if efforts else None,
        saturated=rollout.saturated if efforts else None,
        absolute_band=absolute_band(robot),
        continuous=robot.continuous,
    )


def arm_joints(robot: Robot) -> NDArray[np.bool_]:
    """Which joints belong to the arm: on the way to the deepest branching, so not the fingers of a hand (dof,)."""
    parent = {joint.child_link: joint for joint in robot.all_joints}

    def chain(link: str) -> list[str]:
        names = []
        while link in parent:
            names.append(parent[link].name)
            link = parent[link].parent_link
        return names

    leaves = {j.child_link for j in robot.all_joints} - {j.parent_link for j in robot.all_joints}
    counts: dict[str, int] = {}
    for leaf in leaves:
        for name in chain(leaf):
            counts[name] = counts.get(name, 0) + 1
    moving = {joint.name for joint in robot.joints}
    shared = {name for name, count in counts.items() if count > 1 and name in moving}
    # A robot without a common trunk of any length (legs, a bare chain) is all arm.
    if len(shared) < 3:
        return np.ones(robot.dof, bool)
    return np.array([name in shared for name in robot.joint_names])


def evaluate_gains(
    robot: Robot,
    params: bp.PIDParams,
    moves: Moves,
    *,
    name: str = "gains",
    seconds: float = 2.0,
    control: str = "pid",
    workers: int | None = None,
    judge_chatter: bool = True,
    **runner_options: Any,
) -> Evaluation:
    """Run ``moves`` from rest for ``seconds`` under ``params``, all at once, and judge every joint of every move.

    ``params`` of one row are used for all moves. ``runner_options`` go to :class:`sim.Runner`.
    """
    options = {"substeps": SUBSTEPS, **runner_options}
    with (
        Runner(robot, len(moves.start), params=params, control=control, workers=workers, **options) as runner,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", SetpointWarning)
        runner.reset(moves.start)
        ticks = max(2, round(seconds / (runner.timestep * runner.substeps)))
        rollout = runner.rollout(np.broadcast_to(moves.target, (ticks, *moves.target.shape)))
    metrics = judge(robot, rollout, moves.start, efforts=control != "drive")
    shortest = fastest(robot, moves)
    return Evaluation(
        name=name,
        moves=moves,
        rollout=rollout,
        metrics=metrics,
        chatter=_chatter(robot, moves, metrics, shortest) if judge_chatter else np.full(moves.start.shape, np.nan),
        allowed=np.maximum(SETTLE_SECONDS, SETTLE_SLACK * shortest),
    )


def _chatter(robot: Robot, moves: Moves, metrics: StepMetrics, shortest: Float64) -> Float64:
    """Total variation over that of the smooth motion that takes as long as the slowest arm joint took to settle.

    A smooth effort of less than a thousandth of the joint's limit counts as that.
    """
    settled = np.where(np.isfinite(metrics.settling_time) & arm_joints(robot), metrics.settling_time, 0.0).max(1)
    floor = 1e-3 * np.where(np.isfinite(robot.effort_limit), robot.effort_limit, 1.0)
    result = np.empty_like(moves.start)
    for row, (start, target) in enumerate(zip(moves.start, moves.target, strict=True)):
        duration = max(settled[row], shortest[row] if np.isfinite(shortest[row]) else 0.0, 0.1)
        smooth = np.abs(np.diff(smooth_effort(robot, start, target, duration), axis=0)).sum(0)
        result[row] = metrics.effort_variation[row] / np.maximum(smooth, floor)
    return result
