"""The law's coefficients at one time step: all that a loop of constant params can compute once."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from batchpid.display import array_summary
from batchpid.elementwise import TURN, namespace, tiny_of
from batchpid.errors import InvalidArgumentError
from batchpid.params import PIDParams


class Coefficients(NamedTuple):
    """:class:`PIDParams` at one dt, in the symbols of :mod:`batchpid.law`; None is off, as there."""

    kp: Any
    ki_dt: Any
    kd: Any
    per_dt: Any
    """1 / dt."""
    decay: Any
    """tau / (tau + dt): what the derivative's filter keeps in a step."""
    intake: Any
    """dt / (tau + dt): what it takes in."""
    effort_min: Any
    effort_max: Any
    effort_step: Any
    """Largest change of the effort in a step."""
    integral_min: Any
    integral_max: Any
    b: Any
    c: Any
    deadband: Any
    tracking: Any
    """dt / Tt, at most 1: a shorter Tt would take back more than the whole excess, and oscillate."""
    conditional: Any
    turns: Any
    """1 / (2 pi) on continuous joints, 0 elsewhere."""
    tiny: Any
    """What :func:`batchpid.elementwise.flush` rounds with."""
    integration: Any
    weight_origin: Any
    non_finite: Any

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")


def discretise(params: PIDParams, dt: Any, num_envs: int | None = None) -> Coefficients:
    """Return the law's coefficients at ``dt`` [s], for :func:`batchpid.advance`.

    With ``num_envs`` each is spread to (num_envs, joints), which lets NumPy step small batches twice as fast.

    Raises
    ------
    InvalidArgumentError
        If dt is a Python number that is not positive and finite.
    """
    if isinstance(dt, int | float) and not 0 < dt < math.inf:
        raise InvalidArgumentError("dt", "is not positive and finite", value=dt, remedy="give seconds > 0")
    ki, rate_limit, wraps = params.ki, params.effort_rate_limit, params.continuous
    tau, tracking = params.derivative_filter_time, params.tracking_time
    coefficients = Coefficients(
        kp=params.kp,
        ki_dt=None if ki is None else ki * dt,
        kd=params.kd,
        per_dt=1 / dt,
        decay=None if tau is None else tau / (tau + dt),
        intake=None if tau is None else dt / (tau + dt),
        effort_min=params.effort_min,
        effort_max=params.effort_max,
        effort_step=None if rate_limit is None else rate_limit * dt,
        integral_min=params.integral_min,
        integral_max=params.integral_max,
        b=params.setpoint_weight,
        c=params.setpoint_weight_derivative,
        deadband=params.deadband,
        tracking=None if tracking is None else dt / namespace(tracking, dt).maximum(tracking, dt),
        conditional=params.conditional,
        turns=None if wraps is None else wraps / TURN,
        tiny=None if tau is None and tracking is None else tiny_of(params.dtype),
        integration=params.integration,
        weight_origin=params.weight_origin,
        non_finite=params.non_finite,
    )
    return coefficients if num_envs is None else _spread(coefficients, (num_envs, params.num_joints))


def _spread(coefficients: Coefficients, shape: tuple[int, int]) -> Coefficients:
    xp, dtype = namespace(*coefficients), coefficients.kp.dtype
    return Coefficients(
        *(
            leaf if leaf is None or isinstance(leaf, tuple) else xp.zeros(shape, dtype) + xp.asarray(leaf, dtype=dtype)
            for leaf in coefficients
        )
    )
