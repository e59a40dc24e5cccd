"""Params that give other controllers' numerics, step for step.

Every preset returns :class:`batchpid.PIDParams` and takes further options of :func:`batchpid.make_params`. Errors of a
controller are reproduced only where the docstring mentions them, and can be switched off.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Document
from batchpid.arrays.elementwise import namespace
from batchpid.law.params import PIDParams, make_params


def tutorial(
    joints: int, kp: Array = 0.0, ki: Array = 0.0, kd: Array = 0.0, *, kick: bool = True, **options: Any
) -> PIDParams:
    """Return params of SimplePID of SAPIEN's tutorial "Drive Robot with PID Controller".

    Integrates first, derivative on the error, no limits. Its derivative starts from an error of 0, so its first
    effort contains kd * error / dt; not with ``kick=False``.
    """
    first = "kick" if kick else "zero"
    order = {"integration": "integrate_first", "first_derivative": first, "setpoint_weight_derivative": 1.0}
    return make_params(joints, kp, ki, kd, **{**order, **options})


def simple_pid(
    joints: int,
    kp: Array = 1.0,
    ki: Array = 0.0,
    kd: Array = 0.0,
    *,
    output_limits: tuple[Any, Any] = (None, None),
    proportional_on_measurement: bool = False,
    differential_on_measurement: bool = True,
    **options: Any,
) -> PIDParams:
    """Return params of m-lundberg/simple-pid 2.0.1, with ``sample_time=None`` and ``dt`` given.

    Integrates first, the integral clamped to the output limits. Proportional on measurement acts on the way since the
    first measurement. For angles use ``continuous=`` instead of its ``error_map``, whose derivative spikes.
    """
    low, high = output_limits
    own: Document = {"effort_min": low, "effort_max": high, "integration": "integrate_first"}
    if low is not None or high is not None:
        own["anti_windup"] = "clamp"
    if proportional_on_measurement:
        own |= {"setpoint_weight": 0.0, "weight_origin": "start"}
    if not differential_on_measurement:
        own["setpoint_weight_derivative"] = 1.0
    return make_params(joints, kp, ki, kd, **{**own, **options})


def control_toolbox(
    joints: int,
    p: Array = 0.0,
    i: Array = 0.0,
    d: Array = 0.0,
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
    """Return params of ros-controls/control_toolbox 6.3.0, src/pid.cpp, on the error alone.

    Outputs first, then integrates; ``antiwindup`` is "none", "back_calculation" or "conditional_integration"; the
    integral is clamped to [i_min, i_max] too. ``tracking_time=None`` is its rule for 0: sqrt(d/i), or p/i. Its
    first derivative is taken from an error of 0; not with ``kick=False``. Not reproduced: NaN for I alone with
    back-calculation, and the oscillation of a tracking time below dt.
    """
    own = {"effort_min": u_min, "effort_max": u_max, "integral_min": i_min, "integral_max": i_max}
    own |= {"setpoint_weight_derivative": 1.0, "first_derivative": "kick" if kick else "zero"}
    strategy = "conditional" if antiwindup == "conditional_integration" else antiwindup
    return make_params(joints, p, i, d, anti_windup=strategy, tracking_time=tracking_time, **{**own, **options})


def newton(
    joints: int, kp: Array = 0.0, ki: Array = 0.0, kd: Array = 0.0, *, integral_max: Any = math.inf, **options: Any
) -> PIDParams:
    """Return params of DrivePID of newton.actuators: I = clamp(I + e dt, +-integral_max), and rates as given.

    Step it with ``measurement_rate`` and ``setpoint_rate``; its constant and feedforward efforts are the
    ``feedforward``. ``effort_limit=`` is its clamp stage, which does not act back on I. Its ``integral_max`` is in
    position seconds; the params have ki * integral_max.
    """
    limit = np.asarray(integral_max, dtype=float)
    unbounded = np.isinf(limit)
    in_effort = None if unbounded.all() else namespace(ki).where(unbounded, limit, ki * np.where(unbounded, 0.0, limit))
    return make_params(joints, kp, ki, kd, integral_limit=in_effort, integration="integrate_first", **options)
