r"""Candidates of a search for gains: from points in log space to params, and to costs by
simulation.

The cost of a move is the mean over its joints of the following sum. The cost of a candidate is the
mean over its moves, plus the cost of its worst move::

    log(1 + ITAE / (A 1 s^2)) + Ts / 1 s + log(1 + O / 5 %) + 2 log(1 + E / b)
        + 0.3 log(1 + max(TV / TV_smooth - 1, 0)) + 3 S

plus the mean over moves of 4 log(1 + max(Ts / Tmax - 1, 0) / 5 %) for the joint that settles last.

Ts is limited to 1.5 times the run; Tmax is the settling time asked for. A is the move, or the
smallest move that counts; O the overshoot as a fraction of A; E the final error, and b the least
half width of the settling band; TV the total variation of the effort, and TV_smooth its variation
in the smooth motion that takes a second; S the share of time in saturation. The logarithms prevent
a single move or joint from deciding. Steps alone do not show how closely a moving setpoint is
followed, and the gains that decide it, above all ki, are not those that decide the approach of a
step, where the setpoint weight acts too. So some moves are also made as smooth motions of the
setpoint, with its rate: the half whose motions are the shortest, because these have the largest
accelerations. Their cost, also the mean over moves plus the cost of the worst one, is added::

    log(1 + F / (10 b))

where F is the largest following error, b the least half width of the settling band, 1e-3 rad or
1e-4 m, and F / b that of the arm's worst joint. With a randomization, a robot may be drawn that no
gains can control; then twice the mean over moves replaces the sum of mean and worst.

Good gains for robots that differ from the model are farther from the designed ones than a search
goes in few generations. Designed gains have three poles of nearly equal speed; faster ones would
saturate the effort on a step of the setpoint. The :data:`DESIGNS` for such robots have one real
pole -p, which sets the time in which a setpoint is reached, and two at -w, which reject loads that
the model does not know::

    s^3 + kd s^2 + kp s + ki = (s + p) (s + w)^2        kd = p + 2 w    kp = w^2 + 2 p w    ki = p w^2

per unit of inertia. A load of acceleration a moves the joint by about a / w^2, independent of p.
The loop is stable while joints are heavier than the model by a factor below kd kp / ki (Routh and
Hurwitz), 9 at w = p and 15 at w = 5 p. The delay of a loop limits w; the simulation shows which
designs it allows.
"""

from __future__ import annotations

import warnings

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.gains.stability import stability_bound
from batchpid.metrics import SETTLING_SHARE, StepMetrics
from batchpid.sim.diagnosis.causes import absolute_band
from batchpid.sim.diagnosis.loop_stability import StabilityWarning
from batchpid.sim.robot.robot import Robot
from batchpid.sim.rollout import Rollout
from batchpid.sim.runner.runner import Runner
from batchpid.sim.tuning.evaluation import (
    arm_joints,
    following_error,
    run_moves,
    settling_limits,
)
from batchpid.sim.tuning.moves import Moves, smooth_durations, smooth_variation

FACTORS = {
    # factor: its standard deviation at first, in units of INITIAL_SPREAD; the last two matter less
    "bandwidth": 1.0,
    "stiffness": 1.0,
    "damping": 1.0,
    "setpoint_weight": 2.0,
    "derivative_filter_time": 2.0,
}
"""Factors that are searched, for all joints together.

A bandwidth factor c scales all poles: kp c^2, ki c^3, kd c. Stiffness multiplies kp alone, damping
kd alone.
"""
DESIGNS = ((7.0, 30.0), (7.0, 21.0), (5.5, 22.0), (5.5, 16.0), (7.0, 8.0), (4.0, 4.0), (2.0, 2.0))
"""Poles p and w [1/s] of the first candidates for robots that differ from the model."""
DIVERGED_COST = 1e3
"""Cost of a candidate that diverges; up to twice as much if it diverges early."""
PENALTY_RATIO = 0.8
"""Stability ratio (:func:`batchpid.stability_bound`) beyond which a candidate is penalised."""


FINAL_WEIGHT = 2.0
"""Weight of log(1 + final error / least half width of the settling band)."""
CHATTER_WEIGHT = 0.3
"""Weight of log(variation of the effort / variation in the smooth move), if that is positive."""
SATURATION_WEIGHT = 3.0
"""Weight of the share of time for which the effort is saturated."""
LATE_WEIGHT = 4.0
"""Weight of log(1 + excess of the settling time over the time asked for / 5 %), of a move's last
joint.
"""


class GainCandidates:
    """Candidates of a search on ``moves``, as points in log space. The point 0 has the designed
    gains.

    Each env runs one move of one candidate: all moves as steps, then the half whose smooth motions
    are the shortest. Candidates have ``headroom``, a share of the effort limits. The worst move
    counts unless robots are ``drawn``.
    """

    def __init__(
        self,
        robot: Robot,
        gain_units: str,
        moves: Moves,
        seconds: float,
        *,
        headroom: float,
        drawn: bool,
    ) -> None:
        self.robot = robot
        self.seconds = seconds
        self.headroom = headroom
        self.designed = robot.designed(gain_units)
        self._drawn = drawn
        # Figures of the moves as steps.
        self._steps = len(moves.names)
        self._band = absolute_band(robot)
        self._size = np.maximum(np.abs(moves.target - moves.start), self._band / SETTLING_SHARE)
        self._variation = smooth_variation(robot, moves, 1.0)
        self._limit = settling_limits(robot, moves)
        # The moves of a candidate's envs; a move has the same drawn robot both times.
        durations = smooth_durations(robot, moves)
        shortest = np.argsort(durations, kind="stable")[: max(1, self._steps // 2)]
        self._rows = np.concatenate([np.arange(self._steps), shortest])
        self._moves = moves.take(self._rows)
        self._durations = np.concatenate([np.zeros(self._steps), durations[shortest]])
        # The plant that the gains see: mass matrices and viscous damping.
        joints = int(robot.independent.sum())
        self._mass = np.eye(joints)[None]
        self._damping = np.zeros(joints)
        if gain_units != "mass_matrix":
            self._mass = robot.coupling.reduced(robot.mass_matrix(robot.sample(50, seed=0)))
            self._damping = robot.coupling.reduced_damping(robot.damping)

    def runner(self, count: int, options: Document) -> Runner:
        """Return a runner for ``count`` candidates."""
        rows = np.tile(self._rows, count)
        return Runner(self.robot, len(rows), **options)

    def designs(self) -> Float64:
        """Return the points (n, factors) of :data:`DESIGNS`, whose gains are per unit of inertia.

        The designed gains per mass matrix are such gains; in other units the same factors are
        taken.
        """
        designed = self.robot.designed()
        leaves = np.stack([designed.ki, designed.kp, designed.kd])
        medians = np.median(leaves[..., self.robot.independent], axis=(1, 2))
        p, w = np.array(DESIGNS).T
        # Over the designed gains, by their equations.
        ki = p * w**2 / medians[0]
        kp = (w**2 + 2 * p * w) / medians[1]
        kd = (p + 2 * w) / medians[2]
        bandwidth = np.cbrt(ki)
        factors = bandwidth, kp / bandwidth**2, kd / bandwidth
        points = np.zeros((len(p), len(FACTORS)))
        points[:, :3] = np.log(np.stack(factors, axis=1))
        return points

    def params(self, points: Float64) -> bp.PIDParams:
        """Return params with one row for each of ``points`` (n, factors)."""
        factors = np.exp(np.array(list(FACTORS.values())) * points)
        bandwidth, stiffness, damping, weight, filter_time = factors.T[..., None]
        designed = self.designed
        weight = np.minimum(designed.setpoint_weight * weight, 1.0)
        return designed.replace(
            kp=designed.kp * bandwidth**2 * stiffness,
            ki=designed.ki * bandwidth**3,
            kd=designed.kd * bandwidth * damping,
            setpoint_weight=weight + np.zeros_like(designed.kp),
            derivative_filter_time=designed.derivative_filter_time * filter_time,
        )

    def costs(self, runner: Runner, points: Float64) -> Float64:
        """Run each of ``points`` (n, factors) on its :meth:`runner`, and return the costs (n,)."""
        count = len(points)
        rows = len(self._rows)
        params = self.params(points)
        limits = {}
        for name in ("effort_min", "effort_max"):
            limit = getattr(params, name)
            if limit is not None:
                limits[name] = self.headroom * limit
        limited = params.replace(**limits)
        with warnings.catch_warnings():
            # A candidate beyond the bound gets a penalty in place of a warning.
            warnings.simplefilter("ignore", StabilityWarning)
            runner.params = limited.for_envs(np.repeat(np.arange(count), rows))

        # All moves of all candidates are one rollout.
        envs = np.tile(np.arange(rows), count)
        rollout, metrics = run_moves(
            runner,
            self._moves.take(envs),
            self.seconds,
            streams=self._rows[envs],
            durations=self._durations[envs],
        )
        # Simulations may diverge: figures are limited. (candidates, moves, joints)
        figures = [np.minimum(figure, 1e6).reshape(count, rows, -1) for figure in metrics]
        steps = StepMetrics(*(figure[:, : self._steps] for figure in figures))
        total = self._cost_of_steps(steps)
        total += self._cost_of_motions(rollout, count)
        # A candidate of which one move diverges is worse than all others, the earlier the worse.
        lasted = rollout.ok.mean(0).reshape(count, -1)
        diverged = DIVERGED_COST * (2 - lasted.mean(1))
        total = np.where(lasted.min(1) < 1, diverged, np.minimum(total, DIVERGED_COST))
        return total + self._stability_penalty(params, runner.timestep)

    def _cost_of_steps(self, metrics: StepMetrics) -> Float64:
        """Return the cost of moves that are made as steps of the setpoint (count,)."""
        settling = np.minimum(metrics.settling_time, 1.5 * self.seconds)
        chatter = np.maximum(metrics.effort_variation / self._variation, 1)
        cost = np.log1p(metrics.itae / self._size)
        cost += settling
        cost += np.log1p(metrics.peak_deviation / self._size / 0.05)
        cost += FINAL_WEIGHT * np.log1p(metrics.steady_state_error / self._band)
        cost += CHATTER_WEIGHT * np.log(chatter)
        cost += SATURATION_WEIGHT * metrics.saturation_share
        # A move is late when its last joint is.
        last = settling[..., arm_joints(self.robot)].max(2)
        late = np.log1p(np.maximum(last / self._limit - 1, 0) / 0.05)
        moves = cost[..., self.robot.independent].mean(2)
        costs: Float64 = self._over_moves(moves) + LATE_WEIGHT * late.mean(1)
        return costs

    def _cost_of_motions(self, rollout: Rollout, count: int) -> Float64:
        """Return the cost of moves that are made as smooth motions (count,)."""
        error = following_error(self.robot, rollout) / self._band
        worst = np.minimum(error[:, arm_joints(self.robot)].max(1), 1e6)
        motions = worst.reshape(count, -1)[:, self._steps :]
        return self._over_moves(np.log1p(motions / 10))

    def _over_moves(self, cost: Float64) -> Float64:
        """Return the mean of ``cost`` (count, moves) over moves plus its largest, or twice the
        mean: (count,).
        """
        mean: Float64 = cost.mean(1)
        return mean + (mean if self._drawn else cost.max(1))

    def _stability_penalty(self, params: bp.PIDParams, dt: float) -> Float64:
        """Return the penalty (count,) of candidates near the stability bound, whose moves may look
        stable.
        """
        leaves = np.stack(np.broadcast_arrays(params.kp, params.kd, params.derivative_filter_time))
        ratios = []
        for kp, kd, filter_time in zip(*leaves[..., self.robot.independent], strict=True):
            bound = stability_bound(
                self._mass,
                kp,
                kd,
                dt,
                filter_time=filter_time,
                damping=self._damping,
            )
            ratios.append(bound.ratio.max())
        return 10 * np.maximum(np.array(ratios) - PENALTY_RATIO, 0)
