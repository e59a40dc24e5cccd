r"""Candidates of a search for gains: from points in log space to params, and to costs by
simulation.

The cost of a move is the mean over its joints of the following sum. The cost of a candidate is the
mean over its moves, plus the cost of its worst move::

    w_itae log(1 + ITAE / (A 1 s^2)) + w_settling Ts / 1 s + w_overshoot log(1 + O / 5 %) + w_final
    log(1 + E / b)
        + w_chatter log(1 + max(TV / TV_smooth - 1, 0)) + w_saturation S

plus the mean over moves of w_late log(1 + max(Ts / Tmax - 1, 0) / 5 %) for the joint that settles
last.

Ts is limited to 1.5 times the run; Tmax is the settling time asked for. A is the move, or the
smallest move that counts; O the overshoot as a fraction of A; E the final error, and b the least
half width of the settling band; TV the total variation of the effort, and TV_smooth its variation
in the smooth motion that takes a second; S the share of time in saturation. The logarithms prevent
a single move or joint from deciding. Steps alone do not show how closely a moving setpoint is
followed, and the gains that decide it, above all ki, are not those that decide the approach of a
step, where the setpoint weight acts too. So some moves are also made as smooth motions of the
setpoint, with its rate: the half whose motions are the shortest, because these have the largest
accelerations. Their cost, also the mean over moves plus the cost of the worst one, is added::

    w_following log(1 + F / (10 b))

where F is the largest following error, b the least half width of the settling band, 1e-3 rad or
1e-4 m, and F / b that of the arm's worst joint. w_following is 1 by default; with 0 there are no
such motions. With a randomization, a robot may be drawn that no gains can control; then twice the
mean over moves replaces the sum of mean and worst.

The first candidates for robots that differ from the model are designed from the time asked for and
the loop's delay. The integral adapts to unknown loads. Designed gains have three poles of nearly
equal speed; faster ones would saturate the effort on a step of the setpoint. The first candidates
have one real pole -p, which sets the time in which a setpoint is reached, and two at -w, which
reject the load::

    s^3 + kd s^2 + kp s + ki = (s + p) (s + w)^2        kd = p + 2 w    kp = w^2 + 2 p w    ki = p w^2

per unit of inertia. A load of acceleration a moves the joint by about a / w^2, independent of p.
The loop is stable while joints are heavier than the model by a factor below kd kp / ki (Routh and
Hurwitz), 9 at w = p and 15 at w = 5 p.

The delay T of the loop limits w: the phase margin of L(s) = (kd s^2 + kp s + ki) / s^3 exp(-s T) is
to be 45 degrees (K. J. Astrom and R. M. Murray, Feedback Systems, 2008, section 9.3).
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
from batchpid.sim.diagnosis.causes import absolute_band
from batchpid.sim.diagnosis.loop_stability import StabilityWarning
from batchpid.sim.randomization.checks import prepared_actuators
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner.runner import Runner
from batchpid.sim.signals.rollout import Rollout
from batchpid.sim.tuning.cost import Weights
from batchpid.sim.tuning.evaluation import (
    SETTLE_SECONDS,
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
"""Factors that are searched for all joints together; with ``per_joint`` one for each joint's
inertia as well.

A bandwidth factor c scales all poles: kp c^2, ki c^3, kd c. Stiffness multiplies kp alone, damping
kd alone.
"""
DIVERGED_COST = 1e3
"""Cost of a candidate that diverges; up to twice as much if it diverges early."""
PENALTY_RATIO = 0.8
"""Stability ratio (:func:`batchpid.stability_bound`) beyond which a candidate is penalised."""
PHASE_MARGIN = np.pi / 4
"""Least phase margin of the first candidates [rad]."""
SPEEDS, SHARES = (7.0, 5.5), (0.65, 1.0, 0.4)
"""Poles p of the candidates in units of 1 / (settling time asked for), and w as a share of its
range above p.
"""
FASTEST = 6.0
"""Largest w, in units of p: beyond it there is more chatter and little else."""
_DRAWS = 100


class Candidates:
    """Candidates of a search on ``moves``, as points in log space. The point 0 has the designed
    gains.

    Each env runs one move of one candidate: all moves as steps, then the half whose smooth motions
    are the shortest. Row k of ``motors`` is for move k, modulo their number.
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
        headroom: float,
        varied: bool,
        motors: bp.Actuators | None = None,
    ) -> None:
        self.robot = robot
        self.seconds = seconds
        self.weights = weights
        self.headroom = headroom
        self._varied = varied
        self.designed = robot.designed(gain_units)
        joints = int(robot.independent.sum())
        self.dimension = len(FACTORS) + (joints if per_joint else 0)
        self._band = absolute_band(robot)
        self._smooth = smooth_variation(robot, moves, 1.0)
        self._limit = settling_limits(robot, moves)
        self._size = np.maximum(np.abs(moves.target - moves.start), self._band / 0.02)
        durations = smooth_durations(robot, moves)
        shortest = np.argsort(durations, kind="stable")[
            : max(1, len(durations) // 2) if weights.following else 0
        ]
        self._steps = len(durations)
        self._rows = np.concatenate(
            [np.arange(self._steps), shortest]
        )  # a move has the same drawn robot both times
        self._moves = moves.take(self._rows)
        self._durations = (
            np.concatenate([np.zeros(self._steps), durations[shortest]]) if len(shortest) else None
        )
        self._motors = None if motors is None else motors.for_envs(self._rows % motors.num_envs)
        # The plant that the gains see: mass matrices and viscous damping.
        self._mass, self._damping = np.eye(joints)[None], np.zeros(joints)
        if gain_units != "mass_matrix":
            mass = robot.mass_matrix(robot.sample(50, seed=0))
            self._mass, self._damping = (
                robot.coupling.reduced(mass),
                robot.coupling.reduced_damping(robot.damping),
            )

    def runner(self, count: int, options: Document) -> Runner:
        """Return a runner for ``count`` candidates."""
        envs = count * len(self._rows)
        if self._motors is not None:
            options = options | {
                "actuators": self._motors.for_envs(np.arange(envs) % len(self._rows))
            }
        return Runner(self.robot, envs, **options)

    def points(self, gains: Sequence[Float64]) -> Float64:
        """Return the points (n, dimension) of ``gains``: (ki, kp, kd) each, per unit of inertia.

        The designed gains per mass matrix are such gains; in other units the same factors are
        taken.
        """
        designed = self.robot.designed()
        medians = [
            np.median(leaf[..., self.robot.independent])
            for leaf in (designed.ki, designed.kp, designed.kd)
        ]
        ki, kp, kd = (np.array(gains) / medians).T
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

    def costs(self, runner: Runner, points: Float64) -> Float64:
        """Run each of ``points`` (n, dimension) on its :meth:`runner`, and return the costs
        (n,).
        """
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

        # All moves of all candidates are one rollout. A move has the same drawn robot in each.
        envs = np.tile(np.arange(rows), count)
        rollout, metrics = run_moves(
            runner,
            self._moves.take(envs),
            self.seconds,
            streams=self._rows[envs],
            durations=None if self._durations is None else self._durations[envs],
        )
        # Simulations may diverge: figures are limited. (candidates, moves, joints)
        figures = [np.minimum(figure, 1e6).reshape(count, rows, -1) for figure in metrics]
        steps = StepMetrics(*(figure[:, : self._steps] for figure in figures))
        total = self._cost_of_steps(steps)
        if self._durations is not None:
            total += self.weights.following * self._cost_of_motions(rollout, count)
        # A candidate of which one move diverges is worse than all others, the earlier the worse.
        lasted = rollout.ok.mean(0).reshape(count, -1)
        diverged = DIVERGED_COST * (2 - lasted.mean(1))
        total = np.where(lasted.min(1) < 1, diverged, np.minimum(total, DIVERGED_COST))
        return total + self._stability_penalty(params, runner.timestep)

    def _cost_of_steps(self, m: StepMetrics) -> Float64:
        """Return the cost of moves that are made as steps of the setpoint (count,)."""
        w = self.weights
        settling = np.minimum(m.settling_time, 1.5 * self.seconds)
        excess = np.maximum(m.effort_variation / self._smooth - 1, 0)
        cost = w.itae * np.log1p(m.itae / self._size)
        cost += w.settling * settling
        cost += w.overshoot * np.log1p(m.peak_deviation / self._size / 0.05)
        cost += w.final * np.log1p(m.steady_state_error / self._band)
        cost += w.chatter * np.log1p(excess)
        cost += w.saturation * m.saturation_share
        # A move is late when its last joint is.
        last = settling[..., arm_joints(self.robot)].max(2)
        late = np.log1p(np.maximum(last / self._limit - 1, 0) / 0.05).mean(1)
        total: Float64 = self._over_moves(cost[..., self.robot.independent].mean(2)) + w.late * late
        return total

    def _cost_of_motions(self, rollout: Rollout, count: int) -> Float64:
        """Return the cost of moves that are made as smooth motions (count,)."""
        error = following_error(self.robot, rollout) / self._band
        worst = np.minimum(error[:, arm_joints(self.robot)].max(1), 1e6)
        return self._over_moves(np.log1p(worst.reshape(count, -1)[:, self._steps :] / 10))

    def _over_moves(self, cost: Float64) -> Float64:
        """Return the mean of ``cost`` (count, moves) over moves plus its largest, or twice the
        mean: (count,).
        """
        total: Float64 = cost.mean(1) + (cost.mean(1) if self._varied else cost.max(1))
        return total

    def _stability_penalty(self, params: bp.PIDParams, dt: float) -> Float64:
        """Return the penalty (count,) of candidates near the stability bound, whose moves may look
        stable.
        """
        leaves = np.stack(np.broadcast_arrays(params.kp, params.kd, params.derivative_filter_time))
        ratios = [
            stability_bound(
                self._mass, kp, kd, dt, filter_time=tau, damping=self._damping
            ).ratio.max()
            for kp, kd, tau in zip(*leaves[..., self.robot.independent], strict=True)
        ]
        return 10 * np.maximum(np.array(ratios) - PENALTY_RATIO, 0)


def loop_delay(
    robot: Robot, randomization: Randomization | None, own: float, motors: Actuators | None = None
) -> float:
    """Return the delay of the slowest joint's loop [s]: its motor's and sensor's, lag included, and
    ``own``.

    ``motors`` replace the robot's actuators.
    """
    actuators = robot.actuators if motors is None else motors
    if randomization is not None and randomization.actuators:
        prepared = prepared_actuators(randomization, actuators, robot)
        actuators = randomization.randomized_actuators(
            prepared, randomization.first(robot, _DRAWS), robot
        )
    if actuators is None:
        return own
    parts = (actuators.command_delay, actuators.sensor_delay, actuators.lag)
    return own + float(np.max(sum(0.0 if part is None else part for part in parts)))


def phase_margin(gains: Float64, delay: float) -> float:
    """Return the phase margin [rad] of (ki, kp, kd) per unit of inertia on a double integrator with
    ``delay`` [s].
    """
    ki, kp, kd = gains
    squares = np.roots([1.0, -(kd**2), 2 * ki * kd - kp**2, -(ki**2)])  # |L(i w)|^2 = 1 in w^2
    w = float(np.sqrt(squares[np.abs(squares.imag) < 1e-6 * np.abs(squares)].real.max()))
    return float(np.angle(ki - kd * w**2 + 1j * kp * w) - np.pi / 2 - w * delay)


def gains_of_poles(p: float, w: float) -> Float64:
    """Return (ki, kp, kd) per unit of inertia of poles at -p, -w and -w [1/s]."""
    return np.array([p * w**2, w**2 + 2 * p * w, p + 2 * w])


def first_gains(delay: float) -> list[Float64]:
    """Return (ki, kp, kd) per unit of inertia of the candidates for a loop with ``delay`` [s], the
    likeliest first.
    """
    designs = []
    for share in SHARES:
        for speed in SPEEDS:
            p = min(speed / SETTLE_SECONDS, _fastest(delay))
            w = min(_fastest(delay, p), FASTEST * p)
            designs.append(gains_of_poles(p, p + share * max(w - p, 0.0)))
    return designs


def _fastest(delay: float, p: float | None = None) -> float:
    """Return the largest w [1/s] with the phase margin, by bisection; without ``p`` for three poles
    at -w.
    """
    low, high = 1e-2, 1e4
    for _ in range(50):
        w = float(np.sqrt(low * high))
        enough = phase_margin(gains_of_poles(w if p is None else p, w), delay) >= PHASE_MARGIN
        low, high = (w, high) if enough else (low, w)
    return low
