r"""State of a plan: chunks are added when they come, and sampled at any time. Pure functions, for
NumPy and JAX.

A chunk has rows c_k for the times T_k = time + k P. Of two and more rows, with the present plan
x(t) and the time t of the last sample, the blended rows are, by :func:`batchpid.make_plan`'s blend::

    newest      b_k = c_k
    align       b_k = c_k + o max(1 - s, 0) + (o + o' fade) u (1 - u)^2 / 5
                s   = (T_k - T_f) / fade,   u = min(5 s, 1)
    ensemble    b_k = x(T_k) + g_k / (W_k + g_k) (c_k - x(T_k)),   g_k = 1 - W_k (1 - exp(-m))
    average     the same with g_k = W_k share / (1 - share), or 1 where W_k is 0

o = x(T_f) - c_f is the offset, which fades, and o' = x'(T_f) - c'_f its rate, from which the rate
of the fading is reached in a fifth of that time. f is the first row that is at least P / 2 ahead of
t; those before it have passed, and are dropped. If all have passed, the last one is taken for t +
P. W_k is the weight of the chunks so far at that time, to which g_k is added: without taper the g
are exp(-m i), i = 0, 1, ... With a taper g_k is multiplied by min(1, (T_n - T_k) / taper), where
T_n is the end of the chunk.

The knots of the new plan are x(t) at t, where the plan has its rate too, and b_k at T_k from f on,
with the rates (b_{k+1} - b_{k-1}) / (2 P), one-sided at the ends of the chunk. Behind the last row
the plan comes to rest there within P, and stays. So position and rate are continuous, whenever a
chunk comes. Between two knots of distance D, with r, v at the first and q, w at the second one, the
cubic of u = (t - T) / D is::

    x   = r + u (D v + u (c + u d)),    c = 3 (q - r) - D (2 v + w),    d = D (v + w) - 2 (q - r)
    x'  = v + u (2 c + 3 u d) / D
    x'' = (2 c + 6 u d) / D^2

Limits of the plan are those of :mod:`batchpid.motors.guard` on x. The alignment is after the policy
runner of axol, the ensemble after ACT (T. Z. Zhao et al., Learning Fine-Grained Bimanual
Manipulation with Low-Cost Hardware, RSS 2023), the average after LeRobot.
"""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import in_dtype_of, namespace, take_rows
from batchpid.arrays.trees import mapped
from batchpid.checks.validate import instance
from batchpid.errors import InvalidArgumentError
from batchpid.motors import guard as guard_model
from batchpid.motors.guard import Guard, GuardState
from batchpid.plan.plans import SPARE_ROWS, Held, Linear, Plan

EASE = 0.2
"""Share of the fading in which its rate is reached."""
LEAST_STEP = 1e-9
"""Least time between two samples [s]: the limits divide by it."""


class PlanState(NamedTuple):
    """State of a plan. Arrays are (envs, joints), knots and their likes (envs, horizon + 3,
    joints).
    """

    knots: Array
    """Positions [rad or m]; the first one is the point where the plan was joined."""
    rates: Array
    """Rates of the knots [rad/s or m/s]."""
    weights: Array
    """Weights W of the knots in an ensemble or average, else 0."""
    join: Array
    """Time of the first knot [s]."""
    time: Array
    """Time of the second knot [s]; the others follow in steps of the period."""
    end: Array
    """Time of the last row of the last chunk [s]."""
    now: Array
    """Time of the last sample [s]."""
    starved: Array
    """Number of samples so far that were later than the end."""
    guard: GuardState | None
    """State of the limits; None without limits."""


def init(plan: Plan, qpos: Array, time: Array = 0.0) -> PlanState:
    """Return the state of a plan at rest at ``qpos`` (envs, joints) [rad or m] and ``time`` [s], a
    number or (envs,).

    Under a jax.jit the plan must be a constant, since its horizon is the length of the arrays.
    """
    instance("plan", plan, Plan, "build it with make_plan")
    (qpos,) = in_dtype_of(plan, qpos)
    xp = namespace(*plan, qpos)
    zeros = xp.zeros_like(qpos + plan.blended)
    start, at = zeros + qpos, zeros + _column(time)
    knots = xp.repeat(start[..., None, :], plan.horizon + SPARE_ROWS, axis=-2)
    empty = xp.zeros_like(knots)
    limits = _guard(plan)
    guard = None if limits is None else guard_model.init(limits, start)
    return PlanState(knots, empty, empty, at, at, at, at, zeros, guard)


def add(
    plan: Plan,
    state: PlanState,
    chunk: Array,
    time: Array,
) -> PlanState:
    """Add a chunk, after the last sample; return the state.

    ``chunk`` (envs, rows, joints) [rad or m] has the positions at ``time`` + k period; ``time`` [s]
    is a number or (envs,). What has been sampled stays as it is.

    Raises InvalidArgumentError if the chunk has another number of joints than the plan, or more
    rows than its horizon.
    """
    (chunk,) = in_dtype_of(plan, chunk)
    xp = namespace(*plan, chunk, state.knots, time)
    (count, joints), (rows, width) = state.knots.shape[-2:], chunk.shape[-2:]
    if width != joints or not 0 < rows <= count - SPARE_ROWS:
        problem = f"has shape {chunk.shape}, not (envs, 1 to {count - SPARE_ROWS}, {joints})"
        raise InvalidArgumentError("chunk", problem, remedy="give rows of all joints, in order")
    period, now = plan.period, state.now
    chunk = chunk + xp.zeros_like(now)[..., None, :]
    begin = xp.zeros_like(now) + _column(time)
    # Rows that have passed are dropped; if all have, the last one is still the newest wish.
    ahead = xp.maximum(xp.ceil((now - begin) / period + 0.5), 0.0)
    first = xp.minimum(ahead, rows - 1.0)
    joined = xp.where(ahead > first, now + period, begin + first * period)
    position, rate, _ = curve(plan, state, now)
    # A single row tells no motion that could be aligned.
    present, slope, _ = curve(plan, state, begin + first * period)
    offset = xp.where(rows > 1, present - take_rows(chunk, first), 0.0)
    low, high = xp.maximum(first - 1.0, 0.0), xp.minimum(first + 1.0, rows - 1.0)
    rise = take_rows(chunk, high) - take_rows(chunk, low)
    slope = xp.where(rows > 1, slope - rise / (xp.maximum(high - low, 1.0) * period), 0.0)
    # All rows at once: plan and state have an axis more.
    steps = xp.cumsum(xp.ones_like(chunk), axis=-2) - 1.0
    wide = state._replace(
        knots=state.knots[..., None, :, :],
        rates=state.rates[..., None, :, :],
        weights=state.weights[..., None, :, :],
        join=state.join[..., None, :],
        time=state.time[..., None, :],
    )
    options = mapped(lambda leaf: leaf[..., None, :], plan)
    blended, weights = blend(
        options,
        wide,
        chunk,
        begin[..., None, :],
        offset[..., None, :],
        slope[..., None, :],
        first[..., None, :],
        steps,
        rows,
    )
    # Central differences, one-sided at the ends of the chunk.
    path = blended
    if rows == 1:
        path = xp.concatenate((position[..., None, :], blended), -2)
    rise = path[..., 1:, :] - path[..., :-1, :]
    inner = 0.5 * (rise[..., 1:, :] + rise[..., :-1, :])
    rates = xp.concatenate((rise[..., :1, :], inner, rise[..., -1:, :]), -2)[..., -rows:, :]
    # The knots begin with the join; behind the last row they repeat it, at rest.
    following = xp.cumsum(xp.ones_like(state.knots[..., 1:, :]), axis=-2) - 1.0
    index = xp.minimum(first[..., None, :] + following, rows).astype(int)

    def knots(start: Array, values: Array, end: Array) -> Array:
        values = xp.concatenate((values, end[..., None, :]), -2)
        shifted = xp.take_along_axis(values, index, -2)
        return xp.concatenate((start[..., None, :], shifted), -2)

    zero = xp.zeros_like(now)
    return state._replace(
        knots=knots(position, blended, blended[..., -1, :]),
        rates=knots(rate, rates / period[..., None, :], zero),
        weights=knots(zero, weights, zero),
        join=now,
        time=joined,
        end=joined + (rows - 1.0 - first) * period,
    )


def blend(
    plan: Plan,
    state: PlanState,
    chunk: Array,
    begin: Array,
    offset: Array,
    slope: Array,
    first: Array,
    step: Array,
    rows: Array,
) -> tuple[Array, Array]:
    """Return row number ``step`` of a chunk that begins at ``begin`` [s], blended with the plan,
    and its weight.

    ``offset`` is that of the alignment, in row ``first``, and ``slope`` its rate; ``rows`` is the
    number of rows. All have the shape of the times of ``state``, or one that broadcasts with it.
    """
    xp = namespace(*plan, state.knots, chunk, begin, step)
    if plan.fade is not None:
        s = (step - first) * plan.period / plan.fade
        u = xp.minimum(s / EASE, 1.0)
        eased = EASE * u * ((1.0 - u) * (1.0 - u))
        left = xp.maximum(1.0 - s, 0.0) * offset + eased * (offset + plan.fade * slope)
        return chunk + plan.blended * left, xp.zeros_like(chunk)
    if plan.forgotten is None and plan.share is None:
        return chunk, xp.zeros_like(chunk)
    time = begin + step * plan.period
    present, _, _ = curve(plan, state, time)
    near = _row(plan, xp.rint((time - state.time) / plan.period) + 1.0, xp)
    old = plan.blended * take_rows(state.weights, near)
    if plan.share is None:
        new = 1.0 - old * plan.forgotten
    else:
        new = xp.where(old > 0, old * (plan.share / (1.0 - plan.share)), 1.0)
    if plan.taper is not None:
        new = new * xp.minimum((rows - step) * plan.period / plan.taper, 1.0)
    return present + new / (old + new) * (chunk - present), old + new


def sample(
    plan: Plan,
    state: PlanState,
    t: Array,
) -> tuple[PlanState, Array, Array, Array]:
    """Return the state, and setpoint, rate and acceleration (envs, joints) at the time ``t`` [s], a
    number or (envs,), no earlier than at the last sample.
    """
    xp = namespace(*plan, state.knots, t)
    at = xp.zeros_like(state.now) + _column(t)
    return advance(plan, state, at, xp.maximum(at - state.now, LEAST_STEP))


def advance(
    plan: Plan,
    state: PlanState,
    t: Array,
    dt: Array,
) -> tuple[PlanState, Array, Array, Array]:
    """Sample the plan at ``t`` (envs, joints) [s], ``dt`` [s] after the last sample, for loops of
    one time step; else as :func:`sample`.
    """
    setpoint, rate, acceleration = curve(plan, state, t)
    xp = namespace(*plan, state.knots, t)
    starved = state.starved + xp.where(t > state.end, 1.0, 0.0)
    state = state._replace(now=t, starved=starved)
    limits, before = _guard(plan), state.guard
    if limits is None or before is None:
        return state, setpoint, rate, acceleration
    guard, changed = guard_model.advance(limits, before, setpoint, dt)
    rate = xp.where(changed, guard.rate, rate)
    acceleration = xp.where(changed, (guard.rate - before.rate) / dt, acceleration)
    return state._replace(guard=guard), guard.setpoint, rate, acceleration


def curve(
    plan: Plan,
    state: PlanState,
    t: Array,
) -> tuple[Array, Array, Array]:
    """Return position, rate and acceleration of a plan without its limits, at ``t`` (envs, joints)
    [s].
    """
    xp = namespace(*plan, state.knots, t)
    row = _row(plan, xp.floor((t - state.time) / plan.period) + 1.0, xp)
    is_joining = row < 1
    begin = xp.where(is_joining, state.join, state.time + (row - 1.0) * plan.period)
    length = xp.where(is_joining, state.time - state.join, plan.period)
    # A new plan, and an old one, are at rest.
    length = xp.where(length > 0, length, plan.period)
    start = take_rows(state.knots, row)
    zero = xp.zeros_like(start)
    if isinstance(plan.interpolation, Held):
        return start, zero, zero
    frequency = 1.0 / length
    u = xp.minimum(xp.maximum((t - begin) * frequency, 0.0), 1.0)
    rise = take_rows(state.knots, row + 1.0) - start
    if isinstance(plan.interpolation, Linear):
        return start + u * rise, rise * frequency, zero
    # The rates as distances in the time of this segment.
    v = length * take_rows(state.rates, row)
    w = length * take_rows(state.rates, row + 1.0)
    c = 3.0 * rise - (2.0 * v + w)
    bend, twist = 2.0 * c, u * (v + w - 2.0 * rise)
    position = start + u * (v + u * (c + twist))
    rate = (v + u * (bend + 3.0 * twist)) * frequency
    return position, rate, (bend + 6.0 * twist) * (frequency * frequency)


def _row(plan: Plan, row: Array, xp: ArrayModule) -> Array:
    """Return a number of a knot within the knots that have a next one; 0 for NaN."""
    return xp.minimum(xp.where(row > 0, row, 0.0), plan.last)


def _column(time: Array) -> Array:
    """Return a time, a number or (envs,), for all joints."""
    if getattr(time, "ndim", 0):
        return time[..., None]
    return time


def _guard(plan: Plan) -> Guard | None:
    """Return the limits of a plan, or None."""
    if plan.rate is None and plan.acceleration is None:
        return None
    return Guard(rate=plan.rate, acceleration=plan.acceleration)
