r"""Setpoints that a robot can follow: point-to-point moves of many envs at once, sampled at the control ticks.

A move from x0 to x1 is x(t) = x0 + (x1 - x0) s(t), with s from 0 to 1::

    minimum jerk    s = 10 (t/T)^3 - 15 (t/T)^4 + 6 (t/T)^5                 rests at both ends, in acceleration too
    trapezoidal     s'' = +a, 0, -a                                         the fastest within v and a
    jerk limited    s''' = +j, 0, -j                                        the fastest within v, a and j

The first is T. Flash and N. Hogan, The coordination of arm movements, J. Neurosci. 5(7), 1985; the second B. Siciliano
et al., Robotics: Modelling, Planning and Control (2009), section 4.2; the third is left to the ``ruckig`` library
(L. Berscheid and T. Kroeger, Jerk-limited real-time trajectory generation, RSS 2021).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.display import array_summary
from batchpid.errors import InvalidArgumentError, MissingDependencyError

Float64 = NDArray[np.float64]

_PEAK_VELOCITY = 15 / 8  # of the minimum-jerk s, times T
_PEAK_ACCELERATION = 10 / math.sqrt(3)  # times T^2
_NO_WAY = 1e-100  # [rad or m]: below this a quotient by the distance would overflow


class Trajectory(NamedTuple):
    """Setpoints by tick: ``time`` (ticks,) [s], the others (ticks, ..., joints) in rad or m, and per s and s^2.

    Row k is for tick k and holds what is to be reached at its end, ``time[k]`` = (k + 1) dt. So
    ``runner.rollout(t.position, setpoint_rates=t.velocity)`` follows it, and the last row is the target itself.
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

    def then(self, other: Trajectory) -> Trajectory:
        """Return this trajectory followed by ``other``, which has the same tick and shape.

        Raises
        ------
        InvalidArgumentError
            The tick or the shape differs.
        """
        if other.position.shape[1:] != self.position.shape[1:]:
            raise InvalidArgumentError(
                "other",
                f"moves {other.position.shape[1:]} (..., joints), not {self.position.shape[1:]}",
                remedy="give both the same shape",
            )
        if not math.isclose(other.time[0], self.time[0], rel_tol=1e-9):
            raise InvalidArgumentError(
                "other",
                "has another tick",
                value=float(other.time[0]),
                remedy=f"use dt={self.time[0]:g} in both",
            )
        parts = zip(self[1:], other[1:], strict=True)
        return Trajectory(
            self.time[0] * np.arange(1, self.ticks + other.ticks + 1),
            *(np.concatenate(pair) for pair in parts),
        )

    def hold(self, duration: float) -> Trajectory:
        """Return this trajectory with its last position held for ``duration`` [s], rounded up to whole ticks."""
        _positive("duration", duration, ())
        ticks = _count(duration, self.time[0])
        still = np.broadcast_to(self.position[-1], (ticks, *self.position.shape[1:]))
        rest = np.zeros_like(still)
        return self.then(Trajectory(self.time[0] * np.arange(1, ticks + 1), still, rest, rest))


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
        T [s]: a number, (envs, 1) or (envs, joints); whoever arrives first holds the target.
    max_velocity, max_acceleration
        Instead of ``duration``: limits > 0 of every joint, (joints,) or (envs, joints). Each env takes the shortest T
        that respects them on all of its joints; an infinite one is none.

    Raises
    ------
    InvalidArgumentError
        Naming the argument and joint; also where neither a duration nor a finite limit is given, or both are.
    """
    x0, way = _move(start, target)
    if (duration is None) == (max_velocity is None and max_acceleration is None):
        raise InvalidArgumentError(
            "duration",
            "or limits are needed, and not both",
            remedy="give duration=, or max_velocity= and max_acceleration=",
        )
    if duration is not None:
        total = np.broadcast_to(_positive("duration", duration, way.shape), way.shape)
    else:
        v = _positive("max_velocity", np.inf if max_velocity is None else max_velocity, way.shape, finite=False)
        a = _positive(
            "max_acceleration",
            np.inf if max_acceleration is None else max_acceleration,
            way.shape,
            finite=False,
        )
        if np.isinf(np.broadcast_to(np.minimum(v, a), way.shape)).any():
            raise InvalidArgumentError(
                "max_velocity",
                "and max_acceleration are both infinite on a joint",
                remedy="limit one of them",
            )
        distance = np.abs(way)
        needed = np.maximum(_PEAK_VELOCITY * distance / v, np.sqrt(_PEAK_ACCELERATION * distance / a))
        total = np.broadcast_to(needed.max(-1, keepdims=True), way.shape)
    time = _ticks(dt, total)
    safe = np.maximum(total, dt)  # a move within one tick is done at its end
    tau = np.minimum(time[(...,) + (None,) * way.ndim] / safe, 1.0)
    s = tau**3 * (10 + tau * (6 * tau - 15))
    rate = 30 * tau**2 * (1 - tau) ** 2 / safe
    acceleration = 60 * tau * (1 - tau) * (1 - 2 * tau) / safe**2
    return _trajectory(time, x0, way, s, rate, acceleration, done=tau >= 1.0)


def trapezoidal(
    start: ArrayLike,
    target: ArrayLike,
    dt: float,
    *,
    max_velocity: ArrayLike,
    max_acceleration: ArrayLike,
    synchronise: bool = True,
) -> Trajectory:
    """Return the fastest move from rest to rest within limits of velocity and acceleration.

    Parameters
    ----------
    start, target
        (joints,) or (envs, joints) [rad or m].
    dt
        Time of a tick [s].
    max_velocity, max_acceleration
        Limits > 0, a number, (joints,) or (envs, joints) [rad/s, rad/s^2 or m/s, m/s^2]. An infinite velocity is none.
    synchronise
        All joints of an env start and arrive together, on a straight line; else each goes as fast as it may.

    Raises
    ------
    InvalidArgumentError
        Naming the argument and joint.
    """
    x0, way = _move(start, target)
    v = np.broadcast_to(_positive("max_velocity", max_velocity, way.shape, finite=False), way.shape)
    a = np.broadcast_to(_positive("max_acceleration", max_acceleration, way.shape), way.shape)
    distance = np.abs(way)
    moves = distance > _NO_WAY
    # Limits of s itself: those of the joints, per metre or radian of the way.
    vs = np.divide(v, distance, out=np.full(way.shape, np.inf), where=moves)
    as_ = np.divide(a, distance, out=np.full(way.shape, np.inf), where=moves)
    if synchronise:
        vs, as_ = (np.broadcast_to(limit.min(-1, keepdims=True), way.shape) for limit in (vs, as_))
        moves = np.broadcast_to(moves.any(-1, keepdims=True), way.shape)
    as_ = np.where(moves, as_, 1.0)
    peak = np.minimum(np.where(moves, vs, 1.0), np.sqrt(as_))  # a short move never reaches its cruising velocity
    ramp = peak / as_
    total = np.where(moves, 1 / peak + ramp, 0.0)
    time = _ticks(dt, total)
    t = np.minimum(time[(...,) + (None,) * way.ndim], total)
    left = total - t
    s = np.where(t < ramp, as_ * t**2 / 2, np.where(left < ramp, 1 - as_ * left**2 / 2, peak * (t - ramp / 2)))
    rate = np.minimum(np.minimum(as_ * t, as_ * left), peak)
    acceleration = np.where(t < ramp, as_, np.where(left < ramp, -as_, 0.0))
    return _trajectory(time, x0, way, s, rate, acceleration, done=left <= 0)


def jerk_limited(
    start: ArrayLike,
    target: ArrayLike,
    dt: float,
    *,
    max_velocity: ArrayLike,
    max_acceleration: ArrayLike,
    max_jerk: ArrayLike,
    start_velocity: ArrayLike = 0.0,
    start_acceleration: ArrayLike = 0.0,
) -> Trajectory:
    """Return the fastest move to rest at ``target`` within limits of velocity, acceleration and jerk, by ``ruckig``.

    The joints of an env arrive together; the move may begin in motion. Shapes as in :func:`trapezoidal`; every limit
    is finite.

    Raises
    ------
    MissingDependencyError
        Without the ``ruckig`` package.
    InvalidArgumentError
        Naming the argument and joint; also where ruckig finds no such move, e.g. from beyond a limit.
    """
    try:
        import ruckig
    except ImportError:
        raise MissingDependencyError("ruckig", "jerk_limited()", "ruckig") from None
    x0, way = _move(start, target)
    rows = way.reshape(-1, way.shape[-1])

    def by_env(value: Float64) -> Float64:
        return np.broadcast_to(value, way.shape).reshape(rows.shape)

    v, a, j = (
        by_env(_positive(name, limit, way.shape))
        for name, limit in (
            ("max_velocity", max_velocity),
            ("max_acceleration", max_acceleration),
            ("max_jerk", max_jerk),
        )
    )
    v0, a0 = (
        by_env(_numbers(name, value, way.shape))
        for name, value in (("start_velocity", start_velocity), ("start_acceleration", start_acceleration))
    )
    first, last = by_env(x0), by_env(x0 + way)
    _positive("dt", dt, ())
    planner, plans = ruckig.Ruckig(rows.shape[1], float(dt)), []
    for env in range(len(rows)):
        asked = ruckig.InputParameter(rows.shape[1])
        asked.current_position, asked.target_position = first[env].tolist(), last[env].tolist()
        asked.current_velocity, asked.current_acceleration = v0[env].tolist(), a0[env].tolist()
        asked.max_velocity, asked.max_acceleration = v[env].tolist(), a[env].tolist()
        asked.max_jerk = j[env].tolist()
        plan = ruckig.Trajectory(rows.shape[1])
        try:
            planner.calculate(asked, plan)
        except ruckig.RuckigError:
            raise InvalidArgumentError(
                "start",
                "allows no jerk-limited move",
                env=env,
                remedy="begin within the limits, or widen them",
            ) from None
        plans.append(plan)
    time = _ticks(dt, np.array([plan.duration for plan in plans]))
    table = np.array([[plan.at_time(min(t, plan.duration)) for plan in plans] for t in time.tolist()])
    arrived = time[:, None, None] >= np.array([plan.duration for plan in plans])[:, None]
    position, velocity, acceleration = (
        np.where(arrived, rest, table[:, :, k]).reshape(len(time), *way.shape)
        for k, rest in enumerate((last, np.zeros(()), np.zeros(())))
    )
    return Trajectory(time, position, velocity, acceleration)


def _trajectory(
    time: Float64, x0: Float64, way: Float64, s: Float64, rate: Float64, acceleration: Float64, done: Any
) -> Trajectory:
    """Return x0 + way s and its derivatives; exactly the target, at rest, where the move is done."""
    return Trajectory(
        time,
        np.where(done, x0 + way, x0 + way * s),
        np.where(done, 0.0, way * rate),
        np.where(done, 0.0, way * acceleration),
    )


def _move(start: ArrayLike, target: ArrayLike) -> tuple[Float64, Float64]:
    """Return the start and the way (..., joints) of a move."""
    x0, x1 = _numbers("start", start), _numbers("target", target)
    try:
        shape = np.broadcast_shapes(x0.shape, x1.shape)
    except ValueError:
        shape = ()
    if not 1 <= len(shape) <= 2 or 0 in shape:
        raise InvalidArgumentError(
            "target",
            f"has shape {x1.shape} and start {x0.shape}",
            remedy="give each as (joints,) or (envs, joints), with the same joints",
        )
    x0, x1 = np.broadcast_to(x0, shape), np.broadcast_to(x1, shape)
    return x0, x1 - x0


def _ticks(dt: float, total: Float64) -> Float64:
    """Return the times of the ticks' ends up to the longest of the durations ``total``, at least one."""
    _positive("dt", dt, ())
    return float(dt) * np.arange(1, _count(float(total.max()), dt) + 1, dtype=np.float64)


def _count(duration: float, dt: float) -> int:
    """Return how many ticks cover a duration; a last one by rounding alone is none."""
    return max(1, math.ceil(duration / dt * (1 - 1e-12)))


def _numbers(name: str, value: ArrayLike, shape: tuple[int, ...] | None = None, finite: bool = True) -> Float64:
    """Return ``value`` as float64 that broadcasts to ``shape``, with no NaN, and no infinity where finite."""
    try:
        array = np.asarray(value, np.float64)
        if shape is not None:
            np.broadcast_to(array, shape)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            name, f"cannot be used: {error}", remedy=f"give numbers of a shape that broadcasts to {shape}"
        ) from None
    wrong = ~np.isfinite(array) if finite else np.isnan(array)
    if wrong.any():
        _complain(name, "is not finite" if finite else "is NaN", array, wrong)
    return array


def _positive(name: str, value: ArrayLike, shape: tuple[int, ...], finite: bool = True) -> Float64:
    array = _numbers(name, value, shape, finite)
    if not (array > 0).all():
        _complain(name, "must be > 0", array, ~(array > 0))
    return array


def _complain(name: str, problem: str, array: Float64, wrong: Any) -> None:
    index = tuple(int(n) for n in np.argwhere(wrong)[0])
    raise InvalidArgumentError(
        name,
        problem,
        joint=index[-1] if index else None,
        env=index[-2] if len(index) > 1 else None,
        value=float(array[index]),
        remedy="correct that entry",
    )
