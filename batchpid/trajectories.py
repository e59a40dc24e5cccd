r"""Setpoints that a robot can follow: point-to-point moves of many envs at once, sampled at the
control ticks.

A move from x0 to x1 is x(t) = x0 + (x1 - x0) s(t), with s from 0 to 1::

    minimum jerk    s = 10 (t/T)^3 - 15 (t/T)^4 + 6 (t/T)^5                 rests at both ends, in acceleration too
    trapezoidal     s'' = +a, 0, -a                                         the fastest within v and a

The first is T. Flash and N. Hogan, The coordination of arm movements, J. Neurosci. 5(7), 1985; the
second B. Siciliano et al., Robotics: Modelling, Planning and Control (2009), section 4.2.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Float64
from batchpid.arrays.records import array_summary
from batchpid.checks import at_least, broadcast, positive, read_array, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.frames import moved, pose_error

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

    def __repr__(self) -> str:
        return array_summary(self, "ticks", *["envs"] * (self.position.ndim - 2), "joints")

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.time)

    def hold(self, duration: float) -> Trajectory:
        """Return this trajectory with its last position held for ``duration`` [s], rounded up to
        whole ticks.
        """
        # Times are ticks times dt: sums of times would collect rounding.
        dt = self.time[0]
        ticks = _count(positive("duration", duration, "s"), dt)
        time = dt * np.arange(1, self.ticks + ticks + 1)
        still = np.repeat(self.position[-1:], ticks, axis=0)
        rest = np.zeros_like(still)
        parts = zip(self[1:], (still, rest, rest), strict=True)
        return Trajectory(time, *map(np.concatenate, parts))


def minimum_jerk(
    start: ArrayLike,
    target: ArrayLike,
    dt: float,
    *,
    duration: ArrayLike | None = None,
    max_velocity: ArrayLike | None = None,
    max_acceleration: ArrayLike | None = None,
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
        total = _limits("duration", duration, move)
    else:
        v, a = (
            _limits(name, math.inf if limit is None else limit, move, finite=False)
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
    time = _ticks(dt, total)
    safe = np.maximum(total, dt)  # a move within one tick is done at its end
    tau = np.minimum(time.reshape(-1, *[1] * move.ndim) / safe, 1.0)
    s = tau**3 * (10 + tau * (6 * tau - 15))
    rate = 30 * tau**2 * (1 - tau) ** 2 / safe
    acceleration = 60 * tau * (1 - tau) * (1 - 2 * tau) / safe**2
    return _trajectory(
        time,
        x0,
        move,
        s,
        rate,
        acceleration,
        done=tau >= 1 - _ROUNDING,
    )


def straight_line(
    start: ArrayLike,
    target: ArrayLike,
    dt: float,
    *,
    duration: float,
) -> Trajectory:
    """Return the minimum-jerk move of a tool between two poses: on a straight line, while it turns
    about one axis (slerp; K. Shoemake, Animating rotation with quaternion curves, 1985).

    ``np.hstack(path[1:])`` are the setpoints of ``OperationalSpace(..., twist=True,
    acceleration=True)``.

    Parameters
    ----------
    start, target
        Poses (7,): x, y, z [m], qw, qx, qy, qz. Of the two ways round, the shorter one is taken.
    dt, duration
        Time of a tick and of the move [s].

    Returns
    -------
    Trajectory
        Poses (ticks, 7); twists (ticks, 6) [m/s, rad/s] and their derivatives, in the world's axes.
    """
    first, last = (broadcast(name, x, (7,)) for name, x in (("start", start), ("target", target)))
    unit = np.append(first[:3], first[3:] / np.linalg.norm(first[3:]))
    move = pose_error(last, unit)
    s = minimum_jerk([0.0], [1.0], dt, duration=duration)
    position = moved(unit, s.position * move)
    return Trajectory(s.time, position, s.velocity * move, s.acceleration * move)


def trapezoidal(
    start: ArrayLike,
    target: ArrayLike,
    dt: float,
    *,
    max_velocity: ArrayLike,
    max_acceleration: ArrayLike,
) -> Trajectory:
    """Return the fastest straight move from rest to rest within limits of velocity and acceleration.

    All joints of an env start and arrive together.

    Parameters
    ----------
    start, target, dt
        As in :func:`minimum_jerk`, and so the errors.
    max_velocity, max_acceleration
        Limits > 0, a number, (joints,) or (envs, joints) [rad/s, rad/s^2 or m/s, m/s^2]. Infinite:
        no velocity limit.
    """
    x0, move = _move(start, target)
    v = _limits("max_velocity", max_velocity, move, finite=False)
    a = _limits("max_acceleration", max_acceleration, move)
    # Limits of s itself: the joints' limits, per metre or radian of the move. The slowest joint sets
    # the pace of all.
    with np.errstate(divide="ignore", over="ignore"):
        vs, as_ = ((limit / np.abs(move)).min(-1, keepdims=True) for limit in (v, a))
    # An env that does not move gets any number, and a duration of 0.
    moves = np.isfinite(as_)
    as_ = np.where(moves, as_, 1.0)
    # A short move never reaches its cruising velocity.
    peak = np.minimum(np.where(moves, vs, 1.0), np.sqrt(as_))
    ramp = peak / as_
    total = np.where(moves, 1 / peak + ramp, 0.0)
    time = _ticks(dt, total)
    t = np.minimum(time.reshape(-1, *[1] * move.ndim), total)
    left = total - t
    s = np.where(
        t < ramp,
        as_ * t**2 / 2,
        np.where(
            left < ramp,
            1 - as_ * left**2 / 2,
            peak * (t - ramp / 2),
        ),
    )
    rate = np.minimum(np.minimum(as_ * t, as_ * left), peak)
    acceleration = np.where(
        t < ramp,
        as_,
        np.where(left < ramp, -as_, 0.0),
    )
    return _trajectory(
        time,
        x0,
        move,
        s,
        rate,
        acceleration,
        done=left <= _ROUNDING * total,
    )


def _trajectory(
    time: Float64,
    x0: Float64,
    move: Float64,
    s: Float64,
    rate: Float64,
    acceleration: Float64,
    done: Any,
) -> Trajectory:
    """Return x0 + move s and its derivatives; exactly the target, at rest, where the move is
    done.
    """
    position = np.where(done, x0 + move, x0 + move * s)
    velocity = np.where(done, 0.0, move * rate)
    return Trajectory(time, position, velocity, np.where(done, 0.0, move * acceleration))


def _move(start: ArrayLike, target: ArrayLike) -> tuple[Float64, Float64]:
    """Return the start and the move (..., joints) of a move."""
    shapes = [
        read_array(name, value).shape for name, value in (("start", start), ("target", target))
    ]
    try:
        shape = np.broadcast_shapes(*shapes)
    except ValueError:
        shape = ()
    if not 1 <= len(shape) <= 2 or 0 in shape:
        problem = f"has shape {shapes[1]} and start {shapes[0]}"
        remedy = "give each as (joints,) or (envs, joints), with the same joints"
        raise InvalidArgumentError("target", problem, remedy=remedy)
    x0, x1 = (
        at_least(n, broadcast(n, x, shape), -math.inf)
        for n, x in (("start", start), ("target", target))
    )
    return x0, x1 - x0


def _limits(
    name: str,
    value: ArrayLike,
    move: Float64,
    finite: bool = True,
) -> Float64:
    """Return ``value`` > 0, shaped as ``move``."""
    return at_least(name, broadcast(name, value, move.shape), 0.0, above=True, infinite=not finite)


def _ticks(dt: float, total: Float64) -> Float64:
    """Return the times of the ticks' ends up to the longest of the durations ``total``, at least
    one.
    """
    return time_step("dt", dt) * np.arange(
        1,
        _count(float(total.max()), dt) + 1,
        dtype=np.float64,
    )


def _count(duration: float, dt: float) -> int:
    """Return how many ticks cover a duration, without a last tick that is due to rounding alone."""
    return max(1, math.ceil(duration / dt * (1 - _ROUNDING)))
