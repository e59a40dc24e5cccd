r"""Candidates of a search for gains of joints: from points in log space to params, and to costs by simulation.

:mod:`batchpid.sim.tuning.cost` has the terms of the cost, of which the mean over joints is taken. Steps alone do not
show how closely a moving setpoint is followed, and the gains that decide it, above all ki, are not those that decide
the approach of a step, where the setpoint weight acts too. So some moves are also made as smooth motions of the
setpoint, with its rate: the half whose motions are the shortest, because these have the largest accelerations. Their
cost, also the mean over moves plus the cost of the worst one, is added::

    w_following log(1 + F / (10 b))

where F is the largest following error, b the least half width of the settling band, 1e-3 rad or 1e-4 m, and F / b that
of the arm's worst joint. w_following is 1 by default; with 0 there are no such motions. With a randomization, a robot
may be drawn that no gains can control; then twice the mean over moves replaces the sum of mean and worst.

The first candidates for robots that differ from the model are designed from the time asked for and the loop's delay.
The integral adapts to unknown loads. Designed gains have three poles of nearly equal speed; faster ones would saturate
the effort on a step of the setpoint. The first candidates have one real pole -p, which sets the time in which a
setpoint is reached, and two at -w, which reject the load::

    s^3 + kd s^2 + kp s + ki = (s + p) (s + w)^2        kd = p + 2 w    kp = w^2 + 2 p w    ki = p w^2

per unit of inertia. A load of acceleration a moves the joint by about a / w^2, independent of p. The loop is stable
while joints are heavier than the model by a factor below kd kp / ki (Routh and Hurwitz), 9 at w = p and 15 at w = 5 p.

The delay T of the loop limits w: the phase margin of L(s) = (kd s^2 + kp s + ki) / s^3 exp(-s T) is to be 45 degrees
(K. J. Astrom and R. M. Murray, Feedback Systems, 2008, section 9.3).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.gains.stability import stability_bound
from batchpid.metrics import StepMetrics
from batchpid.motors.actuators import Actuators
from batchpid.sim.randomization.checks import prepared_actuators
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.loop_stability import StabilityWarning
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.unsettled import absolute_band
from batchpid.sim.runner import Runner
from batchpid.sim.tuning.cost import (
    HEADROOM,
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
from batchpid.sim.tuning.evaluation import SETTLE_SECONDS, arm_joints, following_error, run_moves, settling_limits
from batchpid.sim.tuning.moves import Moves, smooth_durations, smooth_variation

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
PHASE_MARGIN = np.pi / 4
"""Least phase margin of the first candidates [rad]."""
SPEEDS, SHARES = (7.0, 5.5), (0.65, 1.0, 0.4)
"""Poles p of the candidates in units of 1 / (settling time asked for), and w as a share of its range above p."""
FASTEST = 6.0
"""Largest w, in units of p: beyond it there is more chatter and little else."""
_DRAWS = 100


class Candidates:
    """Candidates of a search on ``moves``, as points in log space. The point 0 has the designed gains.

    Each move has the robot's actuators, or its row of ``motors``; the rows are counted from the first, or with ``step``
    -1 from the last. ``varied`` says that the robots of the moves are drawn: the cost is twice the mean over moves,
    without the worst.
    """

    start = "designed"

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
        motors: bp.Actuators | None = None,
        step: int = 1,
    ) -> None:
        self.robot, self.moves, self.seconds, self.weights, self.headroom = robot, moves, seconds, weights, headroom
        self._varied, self._motors, self._step = varied, motors, step
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

    @property
    def envs(self) -> int:
        """Number of envs of a candidate."""
        return len(self._moves)

    def options(self, count: int) -> Document:
        """Return the options of a runner for ``count`` candidates: the actuators of each move."""
        if self._motors is None:
            return {}
        rows = (self._step * (1 + self._moves)) % self._motors.num_envs
        return {"actuators": self._motors.for_envs(np.tile(rows, count))}

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

    def trial(self, runner: Runner, points: Float64) -> Trial:
        """Run each of ``points`` on ``runner``, which has :attr:`envs` for each."""
        count, moves, params = len(points), self.moves, self.params(points)
        limits = {name: getattr(params, name) for name in ("effort_min", "effort_max")}
        limited = params.replace(**{name: self.headroom * limit for name, limit in limits.items() if limit is not None})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", StabilityWarning)  # a candidate beyond the bound gets a penalty
            runner.params = limited.for_envs(np.repeat(np.arange(count), self.envs))
        each = np.tile(self._moves, count)
        durations = None if self._durations is None else np.tile(self._durations, count)
        rollout, metrics = run_moves(runner, moves.take(each), self.seconds, streams=each, durations=durations)
        steps, w = slice(len(moves.start)), self.weights
        metrics = StepMetrics(*(figure.reshape(count, self.envs, -1)[:, steps] for figure in metrics))

        m = StepMetrics(*map(bounded, metrics))
        settling = np.minimum(m.settling_time, 1.5 * self.seconds)
        cost = (
            response_cost(w, m._replace(settling_time=settling), self._size, self._band)
            + w.chatter * chatter(m.effort_variation, self._smooth)
            + w.saturation * m.saturation_share
        )[..., self.robot.independent].mean(2)
        last = settling[..., arm_joints(self.robot)].max(2)
        total = over_moves(cost, not self._varied) + w.late * late(last, self._limit)
        if self.envs > len(moves.start):
            error = (following_error(self.robot, rollout) / self._band)[:, arm_joints(self.robot)].max(1)
            followed = bounded(error).reshape(count, self.envs)[:, len(moves.start) :]
            total = total + w.following * over_moves(np.log1p(followed / 10), not self._varied)
        total = with_divergence(total, rollout.ok) + self._stability_penalty(params, runner.timestep)
        return Trial(tuple(total.tolist()), metrics, rollout)

    def _stability_penalty(self, params: bp.PIDParams, dt: float) -> Float64:
        """Return the penalty (count,) of candidates near the stability bound, whose moves may look stable."""
        leaves = np.stack(np.broadcast_arrays(params.kp, params.kd, params.derivative_filter_time))
        ratios = [
            stability_bound(self._mass, kp, kd, dt, filter_time=tau, damping=self._damping).ratio.max()
            for kp, kd, tau in zip(*leaves[..., self.robot.independent], strict=True)
        ]
        return 10 * np.maximum(np.array(ratios) - PENALTY_RATIO, 0)


def loop_delay(robot: Robot, randomization: Randomization | None, own: float, motors: Actuators | None = None) -> float:
    """Return the delay of the slowest joint's loop [s]: its motor's and sensor's, lag included, and ``own``.

    ``motors`` replace the robot's actuators.
    """
    actuators = robot.actuators if motors is None else motors
    if randomization is not None and randomization.actuators:
        prepared = prepared_actuators(randomization, actuators, robot)
        actuators = randomization.randomized_actuators(prepared, randomization.first(robot, _DRAWS), robot)
    if actuators is None:
        return own
    parts = (actuators.command_delay, actuators.sensor_delay, actuators.lag)
    return own + float(np.max(sum(0.0 if part is None else part for part in parts)))


def phase_margin(gains: Float64, delay: float) -> float:
    """Return the phase margin [rad] of (ki, kp, kd) per unit of inertia on a double integrator with ``delay`` [s]."""
    ki, kp, kd = gains
    squares = np.roots([1.0, -(kd**2), 2 * ki * kd - kp**2, -(ki**2)])  # |L(i w)|^2 = 1 in w^2
    w = float(np.sqrt(squares[np.abs(squares.imag) < 1e-6 * np.abs(squares)].real.max()))
    return float(np.angle(ki - kd * w**2 + 1j * kp * w) - np.pi / 2 - w * delay)


def gains_of_poles(p: float, w: float) -> Float64:
    """Return (ki, kp, kd) per unit of inertia of poles at -p, -w and -w [1/s]."""
    return np.array([p * w**2, w**2 + 2 * p * w, p + 2 * w])


def first_gains(delay: float) -> list[Float64]:
    """Return (ki, kp, kd) per unit of inertia of the candidates for a loop with ``delay`` [s], the likeliest first."""
    found = []
    for share in SHARES:
        for speed in SPEEDS:
            p = min(speed / SETTLE_SECONDS, _fastest(delay))
            w = min(_fastest(delay, p), FASTEST * p)
            found.append(gains_of_poles(p, p + share * max(w - p, 0.0)))
    return found


def _fastest(delay: float, p: float | None = None) -> float:
    """Return the largest w [1/s] with the phase margin, by bisection; without ``p`` for three poles at -w."""
    low, high = 1e-2, 1e4
    for _ in range(50):
        w = float(np.sqrt(low * high))
        enough = phase_margin(gains_of_poles(w if p is None else p, w), delay) >= PHASE_MARGIN
        low, high = (w, high) if enough else (low, w)
    return low
