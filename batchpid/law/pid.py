r"""The control law: pure functions on (envs, joints) arrays, one definition for NumPy and JAX.

With setpoint r, measurement y and step dt, per env and joint::

    e      = dead(wrap(r - y))                                  error
    P      = kp (b e - (1 - b) (y - o))                         o: the first y; off: b = 1
    o     <- o + dt dr/dt                                       where a rate of the setpoint is given
    v      = c dr/dt - dy/dt                                    measured rates, else wrapped differences / dt
    d      = (tau d' + dt v) / (tau + dt)                       low-pass, backward Euler: stable for any dt
    D      = kd d
    u      = P + I + D + feedforward                            unsaturated effort
    effort = min(max(u, effort_min), effort_max)                after |effort - effort'| <= rate limit * dt
    I     <- I + ki e dt + (dt / Tt) (effort - u)               back-calculation
    I     <- I + ki e dt   unless (u - effort) e > 0            conditional integration
    I     <- min(max(I, integral_min), integral_max)            clamp

A prime is the value of the step before. I is in effort units, so a change of ki is bumpless. The
effort is computed before I includes the present error. Saturation is on the total effort, which the
motor delivers. After K. J. Astrom and T. Hagglund, Advanced PID Control (ISA, 2006), chapters 3 and
13; conditional integration and the order of the two stages as in ros-controls/control_toolbox,
src/pid.cpp. With discretization "implicit" the law is this one with other coefficients:
:mod:`batchpid.law.coefficients`.

The moving origin is our own addition. With r = o + s, P = kp (o + b s - y): o, the motion that a
rate describes, is followed with full weight, and the rest s, a step, is approached with weight b.
Without a rate all motion counts as steps, and a moving setpoint is followed with a lag of kp (1 -
b) / ki.
"""

from __future__ import annotations

from batchpid.arrays.array_types import Array, ArrayModule, Conditional
from batchpid.arrays.elementwise import (
    clip,
    flush,
    in_dtype_of,
    namespace,
    nearest_turn,
    replace_envs,
    wrap,
)
from batchpid.law.coefficients import Coefficients, discretise
from batchpid.law.params import PIDParams
from batchpid.law.state import (
    PIDState,
    Terms,
    check_alone,
    check_state,
    checked_inputs,
    checked_mask,
    needs,
)


def init(params: PIDParams, measurement: Array) -> PIDState:
    """Return the state before the first step.

    Derivative and setpoint weighting start from ``measurement`` (envs, joints) [rad or m]: the
    first step has no kick. All functions of the law take arrays of one robot (joints,), too, and
    return such arrays, so that a function of one robot works under ``jax.vmap``.

    Raises InvalidArgumentError if the measurement has another number of joints than the params.
    """
    # A state holds what the options need, and nothing else.
    (measurement,) = checked_inputs(params, PIDState(), measurement)
    params = params.for_rank(measurement.ndim)
    xp = namespace(*params, measurement)
    y = xp.zeros_like(measurement) + measurement
    # No two leaves share a buffer: JAX donates each of them.
    leaves = {
        name: y.copy() if name in ("measurement", "setpoint", "origin") else xp.zeros_like(y)
        for name, needed in needs(params)._asdict().items()
        if needed
    }
    state = PIDState(**leaves)
    if params.ki is None:
        return state
    return state._replace(
        integral=clip(state.integral, params.integral_min, params.integral_max, xp)
    )


def step(
    params: PIDParams,
    state: PIDState,
    setpoint: Array,
    measurement: Array,
    dt: Array,
    *,
    measurement_rate: Array = None,
    setpoint_rate: Array = None,
    feedforward: Array = None,
) -> tuple[PIDState, Array]:
    """Advance the law by ``dt`` seconds; return the state and the effort.

    Arrays are (envs, joints), (1, joints) for all envs, or (joints,) for one robot, and taken in
    the params' dtype, which state and effort have; none is written to.

    Parameters
    ----------
    setpoint, measurement
        r and y [rad or m].
    dt
        Time step > 0 [s].
    measurement_rate
        dy/dt, if measured [rad/s or m/s]; None: the difference quotient of the measurement.
    setpoint_rate
        dr/dt at the time of the setpoint, if known. It moves the origin o, and enters the
        derivative with weight c, or 1 if c is off. None: the difference quotient of the setpoint,
        or 0 if c is off.
    feedforward
        Effort added before saturation [N m or N]: passive force, acceleration feedforward, ...

    Raises
    ------
    InvalidArgumentError
        If dt is not positive, or above 1 s, a shape does not fit, the state lacks an array that the
        params need, or the params have gain_units other than "effort" or ask for a measured rate
        that is not given.
    """
    rest = measurement_rate, setpoint_rate, feedforward
    state, terms = _step(params, state, setpoint, measurement, dt, *rest)
    return state, terms.effort


def _step(
    params: PIDParams,
    state: PIDState,
    setpoint: Array,
    measurement: Array,
    dt: Array,
    measurement_rate: Array = None,
    setpoint_rate: Array = None,
    feedforward: Array = None,
) -> tuple[PIDState, Terms]:
    """Check the arguments of a step and advance the law."""
    y, r, *optional = checked_inputs(
        params,
        state,
        measurement,
        setpoint=setpoint,
        measurement_rate=measurement_rate,
        setpoint_rate=setpoint_rate,
        feedforward=feedforward,
    )
    check_state(state, params)
    return advance(discretise(params.for_rank(y.ndim), dt), state, r, y, *optional)


def advance(
    k: Coefficients,
    state: PIDState,
    setpoint: Array,
    measurement: Array,
    measurement_rate: Array = None,
    setpoint_rate: Array = None,
    feedforward: Array = None,
) -> tuple[PIDState, Terms]:
    """Advance the law with given coefficients, for loops with constant params; return the state and
    the terms.

    It takes the arguments of :func:`step`, as arrays. A term may be an array of the caller.

    Raises InvalidArgumentError if the coefficients are of gain_units other than "effort", or need a
    measured rate that is not given. Gains per mass matrix: :mod:`batchpid.law.computed_torque`.
    """
    check_alone(k, measurement_rate)
    xp = namespace(
        *k,
        *state,
        setpoint,
        measurement,
        measurement_rate,
        setpoint_rate,
        feedforward,
    )
    r, y, r_rate, y_rate, ff = in_dtype_of(
        k,
        setpoint,
        measurement,
        setpoint_rate,
        measurement_rate,
        feedforward,
    )
    # The terms, in the order of the equations above.
    error = wrapped_error(k, r, y, xp)
    origin, moved_origin = origins(k, state, y, r_rate, xp)
    p = proportional(k, error, y, origin)
    u = p

    # The effort takes I before it includes the present error: a change of ki is bumpless.
    i: Array | float = 0.0
    integral = state.integral
    if k.ki_dt is not None:
        integral = integral + k.ki_dt * error
        if k.ki_dt2 is not None and r_rate is not None:
            integral = integral - k.ki_dt2 * r_rate
        i = state.integral
        u = u + i

    # The filter acts on the weighted rate, so that one state serves measurement and setpoint.
    d: Array | float = 0.0
    derivative = None
    if k.kd is not None:
        if y_rate is not None:
            rate = -y_rate
        else:
            rate = wrap(state.measurement - y, k.turns, xp) * k.per_dt
        if r_rate is not None:
            rate = rate + weighted_rate(k, r_rate)
        elif k.c is not None:
            rate = (
                rate + k.c * state.setpoint_seen * wrap(r - state.setpoint, k.turns, xp) * k.per_dt
            )
        if k.decay is None:
            derivative = rate
        else:
            derivative = flush(k.decay * state.derivative + k.intake * rate, k.tiny)
        d = k.kd * derivative
        u = u + d
    if ff is not None:
        u = u + ff

    # The rate limit comes first: the limits of the effort hold in any case.
    effort = u
    if k.effort_step is not None:
        effort = clip(u, state.effort - k.effort_step, state.effort + k.effort_step, xp)
    effort = clip(effort, k.effort_min, k.effort_max, xp)

    # Anti-windup sees the saturated effort; without limits it costs nothing.
    if k.ki_dt is not None:
        if effort is not u and isinstance(k.anti_windup, Conditional):
            deeper = (u - effort) * error > 0
            integral = xp.where(deeper, state.integral, integral)
        if effort is not u and k.tracking is not None:
            integral = flush(integral + k.tracking * (effort - u), k.tiny)
        integral = clip(integral, k.integral_min, k.integral_max, xp)

    new = PIDState(
        integral=integral,
        # The caller may reuse its buffer.
        measurement=None if state.measurement is None else y.copy(),
        derivative=None if state.derivative is None else derivative,
        setpoint=None if state.setpoint is None else r + xp.zeros_like(y),
        setpoint_seen=None if state.setpoint_seen is None else xp.ones_like(y),
        effort=None if state.effort is None else effort.copy(),
        origin=moved_origin,
    )
    return new, Terms(
        p,
        i,
        d,
        0.0 if ff is None else ff,
        u,
        effort,
    )


def reset(
    params: PIDParams,
    state: PIDState,
    measurement: Array,
    mask: Array,
) -> PIDState:
    """Return the state with the envs of ``mask`` (envs,) bool restarted from ``measurement`` (envs,
    joints).

    Raises InvalidArgumentError if a shape does not fit, or the mask is not of bools.
    """
    (measurement,) = checked_inputs(params, state, measurement)
    mask = checked_mask(mask, state)
    # Every env is started; the rows of the mask are taken.
    return replace_envs(state, init(params, measurement), mask)


def wrapped_error(
    k: Coefficients,
    r: Array,
    y: Array,
    xp: ArrayModule,
) -> Array:
    """Return the wrapped error, less the dead zone."""
    error = wrap(r - y, k.turns, xp)
    if k.deadband is None:
        return error
    return error - clip(error, -k.deadband, k.deadband, xp)


def weighted_rate(k: Coefficients, r_rate: Array) -> Array:
    """Return a given setpoint rate times its weight."""
    weight = k.c if k.c_given is None else k.c_given
    if weight is None:
        return r_rate
    return weight * r_rate


def origins(
    k: Coefficients,
    state: PIDState,
    y: Array,
    r_rate: Array,
    xp: ArrayModule,
) -> tuple[Array, Array]:
    """Return the origins of setpoint weighting for this step and the next, moved by the whole turns
    that y jumped.

    A given rate moves it. The implicit law takes the setpoint, and so its origin, at the end of the
    step.
    """
    origin = state.origin
    if origin is not None and k.turns is not None:
        moved = y - state.measurement
        origin = origin + (moved - wrap(moved, k.turns, xp))
    if origin is None or r_rate is None:
        return origin, origin
    moved = origin + k.origin_dt * r_rate
    return (origin if k.acceleration_share is None else moved), moved


def proportional(
    k: Coefficients,
    error: Array,
    y: Array,
    origin: Array,
) -> Array:
    """Return kp (b e - (1 - b) (y - o)), which has no spike where y wraps."""
    return k.kp * (error if k.b is None else k.b * error - (1 - k.b) * (y - origin))


def advance_drive(
    k: Coefficients,
    state: PIDState,
    setpoint: Array,
    measurement: Array,
    **inputs: Array,
) -> tuple[PIDState, Array]:
    """Return ``(state, target)``: the position target that makes a PD drive of stiffness kp act as
    a PID::

        target = setpoint + I / kp          so that kp (target - y) - kd dy/dt = P + I + D

    The drive (SAPIEN's ``set_drive_property(stiffness=kp, damping=kd)``) integrates P and D
    implicitly and is as stable as without I. I evolves as in :func:`batchpid.step`, whose effort
    predicts the drive's effort: ``effort_min`` and ``effort_max`` are the drive's force limit, and
    anti-windup works against it. Where kp is 0 the target is the setpoint. The arguments are those
    of :func:`advance`, with params that pass :func:`batchpid.law.state.check_drive`. The idea is
    from the SAPIEN authors' answer in haosulab/SAPIEN#178.
    """
    state, terms = advance(k, state, setpoint, measurement, **inputs)
    xp = namespace(*k, terms.i, setpoint)
    # I / kp moves the target; a joint without kp has nothing to move it by.
    driven = k.kp > 0
    target = nearest_turn(setpoint, measurement, k.turns, xp)
    return state, target + xp.where(driven, terms.i, 0) / xp.where(driven, k.kp, 1)
