r"""Guard of setpoints: limits of their position, rate and acceleration. Pure functions on (envs,
joints).

With the setpoint r that is asked for, the guarded setpoint g and its rate v, primes for the step
before, and limits lower, upper, V, A::

    r       <- min(max(r, lower), upper)
    e       = r' - g'                             the rest; all differences the short way round on continuous joints
    v       = (r - r') / dt + sgn(e) stop(|e|)    the motion of r, and a profile that stops at the end of the rest
    v       <- min(max(v, -V), V)
    v       <- min(max(v, -stop(g' - lower)), stop(upper - g'))
    v       <- min(max(v, v' - A dt), v' + A dt)
    g       = g' + dt v
    m       = max(ceil(sqrt(1/4 + 2 d / (A dt^2)) - 1/2), 1)      steps of a stop within d
    stop(d) = d / (m dt) + (m - 1) A dt / 2                       d / dt without A

``stop`` is the rate whose m steps of deceleration A end at rest at d: m stop dt - A dt^2 m (m - 1)
/ 2 = d. So g reaches a constant r in the shortest time that the limits allow, without overshoot
from rest, and does not leave [lower, upper] once inside. A setpoint that moves within the limits is
passed unchanged, once it has been reached: then e is 0. This is the sampled form of the nonlinear
trajectory filters of L. Biagiotti and C. Melchiorri, Trajectory Planning for Automatic Machines and
Robots (Springer, 2008), section 4.6, for moving setpoints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

from batchpid.arrays.array_types import Array, ArrayModule, DType
from batchpid.arrays.elementwise import TURN, clip, in_dtype_of, namespace, wrap
from batchpid.arrays.field_tables import Field, declared
from batchpid.arrays.records import LeafBuilder, Record, with_fields
from batchpid.checks import check_time_step

MOST_STEPS = 1e9
"""Longest stop [steps]: a bound, so that the rate within an infinite distance is a number."""


class _GuardFields(NamedTuple):
    lower: Annotated[Array, Field("rad or m", -math.inf, low=-math.inf)] = None
    upper: Annotated[Array, Field("rad or m", math.inf, low=-math.inf)] = None
    rate: Annotated[Array, Field("rad/s or m/s", math.inf, above=True)] = None
    """V [rad/s or m/s]."""
    acceleration: Annotated[Array, Field("rad/s^2 or m/s^2", math.inf, above=True)] = None
    """A [rad/s^2 or m/s^2]."""
    turns: Array = None
    """1 / (2 pi) on continuous joints, 0 elsewhere."""


GUARD_FIELDS = declared(_GuardFields, Field)
"""Options of a joint."""


class Guard(Record, _GuardFields):
    """Limits of setpoints, (1, joints) or (envs, joints); None is off. Build one with
    :func:`make_guard`.
    """

    __slots__ = ()
    NAME = "guard"
    FIELDS = GUARD_FIELDS


class GuardState(NamedTuple):
    """State of the guard (envs, joints)."""

    setpoint: Array
    """g [rad or m]."""
    rate: Array
    """v [rad/s or m/s]."""
    requested: Array
    """r within the limits of the position [rad or m]."""


@with_fields(*GUARD_FIELDS)
def make_guard(
    joints: int,
    *,
    continuous: Array = None,
    joint_names: Sequence[str] | None = None,
    dtype: DType = None,
    **limits: Array,
) -> Guard:
    """Build a validated :class:`Guard`; a number may be a scalar, (joints,) or (envs, joints), None
    is off.

    Parameters
    ----------
    lower, upper
        Limits of the position [rad or m]; without effect on ``continuous`` joints.
    rate, acceleration
        Limits > 0 of the setpoint's rate and acceleration [rad/s or m/s, and per second].
    continuous
        Bools: joints whose position is an angle modulo 2 pi [rad].

    Raises
    ------
    InvalidArgumentError
        Naming the option, joint, env and value.
    """
    build = LeafBuilder(joints, joint_names, dtype, limits.values())
    mask = build.mask("continuous", continuous)
    low, high = build.limits("", "lower", "upper", limits)
    if mask is not None:
        xp = namespace(mask)
        if low is not None:
            low = xp.where(mask > 0, -math.inf, low)
        if high is not None:
            high = xp.where(mask > 0, math.inf, high)
    rates = {name: GUARD_FIELDS[name] for name in ("rate", "acceleration")}
    return Guard(
        lower=build.freeze(low),
        upper=build.freeze(high),
        turns=None if mask is None else build.freeze(mask / TURN),
        **build.options(rates, limits),
    )


def init(guard: Guard, qpos: Array) -> GuardState:
    """Return the state of a guard that starts at rest at ``qpos`` (envs, joints) or (joints,) [rad
    or m].
    """
    (qpos,) = in_dtype_of(guard, qpos)
    guard = guard.for_rank(qpos.ndim)
    zeros = namespace(*guard, qpos).zeros_like(qpos)
    return GuardState(zeros + qpos, zeros, zeros + qpos)


def advance(
    guard: Guard,
    state: GuardState,
    setpoint: Array,
    dt: Array,
) -> tuple[GuardState, Array]:
    """Advance the guard by ``dt`` [s]; return the state, with the guarded ``setpoint``, and a mask
    of the changes.

    ``setpoint`` (envs, joints) or (joints,) [rad or m] is the requested setpoint; it is not
    modified. The mask has the same shape. Raises InvalidArgumentError if dt is a number that is not
    positive, or above 1 s.
    """
    check_time_step(dt)
    (setpoint,) = in_dtype_of(guard, setpoint)
    guard = guard.for_rank(state.setpoint.ndim)
    xp = namespace(*guard, setpoint, *state)
    # A copy: the state keeps it, and the caller may change the setpoint.
    requested = clip(setpoint.copy(), guard.lower, guard.upper, xp)
    # On a continuous joint the short way round.
    per_dt = 1.0 / dt
    arriving = rate = wrap(requested - state.setpoint, guard.turns, xp) * per_dt
    if guard.acceleration is not None:
        # The rest is not made up for at once, but at the rate from which the joint can still stop.
        rest = wrap(state.requested - state.setpoint, guard.turns, xp)
        distance = xp.abs(rest)
        rate = rate - xp.sign(rest) * (distance * per_dt - _stop(guard, distance, dt, xp))
    if guard.rate is not None:
        rate = clip(rate, -guard.rate, guard.rate, xp)
    if guard.acceleration is not None:
        # A setpoint that moves towards a limit may stop there at once, the joint not.
        if guard.upper is not None:
            room = xp.maximum(guard.upper - state.setpoint, 0.0)
            rate = xp.minimum(rate, _stop(guard, room, dt, xp))
        if guard.lower is not None:
            room = xp.maximum(state.setpoint - guard.lower, 0.0)
            rate = xp.maximum(rate, -_stop(guard, room, dt, xp))
        most = dt * guard.acceleration
        rate = clip(rate, state.rate - most, state.rate + most, xp)
    # A setpoint within one step is reached to the bit, not by a sum.
    guarded = xp.where(rate == arriving, requested, state.setpoint + dt * rate)
    return GuardState(guarded, rate, requested), guarded != setpoint


def _stop(
    guard: Guard,
    distance: Array,
    dt: Array,
    xp: ArrayModule,
) -> Array:
    """Return the largest rate that stops within ``distance``; infinite where that is infinite."""
    finite = xp.isfinite(guard.acceleration)
    a = xp.where(finite, guard.acceleration, 1.0)
    per_dt = 1.0 / dt
    steps = xp.ceil(xp.sqrt(0.25 + distance * (2.0 / a * (per_dt * per_dt))) - 0.5)
    steps = xp.where(finite, xp.minimum(xp.maximum(steps, 1.0), MOST_STEPS), 1.0)
    return distance * per_dt / steps + (steps - 1) * (0.5 * dt * a)
