r"""Setpoints that a robot can follow: point-to-point moves of many envs at once, sampled at the
control ticks.

A move from x0 to x1 is x(t) = x0 + (x1 - x0) s(t), with s from 0 to 1 and at rest at both ends, in
acceleration too::

    s = 10 (t/T)^3 - 15 (t/T)^4 + 6 (t/T)^5

T. Flash and N. Hogan, The coordination of arm movements, J. Neurosci. 5(7), 1985.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64
from batchpid.checks import at_least, broadcast, number, read_array, time_step
from batchpid.errors import InvalidArgumentError

_PEAK_VELOCITY = 15 / 8  # of the minimum-jerk s, times T
_PEAK_ACCELERATION = 10 / math.sqrt(3)  # times T^2
_ROUNDING = 1e-12  # share of a duration: a tick that ends this much before the end is the last one


class Trajectory(NamedTuple):
    """Setpoints by tick: ``time`` (ticks,) [s], the others (ticks, ..., joints) in rad or m, and
    per s and s^2.

    Row k is for tick k and holds the target at the end of the tick, ``time[k]`` = (k + 1) dt. So
    ``runner.rollout(t.position, setpoint_rates=t.velocity)`` follows it, and the last row is the
    target itself.
    """

    time: Float64
    position: Float64
    velocity: Float64
    acceleration: Float64

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.time)


def minimum_jerk(
    start: ArrayLike,
    target: ArrayLike,
    dt: float,
    *,
    duration: ArrayLike | None = None,
    max_velocity: ArrayLike | None = None,
    max_acceleration: ArrayLike | None = None,
    hold: float = 0.0,
) -> Trajectory:
    """Return the move of least jerk from rest at ``start`` to rest at ``target``.

    Parameters
    ----------
    start, target
        (joints,) or (envs, joints) [rad or m].
    dt
        Time of a tick [s].
    duration
        T [s]: a number, (envs, 1) or (envs, joints); a joint that arrives before others holds its
        target.
    max_velocity, max_acceleration
        Instead of ``duration``: limits > 0 of every joint, (joints,) or (envs, joints). Each env
        takes the shortest T that respects them on all of its joints; an infinite limit does not
        apply, but each joint needs one that does.
    hold
        Time for which the target is held after the longest of the moves [s].

    Raises
    ------
    InvalidArgumentError
        Naming the argument and joint; also where neither a duration nor a limit is given, or both
        are, and where both limits of a joint are infinite.
    """
    # Each env takes the longest time that any of its joints needs.
    x0, move = _move(start, target)
    if (duration is None) == (max_velocity is None and max_acceleration is None):
        remedy = "give duration=, or max_velocity= and max_acceleration="
        raise InvalidArgumentError("duration", "is needed, or limits, not both", remedy=remedy)
    if duration is not None:
        total = _limit("duration", duration, move)
    else:
        v, a = (
            _limit(name, math.inf if limit is None else limit, move)
            for name, limit in (
                ("max_velocity", max_velocity),
                ("max_acceleration", max_acceleration),
            )
        )
        if np.isinf(np.minimum(v, a)).any():
            problem = "is infinite, and so is max_acceleration, for a joint"
            raise InvalidArgumentError("max_velocity", problem, remedy="limit one of them")
        distance = np.abs(move)
        needed = np.maximum(
            _PEAK_VELOCITY * distance / v, np.sqrt(_PEAK_ACCELERATION * distance / a)
        )
        total = np.broadcast_to(needed.max(-1, keepdims=True), move.shape)
    # Whole ticks, without a last one that is due to rounding alone.
    end = float(total.max()) + number("hold", hold, 0.0, math.inf, "s")
    count = max(1, math.ceil(end / time_step("dt", dt) * (1 - _ROUNDING)))
    time = dt * np.arange(1.0, count + 1)
    safe = np.maximum(total, dt)  # a move within one tick is done at its end
    tau = np.minimum(time.reshape(-1, *[1] * move.ndim) / safe, 1.0)
    s = tau**3 * (10 + tau * (6 * tau - 15))
    rate = 30 * tau**2 * (1 - tau) ** 2 / safe
    acceleration = 60 * tau * (1 - tau) * (1 - 2 * tau) / safe**2
    # Exactly the target, at rest, where the move is done.
    done = tau >= 1 - _ROUNDING
    return Trajectory(
        time,
        np.where(done, x0 + move, x0 + move * s),
        np.where(done, 0.0, move * rate),
        np.where(done, 0.0, move * acceleration),
    )


def _move(start: ArrayLike, target: ArrayLike) -> tuple[Float64, Float64]:
    """Return the start and the move (..., joints) of a move."""
    x0, x1 = read_array("start", start), read_array("target", target)
    # Either may be one row for all envs.
    shape = max(x0.shape, x1.shape, key=lambda shape: (len(shape), shape))
    if not 1 <= len(shape) <= 2 or 0 in shape:
        problem = f"has shape {x1.shape}, and start {x0.shape}"
        remedy = "give each as (joints,) or (envs, joints), with the same joints"
        raise InvalidArgumentError("target", problem, remedy=remedy)
    x0, x1 = (
        at_least(name, broadcast(name, x, shape), -math.inf)
        for name, x in (("start", x0), ("target", x1))
    )
    return x0, x1 - x0


def _limit(name: str, value: ArrayLike, move: Float64) -> Float64:
    """Return ``value`` > 0, shaped as ``move``; limits may be infinite."""
    rows = broadcast(name, value, move.shape)
    return at_least(name, rows, 0.0, above=True, infinite=name != "duration")
