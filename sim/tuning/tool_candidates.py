r"""Candidates of a search for gains of operational-space control: from points in log space to options and costs.

A point holds factors of the bandwidths of positions, of rotations and of the posture, and of the damping ratios of
positions and rotations. The tool makes moves within its reach, as steps of the pose. The cost has the terms of
:mod:`batchpid.sim.tuning.cost`: for the response the mean over the six axes, with the error of each axis as its
response; for chatter and saturation the mean over the joints.

All candidates run in one runner: the setpoint of each env holds the pose and the gains.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Document, Float64
from batchpid.arrays.elementwise import namespace
from batchpid.metrics import StepMetrics, step_metrics
from batchpid.sim.command import CommandSpec
from batchpid.sim.observation import Rollout
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.unsettled import PRISMATIC_BAND, REVOLUTE_BAND
from batchpid.sim.runner import Runner
from batchpid.sim.tool_space.osc_controller import OperationalSpace
from batchpid.sim.tool_space.tool_setpoints import reaches
from batchpid.sim.tuning.cost import (
    PENALTY_RATIO,
    Trial,
    Weights,
    bounded,
    chatter,
    late,
    over_moves,
    response_cost,
    with_divergence,
)
from batchpid.sim.tuning.evaluation import SETTLE_SECONDS
from batchpid.sim.tuning.moves import Moves, draw_moves, smooth_variation
from batchpid.task_space.frames import pose_error

GAINS = {
    "position_bandwidth": ("rad/s", np.sqrt(150.0)),
    "rotation_bandwidth": ("rad/s", np.sqrt(150.0)),
    "posture_bandwidth": ("rad/s", np.sqrt(10.0)),
    "position_damping_ratio": ("1", 1.0),
    "rotation_damping_ratio": ("1", 1.0),
}
"""Gains that are searched: units, and the values of the defaults of :func:`batchpid.task_space.make_osc_params`."""
SPREAD = np.array([3.0, 3.0, 3.0, 1.0, 1.0])
"""Standard deviations of their logarithms at first, in units of INITIAL_SPREAD."""
BAND = np.array([PRISMATIC_BAND] * 3 + [REVOLUTE_BAND] * 3)
"""Least half width of the settling band of each axis [m, rad]."""
AT_LIMIT = 0.999
"""Share of its limit at which an effort counts as saturated."""
SIZE = 0.5
"""Largest distance of a joint from the posture at the ends of a move [rad or m]."""
ROUNDS = 4
"""Draws of all moves."""


def osc_options(gains: Float64) -> Document:
    """Return the options of :func:`batchpid.task_space.make_osc_params` for GAINS (5,)."""
    position, rotation, posture, *ratios = gains.tolist()
    return {
        "stiffness": [position**2] * 3 + [rotation**2] * 3,
        "damping_ratio": [ratios[0]] * 3 + [ratios[1]] * 3,
        "posture_stiffness": posture**2,
    }


class SearchedSpace(OperationalSpace):
    """Operational-space control whose setpoints hold a pose (7,) and GAINS (5,)."""

    def __init__(self, robot: Robot, link: str, **options: Any) -> None:
        super().__init__(robot, link, **options)
        self.pose_command = self.command
        units, values = zip(*GAINS.values(), strict=True)
        names = (*self.command.names, *GAINS)
        neutral = (*np.array(self.command.neutral).tolist(), *values)
        self.command = CommandSpec(names, (*self.command.units, *units), neutral=neutral)

    def _coefficients(self, setpoint: Array) -> ts.OSCCoefficients:
        """Return the coefficients of each env (envs, 6 | dof)."""
        xp = namespace(setpoint)
        position, rotation, posture, *ratios = (setpoint[:, 7 + k : 8 + k] for k in range(len(GAINS)))
        bandwidth = xp.concatenate([position] * 3 + [rotation] * 3, axis=1)
        ratio = xp.concatenate([ratios[0]] * 3 + [ratios[1]] * 3, axis=1)
        joint = posture * self.tree.independent.astype(posture.dtype)
        gains = {"stiffness": bandwidth**2, "damping": 2 * ratio * bandwidth}
        gains |= {"posture_stiffness": joint**2, "posture_damping": 2 * joint}
        return ts.discretise(self.params._replace(**gains), self._timestep)


class ToolMoves(NamedTuple):
    """Moves of a tool, from rest."""

    joints: Moves
    """Joint positions at the start, and others at which the tool is at the goal."""
    goal: Float64
    """Poses of the tool (moves, 7)."""


def tool_moves(robot: Robot, control: OperationalSpace, count: int, seed: int) -> ToolMoves:
    """Return ``count`` seeded moves between poses of the tool near its pose in the control's posture.

    Their ends touch nothing, and joints stay within their limits on the way under the control's gains.

    Raises
    ------
    InvalidArgumentError
        There are no such moves.
    """
    random, dynamics, center = np.random.default_rng(seed), robot.dynamics(), control.init(robot, 1).posture
    reach = np.minimum(SIZE, (robot.upper - robot.lower) / 4)

    def draw(_: int) -> list[tuple[Float64, Float64, str]]:
        drawn = center + reach * random.uniform(-1, 1, (count, 2, robot.dof))
        drawn = robot.coupled(np.clip(drawn, robot.lower, robot.upper))
        touching = dynamics.in_contact(drawn.reshape(-1, robot.dof), 0.0).reshape(count, 2).any(1)
        good = reaches(robot, control, drawn[:, 0], _poses(control, drawn[:, 1])) & ~touching
        return [(start, target, "of the tool") for start, target in drawn[good]]

    joints = draw_moves(robot, count, draw, draws=ROUNDS)
    return ToolMoves(joints, _poses(control, joints.target))


def _poses(control: OperationalSpace, qpos: Float64) -> Float64:
    """Return the poses of the tool (..., 7) at ``qpos`` (..., dof)."""
    poses: Float64 = ts.link_poses(control.tree, qpos, [control.link], point=control.point)[..., 0, :]
    return poses


def tool_metrics(rollout: Rollout, goal: Float64, start: Float64) -> StepMetrics:
    """Return the metrics of the six axes for moves to ``goal`` from the poses ``start`` (envs, 7); inf if diverged.

    Overshoots are fractions of the farthest move of an axis, of the three of the position or of the rotation: an axis
    may hardly move.
    """
    assert rollout.tool_pose is not None
    course = np.where(rollout.ok[..., None], -pose_error(goal, rollout.tool_pose.astype(np.float64)), np.nan)
    move = -pose_error(goal, start)
    metrics = step_metrics(rollout.tick, np.zeros(6), course, start=move, absolute_band=BAND)
    farthest = np.repeat(np.abs(move).reshape(-1, 2, 3).max(2), 3, axis=1)
    return metrics._replace(overshoot=metrics.peak_deviation / np.maximum(farthest, BAND))


class ToolCandidates:
    """Candidates of a search on ``moves``, as points in log space. The point 0 has the default gains."""

    start, dimension = "default", len(GAINS)

    def __init__(
        self, robot: Robot, control: SearchedSpace, moves: ToolMoves, seconds: float, weights: Weights
    ) -> None:
        self.control, self.moves, self.seconds, self.weights = control, moves, seconds, weights
        self._start = _poses(control, moves.joints.start)
        self._size = np.maximum(np.abs(pose_error(moves.goal, self._start)), BAND / 0.02)
        self._smooth, self._limit = smooth_variation(robot, moves.joints, 1.0), control.params.effort_max

    @property
    def envs(self) -> int:
        """Number of envs of a candidate."""
        return len(self.moves.goal)

    def options(self, count: int) -> Document:
        """Return the options of a runner: the control."""
        return {"control": self.control}

    def gains(self, points: Float64) -> Float64:
        """Return the GAINS (n, 5) of ``points`` (n, 5)."""
        return np.array([value for _, value in GAINS.values()]) * np.exp(SPREAD * points)

    def trial(self, runner: Runner, points: Float64) -> Trial:
        """Run all moves under the gains of each of ``points`` (n, 5); the setpoints of the rollout are poses."""
        gains, w, lead = self.gains(points), self.weights, (len(points), self.envs)
        goal, start = (np.tile(poses, (len(points), 1)) for poses in (self.moves.goal, self._start))
        setpoint = np.concatenate([goal, np.repeat(gains, self.envs, axis=0)], axis=1)
        ticks = max(2, round(self.seconds / (runner.timestep * runner.substeps)))
        runner.reset(np.tile(self.moves.joints.start, (len(points), 1)))
        rollout = runner.rollout(np.broadcast_to(setpoint, (ticks, *setpoint.shape)))
        info = replace(rollout.info, own_command=self.control.pose_command)
        poses = replace(rollout, setpoint=rollout.setpoint[..., :7], info=info)
        metrics = StepMetrics(*(figure.reshape(*lead, 6) for figure in tool_metrics(rollout, goal, start)))

        m = StepMetrics(*map(bounded, metrics))
        settling = np.minimum(m.settling_time, 1.5 * self.seconds)
        variation = bounded(np.abs(np.diff(rollout.effort, axis=0)).sum(0)).reshape(*lead, -1)
        saturated = np.abs(rollout.effort) >= AT_LIMIT * self._limit  # the law scales its efforts: none is clipped
        cost = response_cost(w, m._replace(settling_time=settling), self._size, BAND).mean(2)
        cost = cost + w.chatter * chatter(variation, self._smooth).mean(2)
        cost = cost + w.saturation * saturated.mean((0, 2)).reshape(lead)
        total = over_moves(cost) + w.late * late(settling.max(2), SETTLE_SECONDS)
        total = with_divergence(total, rollout.ok) + stability_penalty(gains, runner.timestep)
        return Trial(tuple(total.tolist()), metrics, poses)


def stability_penalty(gains: Float64, dt: float) -> Float64:
    """Return the penalty (n,) of explicit gains (n, 5) near the stability bound, kp dt^2 + 2 kd dt = 4."""
    ratios = np.stack([gains[:, 3], gains[:, 4], np.ones(len(gains))], axis=1)
    step = gains[:, :3] * dt
    penalty: Float64 = 10 * np.maximum((step**2 + 4 * ratios * step).max(1) / 4 - PENALTY_RATIO, 0)
    return penalty
