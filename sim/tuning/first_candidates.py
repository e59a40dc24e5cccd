r"""First candidates of a search for robots that differ from the model, from the time asked for and the loop's delay.

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

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.motors.actuators import Actuators
from batchpid.sim.randomization.checks import prepared_actuators
from batchpid.sim.randomization.randomization import Randomization
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tuning.evaluation import SETTLE_SECONDS

PHASE_MARGIN = np.pi / 4
"""Least phase margin of the first candidates [rad]."""
SPEEDS, SHARES = (7.0, 5.5), (0.65, 1.0, 0.4)
"""Poles p of the candidates in units of 1 / (settling time asked for), and w as a share of its range above p."""
FASTEST = 6.0
"""Largest w, in units of p: beyond it there is more chatter and little else."""
_DRAWS = 100


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
