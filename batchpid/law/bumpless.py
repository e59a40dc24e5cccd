"""Bumpless transfer: from manual to automatic control, or from gains to other gains, without a jump
of the effort.
"""

from __future__ import annotations

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace
from batchpid.errors import InvalidArgumentError
from batchpid.law.coefficients import discretise
from batchpid.law.params import PIDParams
from batchpid.law.pid import origins, proportional, weighted_rate, wrapped_error
from batchpid.law.state import PIDState, check_alone, check_state, checked_inputs


def track(
    params: PIDParams,
    state: PIDState,
    setpoint: Array,
    measurement: Array,
    effort: Array,
    dt: Array = None,
    *,
    measurement_rate: Array = None,
    setpoint_rate: Array = None,
    feedforward: Array = None,
) -> PIDState:
    """Return the state whose next step, on these same inputs, gives ``effort``: its integral makes
    up the difference.

    Call it at every step under manual control, or once before a change of kp or kd (with the new
    params and the last effort). The derivative is taken as settled. An effort beyond the limits, or
    an integral beyond its own, cannot be reproduced: the limits hold. ``dt`` is needed where the
    params are implicit.

    Raises
    ------
    InvalidArgumentError
        If the params have no integral (ki is None), dt is missing where it is needed, a shape does
        not fit, or the state lacks an array that the params need.
    """
    measurement, setpoint, effort, measurement_rate, setpoint_rate, feedforward = checked_inputs(
        params,
        state,
        measurement,
        setpoint=setpoint,
        effort=effort,
        measurement_rate=measurement_rate,
        setpoint_rate=setpoint_rate,
        feedforward=feedforward,
    )
    check_state(state, params)
    check_alone(params, measurement_rate)
    if params.ki is None:
        raise InvalidArgumentError(
            "params.ki",
            "is off: no integral can take over the effort",
            remedy="give ki; 0 is allowed",
        )
    if dt is None and params.discretization is not None:
        problem = "is needed where the params have discretization 'implicit'"
        raise InvalidArgumentError("dt", problem, remedy="give dt in seconds")
    params = params.for_rank(measurement.ndim)
    xp = namespace(*params, *state, setpoint, measurement, effort)
    k = discretise(params, 1.0 if dt is None else dt)
    # The terms of the next step, on the same inputs, with the derivative settled.
    zero = xp.zeros_like(measurement)
    error = wrapped_error(k, setpoint, measurement, xp)
    (origin, _), (lasting, _) = (
        origins(k, state, measurement, rate, xp) for rate in (setpoint_rate, None)
    )
    if measurement_rate is None:
        rate = zero
    else:
        rate = zero - measurement_rate
    if setpoint_rate is not None:
        rate = rate + weighted_rate(k, setpoint_rate)
    # The law solved for its integral: I = u - P - D - feedforward, with the derivative filter
    # settled on its input.
    integral = effort - proportional(k, error, measurement, origin)
    if k.kd is not None:
        integral = integral - k.kd * rate
    if feedforward is not None:
        integral = integral - feedforward
    return PIDState(
        # What the next step compares with is set as if this sample had been the last.
        integral=clip(integral, k.integral_min, k.integral_max, xp),
        measurement=None if state.measurement is None else measurement.copy(),
        derivative=None if state.derivative is None else rate,
        setpoint=None if state.setpoint is None else zero + setpoint,
        setpoint_seen=None if state.setpoint_seen is None else xp.ones_like(measurement),
        effort=None if state.effort is None else zero + effort,
        origin=lasting,
    )
