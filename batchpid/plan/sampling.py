r"""State of a plan: chunks are added when they come, and the plan is sampled at any time. Pure
functions, for NumPy and JAX.

A chunk has rows c_k for the times T_k = time + k P. Of two and more rows, with the present plan
x(t) and the time t of the last sample, the blended rows are, by :func:`batchpid.make_plan`'s blend::

    newest      b_k = c_k
    align       b_k = c_k + o max(1 - s, 0) + (o + o' fade) u (1 - u)^2 / 5
                s   = (T_k - T_f) / fade,   u = min(5 s, 1)
    ensemble    b_k = x(T_k) + g_k / (W_k + g_k) (c_k - x(T_k)),   g_k = 1 - W_k (1 - exp(-m))

o = x(T_f) - c_f is the offset, which fades, and o' = x'(T_f) - c'_f its rate, from which the rate
of the fading is reached in a fifth of that time. f is the first row that is at least P / 2 ahead of
t; those before it have passed, and are dropped. If all have passed, the last one is taken for t +
P. W_k is the weight of the chunks so far at that time, to which g_k is added: the g are exp(-m i),
i = 0, 1, ...

The knots of the new plan are x(t) at t, where the plan has its rate too, and b_k at T_k from f on,
with the rates (b_{k+1} - b_{k-1}) / (2 P), one-sided at the ends of the chunk. Behind the last row
the plan comes to rest there within P, and stays. So position and rate are continuous, whenever a
chunk comes. Between two knots of distance D, with r, v at the first and q, w at the second one, the
cubic of the time s <= 0 to the second one is::

    x   = q + s (w + s (c + s d)),    c = (3 (r - q) + D (v + 2 w)) / D^2
    x'  = w + s (2 c + 3 s d),        d = (2 (r - q) + D (v + w)) / D^3
    x'' = 2 c + 6 s d

The state has q, w, c, d of the present segment, which change where it ends (:func:`renewed`); a
sample is this polynomial (:func:`advance`).

Limits of the plan are those of :mod:`batchpid.motors.guard` on x. The alignment is after the policy
runner of axol, the ensemble after ACT (T. Z. Zhao et al., Learning Fine-Grained Bimanual
Manipulation with Low-Cost Hardware, RSS 2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.elementwise import in_dtype_of, namespace, take_rows
from batchpid.arrays.trees import mapped
from batchpid.checks import instance
from batchpid.errors import InvalidArgumentError
from batchpid.motors import guard as guard_model
from batchpid.motors.guard import Guard, GuardState
from batchpid.plan.plans import SPARE_ROWS, Plan

EASE = 0.2
"""Share of the fading in which its rate is reached."""
LEAST_STEP = 1e-9
"""Least time between two samples [s]: the limits divide by it."""

Segment = tuple[Array, Array, Array, Array]
"""Polynomial between two knots: position and rate at its end, coefficients of the square and the
cube of the time to it.
"""


class PlanState(NamedTuple):
    """State of a plan. Arrays are (envs, joints), tables (envs, horizon + 2, joints)."""

    knots: Array
    """Positions in the rows of the last chunk, and behind them the last one [rad or m]."""
    rates: Array
    """Rates in these rows, 0 behind them [rad/s or m/s]."""
    weights: Array
    """Weights W of these rows, 0 behind them and where chunks are not averaged."""
    begin: Array
    """Time of the first row [s]."""
    last: Array
    """Time of the last row [s]."""
    segment: Segment
    """Present segment."""
    end: Array
    """Its end [s]."""
    now: Array
    """Time of the last sample [s]."""
    starved: Array
    """Number of samples so far that were later than the last row, or before the first chunk."""
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
    rest = start, zeros, zeros, zeros
    limits = _guard(plan)
    guard = None if limits is None else guard_model.init(limits, start)
    return PlanState(
        knots,
        empty,
        empty,
        at,
        at,
        rest,
        at,
        at,
        zeros,
        guard,
    )


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
    chunk = xp.broadcast_to(chunk, (*state.now.shape[:-1], rows, joints))
    # All rows at once: plan and state have an axis more.
    options, wide = _wide(plan), _wide(state)
    wide = wide._replace(knots=state.knots, rates=state.rates, weights=state.weights)
    period, now = options.period, wide.now
    begin = xp.zeros_like(now) + _column(_column(time))
    # Rows that have passed are dropped; if all have, the last one is still the newest wish.
    ahead = xp.maximum(xp.ceil((now - begin) / period + 0.5), 0.0)
    first = xp.minimum(ahead, rows - 1.0)
    begin = xp.where(ahead > first, now + (1.0 - first) * period, begin)
    joined = begin + first * period
    position, rate, _ = evaluate(wide.segment, now - wide.end)
    offset, slope = gap(options, wide, chunk, joined, first)
    step = xp.arange(rows, dtype=chunk.dtype).reshape(*[1] * (chunk.ndim - 2), rows, 1)
    blended, weights = blend(
        options,
        wide,
        chunk,
        begin,
        offset,
        slope,
        first,
        step,
    )
    # Central differences, one-sided at the ends of the chunk.
    rise = xp.diff(blended if rows > 1 else xp.concatenate((position, blended), -2), axis=-2)
    inner = 0.5 * (rise[..., 1:, :] + rise[..., :-1, :])
    rises = (rise[..., :1, :], inner, rise[..., -1:, :]) if rows > 1 else (rise,)
    behind, rest = [xp.zeros_like(now)] * (count - rows), [blended[..., -1:, :]] * (count - rows)
    rates = xp.concatenate((*rises, *behind), -2) / period
    high, slope = take_rows(blended, first), take_rows(rates, first)
    segment = cubic(
        options,
        joined - now,
        position,
        high,
        rate,
        slope,
    )
    return state._replace(
        knots=xp.concatenate((blended, *rest), -2),
        rates=rates,
        weights=xp.concatenate((weights, *behind), -2),
        begin=begin[..., 0, :],
        last=(begin + (rows - 1.0) * period)[..., 0, :],
        segment=mapped(lambda leaf: leaf[..., 0, :], segment),
        end=joined[..., 0, :],
    )


def gap(
    plan: Plan,
    state: PlanState,
    chunk: Array,
    time: Array,
    first: Array,
) -> tuple[Array, Array]:
    """Return how far the plan is from the row ``first`` of a chunk (envs, rows, joints) at ``time``
    [s], and at which rate it goes away from it; 0 for a chunk of one row, which tells no motion.
    """
    xp = namespace(*plan, chunk)
    rows = chunk.shape[-2]
    if rows == 1 or plan.fade is None:
        return 0.0, 0.0
    present, slope = curve(plan, state, time)
    low, high = xp.maximum(first - 1.0, 0.0), xp.minimum(first + 1.0, rows - 1.0)
    rise = take_rows(chunk, high) - take_rows(chunk, low)
    offset = present - take_rows(chunk, first)
    return offset, slope - rise / ((high - low) * plan.period)


def blend(
    plan: Plan,
    state: PlanState,
    chunk: Array,
    begin: Array,
    offset: Array,
    slope: Array,
    first: Array,
    step: Array,
) -> tuple[Array, Array]:
    """Return row number ``step`` of a chunk that begins at ``begin`` [s], blended with the plan,
    and its weight, 0 where chunks are not averaged.

    ``offset`` is that of the alignment, in row ``first``, and ``slope`` its rate. Arrays have the
    shape of the times of ``state``, or one that broadcasts with it.
    """
    xp = namespace(*plan, state.knots, chunk, begin, step)
    if plan.fade is not None:
        s = (step - first) * (plan.period / plan.fade)
        u = xp.minimum(s / EASE, 1.0)
        rest = 1.0 - u
        eased = u * (rest * rest) * (EASE * (offset + plan.fade * slope))
        faded = plan.blended * (xp.maximum(1.0 - s, 0.0) * offset + eased)
        return chunk + faded, 0.0 * chunk
    if plan.forgotten is None:
        return chunk, 0.0 * chunk
    time = begin + step * plan.period
    present, _ = curve(plan, state, time)
    near = xp.rint((time - state.begin) / plan.period)
    old = xp.where(near >= 0, take_rows(state.weights, _row(plan, near)), 0.0) * plan.blended
    new = 1.0 - old * plan.forgotten
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
    return advance(plan, renewed(plan, state, at), at, xp.maximum(at - state.now, LEAST_STEP))


def renewed(plan: Plan, state: PlanState, t: Array) -> PlanState:
    """Return the state with the segment at ``t`` (envs, joints) [s], where the present one has
    ended.
    """
    xp = namespace(*plan, state.knots, t)
    due = t >= state.end
    # Most samples are within a segment, which NumPy can see.
    if xp is np and not due.any():
        return state
    end, segment = segment_at(plan, state, t)
    present = state.segment
    chosen = tuple([xp.where(due, new, old) for new, old in zip(segment, present, strict=True)])
    return state._replace(segment=chosen, end=xp.where(due, end, state.end))


def advance(
    plan: Plan,
    state: PlanState,
    t: Array,
    dt: Array,
) -> tuple[PlanState, Array, Array, Array]:
    """Sample the plan at ``t`` (envs, joints) [s] in its present segment, ``dt`` [s] after the last
    sample, for loops of one time step; else as :func:`sample`.
    """
    setpoint, rate, acceleration = evaluate(state.segment, t - state.end)
    xp = namespace(*plan, state.knots, t)
    starved = state.starved + xp.where(t > state.last, 1.0, 0.0)
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
) -> tuple[Array, Array]:
    """Return position and rate of a plan without its limits at ``t`` (envs, joints) [s], not before
    the last sample.
    """
    xp = namespace(*plan, state.knots, t)
    end, later = segment_at(plan, state, t)
    within = t < state.end
    end = xp.where(within, state.end, end)
    parts = zip(state.segment, later, strict=True)
    segment = [xp.where(within, present, then) for present, then in parts]
    return evaluate(segment, t - end)[:2]


def evaluate(segment: Sequence[Array], s: Array) -> tuple[Array, Array, Array]:
    """Return position, rate and acceleration of a segment at the time ``s`` after its end [s]."""
    q, w, c, d = segment
    twist = s * d
    bend = c + twist
    position = q + s * (w + s * bend)
    twice = bend + twist
    return position, w + s * (bend + twice), 2.0 * (twice + twist)


def cubic(
    plan: Plan,
    length: Array,
    low: Array,
    high: Array,
    slope_low: Array,
    slope_high: Array,
) -> Segment:
    """Return the segment of ``length`` [s] between two knots, of these positions and rates."""
    xp = namespace(*plan, length, low, high)
    # A line has the rate of its rise, and a held knot has none.
    high = xp.where(plan.degree > 0, high, low)
    frequency, rise = 1.0 / length, high - low
    v = xp.where(plan.degree > 1, length * slope_low, rise)
    w = xp.where(plan.degree > 1, length * slope_high, rise)
    c = (v + 2.0 * w) - 3.0 * rise
    d = (v + w) - 2.0 * rise
    square = frequency * frequency
    return high, w * frequency, c * square, d * (square * frequency)


def segment_at(plan: Plan, state: PlanState, t: Array) -> tuple[Array, Segment]:
    """Return end and polynomial of the segment of the last chunk at ``t`` [s]."""
    xp = namespace(*plan, state.knots, t)
    number = xp.floor((t - state.begin) / plan.period)
    low, high = _row(plan, number), _row(plan, number + 1.0)
    # A chunk that begins later than its first row is needed has a segment before that.
    end = state.begin + (xp.maximum(number, 0.0) + 1.0) * plan.period
    positions = take_rows(state.knots, low), take_rows(state.knots, high)
    slopes = take_rows(state.rates, low), take_rows(state.rates, high)
    return end, cubic(plan, plan.period, *positions, *slopes)


def _row(plan: Plan, row: Array) -> Array:
    """Return a number of a knot within the knots of a plan; 0 for NaN."""
    xp = namespace(*plan, row)
    return xp.minimum(xp.where(row > 0, row, 0.0), plan.rows)


def _wide(tree: Pytree) -> Any:
    """Return a tree of arrays (..., joints) as (..., 1, joints), one row."""
    return mapped(lambda leaf: leaf[..., None, :], tree)


def _column(time: Array) -> Array:
    """Return a time, a number or (envs, ...), with a further axis."""
    if getattr(time, "ndim", 0):
        return time[..., None]
    return time


def _guard(plan: Plan) -> Guard | None:
    """Return the limits of a plan, or None."""
    if plan.rate is None and plan.acceleration is None:
        return None
    return Guard(rate=plan.rate, acceleration=plan.acceleration)
