"""Candidates of a search for gains: from points in log space to params, and to costs by simulation.

The cost of a candidate is the mean over joints, taken as the mean over moves plus the worst move, of::

    w_itae log(1 + ITAE / (A 1 s^2)) + w_settling Ts / 1 s + w_overshoot log(1 + O / 5 %) + w_final log(1 + E / 1e-3)
        + w_chatter log(1 + max(TV / TV_smooth - 1, 0)) + w_saturation S

plus the mean over moves of w_late log(1 + max(Ts / Tmax - 1, 0) / 5 %) for the arm's joint that settles last.

Steps alone do not show how closely a moving setpoint is followed, and the gains that decide it, above all ki, are not
those that decide the approach of a step, where the setpoint weight acts too. So some moves are also made as smooth
motions of the setpoint, with its rate: the half whose motions are the shortest, because these have the largest
accelerations. The mean over them plus the worst is added of::

    w_following log(1 + F / (10 b))

where F is the largest following error, b the least half width of the settling band, 1e-3 rad or 1e-4 m, and F / b that
of the arm's worst joint. w_following is 1 by default; with 0 there are no such motions.

With a randomization, a robot may be drawn that no gains can control; then twice the mean over moves replaces the sum of
mean and worst. Ts is limited to 1.5 times the run; Tmax is the settling time asked for. A is the joint's move, or the
smallest move that counts; O the overshoot as a fraction of A; E the final error; TV the total variation of the effort,
and TV_smooth its variation in the smooth motion that takes a second; S the share of time in saturation. The logarithms
prevent that a single move or joint decides.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.gains.stability import stability_bound
from batchpid.metrics import StepMetrics
from batchpid.sim.robot.loop_stability import StabilityWarning
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.unsettled import absolute_band
from batchpid.sim.runner import Runner
from batchpid.sim.tuning.evaluation import (
    arm_joints,
    following_error,
    run_moves,
    settling_limits,
)
from batchpid.sim.tuning.moves import Moves, smooth_durations, smooth_variation
from batchpid.sim.tuning.weights import Weights

FACTORS = {
    # factor: its standard deviation at first, in units of INITIAL_SPREAD; the last two matter less
    "bandwidth": 1.0,
    "stiffness": 1.0,
    "damping": 1.0,
    "setpoint_weight": 2.0,
    "derivative_filter_time": 2.0,
}
"""Factors that are searched for all joints together; with ``per_joint`` one for each joint's inertia as well.

A bandwidth factor c scales all poles: kp c^2, ki c^3, kd c. Stiffness multiplies kp alone, damping kd alone.
"""
HEADROOM = 0.9
"""Share of the effort limits that candidates may use."""
PENALTY_RATIO = 0.8
"""Stability ratio (:func:`batchpid.stability_bound`) beyond which a candidate is penalised."""
DIVERGED_COST = 1e3
"""Cost of a candidate that diverges; up to twice as much if it diverges early."""


def bounded(figure: Float64) -> Float64:
    """Return a figure of merit, at most 1e6."""
    return np.minimum(figure, 1e6)


def response_cost(w: Weights, m: StepMetrics, size: Float64, band: Float64) -> Float64:
    """Return the terms of the cost for the response, of each move and joint; figures and ``settling_time`` bounded."""
    cost: Float64 = (
        w.itae * np.log1p(m.itae / size)
        + w.settling * m.settling_time
        + w.overshoot * np.log1p(m.peak_deviation / size / 0.05)
        + w.final * np.log1p(m.steady_state_error / band)
    )
    return cost


class Candidates:
    """Candidates of a search as points in log space: their params, and the costs of their rollouts on ``moves``.

    ``varied`` says that the robots of the moves are drawn: the cost is twice the mean over moves, without the worst.
    """

    def __init__(
        self,
        robot: Robot,
        gain_units: str,
        per_joint: bool,
        moves: Moves,
        seconds: float,
        weights: Weights,
        *,
        headroom: float = HEADROOM,
        varied: bool = False,
    ) -> None:
        self.robot, self.moves, self.seconds, self.weights, self.headroom = robot, moves, seconds, weights, headroom
        self.varied = varied
        self.designed = robot.designed(gain_units)
        joints = int(robot.independent.sum())
        self.dimension = len(FACTORS) + (joints if per_joint else 0)
        self._band = absolute_band(robot)
        self._smooth = smooth_variation(robot, moves, 1.0)
        self._limit = settling_limits(robot, moves)
        # Envs of a candidate: each move as a step, then the followed ones. The same move has the same drawn robot.
        durations = smooth_durations(robot, moves)
        followed = max(1, len(durations) // 2) if weights.following else 0
        shortest = np.argsort(durations, kind="stable")[:followed]
        steps = np.arange(len(durations))
        self._moves = np.concatenate([steps, shortest])
        self._durations = np.concatenate([np.zeros(len(steps)), durations[shortest]]) if followed else None
        self._size = np.maximum(np.abs(moves.target - moves.start), self._band / 0.02)
        # The plant that the gains see: mass matrices, the gains' unit per joint, and viscous damping.
        if gain_units == "mass_matrix":
            self._mass, self._damping = np.eye(joints)[None], np.zeros(joints)
        else:
            self._mass, self._damping = robot.mass_matrix(robot.sample(50, seed=0)), robot.damping
            coupling = robot.coupling
            self._mass, self._damping = coupling.reduced(self._mass), coupling.reduced_damping(self._damping)
        inertia = gain_units == "inertia"
        self._unit = np.diagonal(self._mass, axis1=1, axis2=2) if inertia else np.ones(joints)

    @property
    def envs(self) -> int:
        """Number of envs of a candidate."""
        return len(self._moves)

    def drawn(self, motors: bp.Actuators | None, count: int, step: int = 1) -> dict[str, bp.Actuators]:
        """Return the option ``actuators`` of a runner for ``count`` candidates: each move has its row of ``motors``.

        With ``step`` -1 the rows are counted from the last one.
        """
        if motors is None:
            return {}
        rows = (step * (1 + self._moves)) % motors.num_envs
        return {"actuators": motors.for_envs(np.tile(rows, count))}

    def points(self, gains: Sequence[Float64]) -> Float64:
        """Return the points (n, dimension) of ``gains``: (ki, kp, kd) each, per unit of inertia.

        The designed gains per mass matrix are such gains; in other units the same factors are taken.
        """
        designed = self.robot.designed()
        known = [np.median(leaf[..., self.robot.independent]) for leaf in (designed.ki, designed.kp, designed.kd)]
        ki, kp, kd = (np.array(gains) / known).T
        bandwidth = np.cbrt(ki)
        points = np.zeros((len(gains), self.dimension))
        points[:, :3] = np.log(np.stack([bandwidth, kp / bandwidth**2, kd / bandwidth], 1))
        return points

    def params(self, points: Float64) -> bp.PIDParams:
        """Return params with one row for each of ``points`` (n, dimension)."""
        shared = np.exp(np.array(list(FACTORS.values())) * points[:, : len(FACTORS)])
        bandwidth, stiffness, damping, weight, filter_time = shared.T[..., None]
        joints: Any = 1.0
        if self.dimension > len(FACTORS):
            joints = self.robot.coupling.of_all(np.exp(points[:, len(FACTORS) :]))
        d = self.designed
        return d.replace(
            kp=d.kp * bandwidth**2 * stiffness * joints,
            ki=d.ki * bandwidth**3 * joints,
            kd=d.kd * bandwidth * damping * joints,
            setpoint_weight=np.minimum(d.setpoint_weight * weight, 1.0) + np.zeros_like(d.kp),
            derivative_filter_time=d.derivative_filter_time * filter_time,
        )

    def costs(self, runner: Runner, points: Float64) -> tuple[float, ...]:
        """Return the cost of each of ``points``, run on ``runner``, which has :attr:`envs` for each."""
        count, moves, params = len(points), self.moves, self.params(points)
        limits = {name: getattr(params, name) for name in ("effort_min", "effort_max")}
        limited = params.replace(**{name: self.headroom * limit for name, limit in limits.items() if limit is not None})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", StabilityWarning)  # a candidate beyond the bound gets a penalty
            runner.params = limited.for_envs(np.repeat(np.arange(count), self.envs))
        each = np.tile(self._moves, count)
        durations = None if self._durations is None else np.tile(self._durations, count)
        rollout, m = run_moves(runner, moves.take(each), self.seconds, streams=each, durations=durations)
        steps = slice(len(moves.start))
        w = self.weights

        m = StepMetrics(*(bounded(figure).reshape(count, self.envs, -1)[:, steps] for figure in m))
        settling = np.minimum(m.settling_time, 1.5 * self.seconds)
        cost = (
            response_cost(w, m._replace(settling_time=settling), self._size, self._band)
            + w.chatter * np.log1p(np.maximum(m.effort_variation / self._smooth - 1, 0))
            + w.saturation * m.saturation_share
        )[..., self.robot.independent].mean(2)
        late = np.maximum(settling[..., arm_joints(self.robot)].max(2) / self._limit - 1, 0)
        lasted = rollout.ok.mean(0).reshape(count, -1)
        total = self._over_moves(cost) + w.late * np.log1p(late / 0.05).mean(1)
        if self.envs > len(moves.start):
            error = (following_error(self.robot, rollout) / self._band)[:, arm_joints(self.robot)].max(1)
            followed = bounded(error).reshape(count, self.envs)[:, len(moves.start) :]
            total = total + w.following * self._over_moves(np.log1p(followed / 10))
        total = np.minimum(total, DIVERGED_COST)
        total = np.where(lasted.min(1) < 1, DIVERGED_COST * (2 - lasted.mean(1)), total)
        return tuple((total + self._stability_penalty(params, runner.timestep)).tolist())

    def _over_moves(self, cost: Float64) -> Float64:
        """Return the mean of costs (count, moves) over moves plus the worst, or twice the mean (count,)."""
        total: Float64 = cost.mean(1) + (cost.mean(1) if self.varied else cost.max(1))
        return total

    def _stability_penalty(self, params: bp.PIDParams, dt: float) -> Float64:
        """Return the penalty (count,) of candidates near the stability bound, whose moves may look stable."""
        leaves = np.stack(np.broadcast_arrays(params.kp, params.kd, params.derivative_filter_time))
        ratios = [
            stability_bound(
                self._mass, kp * self._unit, kd * self._unit, dt, filter_time=tau, damping=self._damping
            ).ratio.max()
            for kp, kd, tau in zip(*leaves[..., self.robot.independent], strict=True)
        ]
        return 10 * np.maximum(np.array(ratios) - PENALTY_RATIO, 0)
