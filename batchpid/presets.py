"""Other controllers' numerics, step for step, as parameters of the one law.

Every preset returns :class:`batchpid.PIDParams`; more options can be set on them with ``params.replace(...)``. What a
peer does wrong is reproduced only where its docstring says so, and can be switched off.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from batchpid.params import PIDParams, make_params


def tutorial(
    joints: int, kp: Any = 0.0, ki: Any = 0.0, kd: Any = 0.0, *, kick: bool = True, **options: Any
) -> PIDParams:
    """SimplePID of SAPIEN's tutorial "Drive Robot with PID Controller".

    Integrates first, derivative on the error, no limits. Its derivative starts from an error of 0, so its first
    effort contains kd * error / dt: ``kick=False`` leaves that out.
    """
    return make_params(
        joints,
        kp,
        ki,
        kd,
        setpoint_weight_derivative=1.0,
        integration="integrate_first",
        first_derivative="kick" if kick else "zero",
        **options,
    )


def simple_pid(
    joints: int,
    kp: Any = 1.0,
    ki: Any = 0.0,
    kd: Any = 0.0,
    *,
    output_limits: tuple[Any, Any] = (None, None),
    proportional_on_measurement: bool = False,
    differential_on_measurement: bool = True,
    **options: Any,
) -> PIDParams:
    """m-lundberg/simple-pid 2.0.1, with ``sample_time=None`` and ``dt`` given.

    Integrates first, the integral clamped to the output limits. Proportional on measurement acts on the way since the
    first measurement. Angles are better served by ``continuous=`` than by its ``error_map``, whose derivative spikes.
    """
    low, high = output_limits
    limited = low is not None or high is not None
    return make_params(
        joints,
        kp,
        ki,
        kd,
        effort_min=low,
        effort_max=high,
        anti_windup="clamp" if limited else "none",
        setpoint_weight=0.0 if proportional_on_measurement else None,
        weight_origin="start" if proportional_on_measurement else "zero",
        setpoint_weight_derivative=None if differential_on_measurement else 1.0,
        integration="integrate_first",
        **options,
    )


def control_toolbox(
    joints: int,
    p: Any = 0.0,
    i: Any = 0.0,
    d: Any = 0.0,
    *,
    u_max: Any = math.inf,
    u_min: Any = -math.inf,
    i_max: Any = math.inf,
    i_min: Any = -math.inf,
    antiwindup: str = "none",
    tracking_time: Any = None,
    kick: bool = True,
    **options: Any,
) -> PIDParams:
    """ros-controls/control_toolbox 6.3.0, src/pid.cpp, on the error alone.

    Outputs first, then integrates; ``antiwindup`` is "none", "back_calculation" or "conditional_integration"; the
    integral is clamped to [i_min, i_max] besides. ``tracking_time=None`` is its rule for 0: sqrt(d/i), or p/i. Its
    first derivative is taken from an error of 0: ``kick=False`` leaves that out. Not reproduced: NaN for I alone with
    back-calculation, and the oscillation of a tracking time below dt.
    """
    strategy = {"conditional_integration": "conditional"}.get(antiwindup, antiwindup)
    return make_params(
        joints,
        p,
        i,
        d,
        effort_min=u_min,
        effort_max=u_max,
        integral_min=i_min,
        integral_max=i_max,
        anti_windup=strategy,
        tracking_time=tracking_time,
        setpoint_weight_derivative=1.0,
        first_derivative="kick" if kick else "zero",
        **options,
    )


def newton(
    joints: int, kp: Any = 0.0, ki: Any = 0.0, kd: Any = 0.0, *, integral_max: Any = math.inf, **options: Any
) -> PIDParams:
    """DrivePID of newton.actuators: I = clamp(I + e dt, +-integral_max), and rates as given.

    Step it with ``measurement_rate`` and ``setpoint_rate``; its constant and feedforward efforts are the
    ``feedforward``. ``effort_limit=`` is its clamp stage, which does not act back on I. There, integral_max is in
    position seconds; here it becomes ki * integral_max.
    """
    limit, gain = np.asarray(integral_max, dtype=float), np.asarray(ki, dtype=float)
    unbounded = np.isinf(limit)
    in_effort = np.where(unbounded, limit, gain * np.where(unbounded, 0.0, limit))
    return make_params(joints, kp, ki, kd, integral_limit=in_effort, integration="integrate_first", **options)
