r"""THE control law: pure functions on (envs, joints) arrays, one definition for NumPy and JAX.

With setpoint r, measurement y and step dt, per env and joint::

    e      = dead(wrap(r - y))                                  error
    P      = kp (b e - (1 - b) (y - o))                         = kp (b r - y), off: b = 1
    v      = c dr/dt - dy/dt                                    measured rates, else wrapped differences / dt
    d      = (tau d' + dt v) / (tau + dt)                       low-pass, backward Euler: stable for any dt
    D      = kd d
    u      = P + I + D + feedforward                            unsaturated effort
    effort = min(max(u, effort_min), effort_max)                after |effort - effort'| <= rate limit * dt
    I     <- I + ki e dt + (dt / Tt) (effort - u)               back-calculation
    I     <- I + ki e dt   unless (u - effort) e > 0            conditional integration
    I     <- min(max(I, integral_min), integral_max)            clamp

A prime is the value of the step before. I is in effort units, so a change of ki is bumpless. The effort is computed
before I takes in the present error, or after, by ``integration``. Saturation is on the total effort, because that is
what the motor delivers. After K. J. Astrom and T. Hagglund, Advanced PID Control (ISA, 2006), chapters 3 and 13;
conditional integration and the order of the two stages as in ros-controls/control_toolbox, src/pid.cpp.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from batchpid.errors import InvalidArgumentError
from batchpid.params import Everywhere, HoldEffort, PIDParams

TURN = 2 * math.pi


class PIDState(NamedTuple):
    """What the law remembers, each (envs, joints); None where no option needs it."""

    integral: Any = None
    """I, in effort units."""
    measurement: Any = None
    """y of the last step [rad or m]."""
    derivative: Any = None
    """d, the filtered rate of c r - y [rad/s or m/s]."""
    setpoint: Any = None
    """r of the last step [rad or m]."""
    setpoint_seen: Any = None
    """1.0 once ``setpoint`` holds a value to take a difference from, else 0.0."""
    effort: Any = None
    """Effort of the last step [N m or N]."""
    origin: Any = None
    """o: where setpoint weighting measures positions from [rad or m]."""

    def for_envs(self, envs: slice | Any) -> PIDState:
        """Return the state of some envs (a slice or an index array)."""
        return PIDState(*(None if leaf is None else leaf[envs] for leaf in self))


class Terms(NamedTuple):
    """What the law did in one step, each (envs, joints); 0 for a term that is off."""

    p: Any
    """Proportional term [N m or N]."""
    i: Any
    """Integral term as it entered the effort."""
    d: Any
    """Derivative term."""
    feedforward: Any
    """Feedforward as given."""
    unsaturated: Any
    """Their sum: the computed effort."""
    effort: Any
    """The applied effort, after saturation."""
    saturated: Any
    """Bool: a limit (of the effort or its rate) changed the effort."""
    finite: Any
    """Bool: every input of this env and joint was finite."""


class Coefficients(NamedTuple):
    """:class:`PIDParams` at one dt: all that a step needs and that does not change from step to step."""

    kp: Any
    ki: Any
    ki_dt: Any
    kd: Any
    per_dt: Any
    decay: Any
    intake: Any
    effort_min: Any
    effort_max: Any
    effort_step: Any
    integral_min: Any
    integral_max: Any
    b: Any
    c: Any
    deadband: Any
    tracking: Any
    conditional: Any
    turns: Any
    integration: Any
    weight_origin: Any
    non_finite: Any


def init(params: PIDParams, measurement: Any) -> PIDState:
    """Return the state before the first step.

    The derivative starts from ``measurement`` (envs, joints) [rad or m]: the first step has no derivative kick,
    unless the params ask for one.
    """
    xp = namespace(params, measurement)
    dtype = xp.result_type(params.kp, measurement)
    y = xp.zeros_like(measurement, dtype=dtype) + measurement
    differentiates = params.kd is not None
    weights_rate = differentiates and params.setpoint_weight_derivative is not None
    weights = params.setpoint_weight is not None
    remembers = params.effort_rate_limit is not None or isinstance(params.non_finite, HoldEffort)

    def filled(value: float, wanted: bool) -> Any:  # no two leaves share a buffer: JAX donates each of them
        return xp.full_like(y, value) if wanted else None

    integral = None
    if params.ki is not None:
        integral = _clip(filled(0.0, True), params.integral_min, params.integral_max, xp)
    return PIDState(
        integral=integral,
        measurement=y.copy() if differentiates or (weights and params.continuous is not None) else None,
        derivative=filled(0.0, differentiates and params.derivative_filter_time is not None),
        setpoint=y.copy() if weights_rate else None,
        setpoint_seen=filled(float(params.first_derivative is not None), weights_rate),
        effort=filled(0.0, remembers),
        origin=y.copy() if weights and params.weight_origin is not None else filled(0.0, weights),
    )


def step(
    params: PIDParams,
    state: PIDState,
    setpoint: Any,
    measurement: Any,
    dt: Any,
    *,
    measurement_rate: Any = None,
    setpoint_rate: Any = None,
    feedforward: Any = None,
    aux: bool = False,
) -> Any:
    """Advance the law by ``dt`` seconds; return ``(state, effort)``, with ``aux`` also :class:`Terms`.

    Arrays are (envs, joints), or (1, joints) for all envs alike, in the params' dtype; none is written to.

    Parameters
    ----------
    setpoint, measurement
        r and y [rad or m].
    dt
        Time step > 0 [s].
    measurement_rate
        dy/dt where it is measured [rad/s or m/s]; None: the difference quotient of the measurement.
    setpoint_rate
        dr/dt where it is known; it enters with weight c, or 1 where no weight is set. None: the difference quotient
        of the setpoint where a weight c is set, else 0.
    feedforward
        Effort added before saturation [N m or N]: passive force, acceleration feedforward, ...

    Raises
    ------
    InvalidArgumentError
        If dt is a Python number that is not positive and finite.
    """
    return advance(
        discretise(params, dt), state, setpoint, measurement, measurement_rate, setpoint_rate, feedforward, aux
    )


def discretise(params: PIDParams, dt: Any) -> Coefficients:
    """Return the law's coefficients at ``dt``: what a loop of constant params and dt computes once."""
    if isinstance(dt, int | float) and not 0 < dt < math.inf:
        raise InvalidArgumentError("dt", "is not positive and finite", value=dt, remedy="give seconds > 0")
    xp = namespace(params)
    tau, tracking = params.derivative_filter_time, params.tracking_time
    return Coefficients(
        kp=params.kp,
        ki=params.ki,
        ki_dt=None if params.ki is None else params.ki * dt,
        kd=params.kd,
        per_dt=1 / dt,
        decay=None if tau is None else tau / (tau + dt),
        intake=None if tau is None else dt / (tau + dt),
        effort_min=params.effort_min,
        effort_max=params.effort_max,
        effort_step=None if params.effort_rate_limit is None else params.effort_rate_limit * dt,
        integral_min=params.integral_min,
        integral_max=params.integral_max,
        b=params.setpoint_weight,
        c=params.setpoint_weight_derivative,
        deadband=params.deadband,
        # A tracking time below dt would overshoot: at most the whole excess is taken back in one step.
        tracking=None if tracking is None else dt / xp.maximum(tracking, dt),
        conditional=params.conditional,
        turns=None if params.continuous is None else params.continuous / TURN,
        integration=params.integration,
        weight_origin=params.weight_origin,
        non_finite=params.non_finite,
    )


def advance(
    k: Coefficients,
    state: PIDState,
    setpoint: Any,
    measurement: Any,
    measurement_rate: Any = None,
    setpoint_rate: Any = None,
    feedforward: Any = None,
    aux: bool = False,
) -> Any:
    """Do one step with coefficients at hand; otherwise as :func:`step`."""
    xp = namespace(k, state, setpoint, measurement)
    r, y, r_rate, y_rate, ff = setpoint, measurement, setpoint_rate, measurement_rate, feedforward
    finite = None
    if k.non_finite is not None:
        total = r + y
        for optional in (r_rate, y_rate, ff):
            total = total if optional is None else total + optional
        finite = xp.isfinite(total)
        r, y, r_rate, y_rate, ff = (None if x is None else xp.where(finite, x, 0) for x in (r, y, r_rate, y_rate, ff))

    error = _error(k, r, y, xp)
    moved, origin = _moved(k, state, y, xp)
    p = _proportional(k, error, y, origin)
    u = p

    integral = state.integral
    if k.ki_dt is not None:
        integral = integral + k.ki_dt * error
        if k.integration is not None:
            integral = _clip(integral, k.integral_min, k.integral_max, xp)
        i = state.integral if k.integration is None else integral
        u = u + i

    derivative = None
    if k.kd is not None:
        rate = moved * -k.per_dt if y_rate is None else -y_rate
        if r_rate is not None:
            rate = rate + (r_rate if k.c is None else k.c * r_rate)
        elif k.c is not None:
            rate = rate + k.c * state.setpoint_seen * _wrap(k, r - state.setpoint, xp) * k.per_dt
        derivative = rate if k.decay is None else _flush(k.decay * state.derivative + k.intake * rate, xp)
        d = k.kd * derivative
        u = u + d
    if ff is not None:
        u = u + ff

    effort = u
    if k.effort_step is not None:
        effort = _clip(u, state.effort - k.effort_step, state.effort + k.effort_step, xp)
    effort = _clip(effort, k.effort_min, k.effort_max, xp)

    if k.ki_dt is not None:
        if effort is not u and k.conditional is not None:
            deeper = (u - effort) * error > 0
            if not isinstance(k.conditional, Everywhere):
                deeper = deeper & (k.conditional > 0)
            integral = xp.where(deeper, state.integral, integral)
        if effort is not u and k.tracking is not None:
            integral = _flush(integral + k.tracking * (effort - u), xp)
        integral = _clip(integral, k.integral_min, k.integral_max, xp)

    new = PIDState(
        integral=integral,
        measurement=None if state.measurement is None else y.copy(),  # the caller may reuse its buffer
        derivative=None if state.derivative is None else derivative,
        setpoint=None if state.setpoint is None else r + xp.zeros_like(y),
        setpoint_seen=None if state.setpoint_seen is None else xp.ones_like(y),
        effort=None if state.effort is None else effort.copy(),
        origin=origin,
    )
    if finite is not None:
        new = PIDState(*(None if n is None else xp.where(finite, n, o) for n, o in zip(new, state, strict=True)))
        effort = xp.where(finite, effort, state.effort if isinstance(k.non_finite, HoldEffort) else 0)
    if not aux:
        return new, effort

    zero = xp.zeros_like(u)
    i = zero if k.ki_dt is None else i
    d = zero if k.kd is None else d
    shown = [zero + term for term in (p, i, d, zero if ff is None else ff, u)]
    if finite is None:
        return new, effort, Terms(*shown, effort, effort != u, xp.isfinite(u))
    shown = [xp.where(finite, term, 0) for term in shown]
    return new, effort, Terms(*shown, effort, finite & (effort != u), finite)


def reset(params: PIDParams, state: PIDState, measurement: Any, mask: Any, *, keep_integral: bool = False) -> PIDState:
    """Start the envs of ``mask`` (envs,) bool anew from ``measurement`` (envs, joints); the others are untouched.

    ``keep_integral`` keeps their integral term, e.g. a learnt load.
    """
    xp = namespace(state, params, measurement, mask)
    fresh = init(params, measurement)
    if keep_integral:
        fresh = fresh._replace(integral=state.integral)
    chosen = xp.asarray(mask)[:, None]
    return PIDState(*(None if o is None else xp.where(chosen, n, o) for n, o in zip(fresh, state, strict=True)))


def track(
    params: PIDParams,
    state: PIDState,
    setpoint: Any,
    measurement: Any,
    effort: Any,
    *,
    dt: Any = None,
    measurement_rate: Any = None,
    setpoint_rate: Any = None,
    feedforward: Any = None,
) -> PIDState:
    """Set the integral so that the next step, on these same inputs, gives ``effort``: bumpless transfer.

    Call it at every step under manual control, or once before a change of kp or kd (with the new params and the last
    effort). The derivative is taken as settled. An effort beyond the limits, or an integral beyond its own, cannot be
    reproduced: the limits hold. ``dt`` is needed where the params integrate first.

    Raises
    ------
    InvalidArgumentError
        If the params have no integral (ki is None), or integrate first and dt is missing.
    """
    if params.ki is None:
        raise InvalidArgumentError("ki", "is off, so nothing can carry the effort over", remedy="give ki, 0 allowed")
    if params.integration is not None and dt is None:
        raise InvalidArgumentError("dt", "is needed where the params integrate first", remedy="give dt in seconds")
    xp = namespace(params, state, setpoint, measurement, effort)
    k = discretise(params, 1.0 if dt is None else dt)
    zero = xp.zeros_like(measurement)
    error = _error(k, setpoint, measurement, xp)
    _, origin = _moved(k, state, measurement, xp)
    rate = zero if measurement_rate is None else -measurement_rate
    if setpoint_rate is not None:
        rate = rate + (setpoint_rate if k.c is None else k.c * setpoint_rate)
    integral = effort - _proportional(k, error, measurement, origin)
    integral = integral if k.kd is None else integral - k.kd * rate
    integral = integral if feedforward is None else integral - feedforward
    integral = integral if params.integration is None else integral - k.ki_dt * error
    return PIDState(
        integral=_clip(integral, k.integral_min, k.integral_max, xp),
        measurement=None if state.measurement is None else measurement.copy(),
        derivative=None if state.derivative is None else rate,
        setpoint=None if state.setpoint is None else zero + setpoint,
        setpoint_seen=None if state.setpoint_seen is None else xp.ones_like(measurement),
        effort=None if state.effort is None else zero + effort,
        origin=origin,
    )


def namespace(*trees: Any) -> Any:
    """Return the array namespace that all arrays in these (tuples of) arrays can be used with."""
    for tree in trees:
        for leaf in tree if isinstance(tree, tuple) else (tree,):
            if type(leaf) is not np.ndarray and hasattr(leaf, "__array_namespace__"):
                return leaf.__array_namespace__()
    return np


def _error(k: Coefficients, r: Any, y: Any, xp: Any) -> Any:
    """Return the wrapped error, less the dead zone."""
    error = _wrap(k, r - y, xp)
    return error if k.deadband is None else error - _clip(error, -k.deadband, k.deadband, xp)


def _moved(k: Coefficients, state: PIDState, y: Any, xp: Any) -> tuple[Any, Any]:
    """Return how far y has moved, the short way round, and the weighting's origin, turned along with y."""
    if state.measurement is None:
        return None, state.origin
    raw = y - state.measurement
    moved = _wrap(k, raw, xp)
    turned = state.origin is not None and k.turns is not None
    return moved, state.origin + (raw - moved) if turned else state.origin


def _proportional(k: Coefficients, error: Any, y: Any, origin: Any) -> Any:
    """Return kp (b e - (1 - b) (y - o)): no spike in it where y wraps."""
    return k.kp * (error if k.b is None else k.b * error - (1 - k.b) * (y - origin))


def _wrap(k: Coefficients, angle: Any, xp: Any) -> Any:
    """Return an angle, or a difference of two, less whole turns, on continuous joints."""
    return angle if k.turns is None else angle - TURN * xp.rint(angle * k.turns)


def _clip(x: Any, low: Any, high: Any, xp: Any) -> Any:
    """Return x within [low, high]; NaN stays NaN."""
    x = x if low is None else xp.maximum(x, low)
    return x if high is None else xp.minimum(x, high)


def _flush(x: Any, xp: Any) -> Any:
    """Return x with magnitudes near the denormal range rounded to 0: arithmetic on denormals is ten times slower."""
    tiny = float(xp.finfo(x.dtype).tiny) ** 0.5
    return (x + tiny) - tiny
