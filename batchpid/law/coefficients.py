"""Coefficients of the law at one time step. A loop with constant params computes them once."""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.choices import NamedChoice
from batchpid.arrays.elementwise import TURN, namespace, tiny_of
from batchpid.arrays.records import array_summary
from batchpid.checks.validate import instance
from batchpid.law.implicit import as_explicit, implicit_gains
from batchpid.law.input_checks import checked_dt
from batchpid.law.params import PIDParams


class Coefficients(NamedTuple):
    """:class:`PIDParams` at one dt, in the symbols of :mod:`batchpid.law.pid`; None is off."""

    kp: Array
    ki_dt: Array
    ki_dt2: Array
    """ki dt^2 of the implicit law: weight in the integral of a given setpoint rate."""
    kd: Array
    per_dt: Array
    """1 / dt."""
    decay: Array
    """tau / (tau + dt), the weight of the derivative's old value in its filter."""
    intake: Array
    """dt / (tau + dt), the weight of its new value."""
    effort_min: Array
    effort_max: Array
    effort_step: Array
    """Largest change of the effort in a step."""
    integral_min: Array
    integral_max: Array
    b: Array
    c: Array
    c_given: Array
    """Weight c of a given setpoint rate in the implicit law; None: c, or 1."""
    origin_dt: Array
    """dt, where a given setpoint rate moves the origin of setpoint weighting."""
    acceleration_share: Array
    """Weight of a given setpoint acceleration in the implicit law; None: 1."""
    deadband: Array
    tracking: Array
    """dt / Tt, at most 1. Above 1, a step would correct more than the whole excess, and
    oscillate.
    """
    conditional: Array
    """Everywhere(), or 1.0 on the joints that have it."""
    turns: Array
    """1 / (2 pi) on continuous joints, 0 elsewhere."""
    tiny: Array
    """Argument of :func:`batchpid.arrays.elementwise.flush`."""
    non_finite: NamedChoice | None
    measurement_rate: Array
    gain_units: NamedChoice | None
    """Unit of gains that :mod:`batchpid.law.computed_torque` turns into efforts; the law alone
    refuses them.
    """

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")


def discretise(params: PIDParams, dt: Array, num_envs: int | None = None) -> Coefficients:
    """Return the law's coefficients at ``dt`` [s], for :func:`batchpid.advance`.

    With ``num_envs`` they have the shape of :func:`spread`. Raises InvalidArgumentError for params
    of another type, and unless dt is positive and finite; an array of JAX is not checked.
    """
    instance("params", params, PIDParams, "build them with make_params")
    dt = checked_dt(dt)
    # The implicit law is the explicit one with other gains and three further coefficients.
    c = params.setpoint_weight_derivative
    c_given = None
    share = None
    implicit = params.discretization is not None
    if implicit:
        c, c_given, share = implicit_gains(params, dt)[-3:]
        params = as_explicit(params, dt)
    tau = params.derivative_filter_time
    tracking = params.tracking_time
    same = {name: leaf for name, leaf in params._asdict().items() if name in Coefficients._fields}
    # Leaves that time does not scale keep their names.
    k = Coefficients(
        **same,
        ki_dt=None if params.ki is None else params.ki * dt,
        ki_dt2=params.ki * dt * dt if implicit and params.ki is not None else None,
        per_dt=1 / dt,
        decay=None if tau is None else tau / (tau + dt),
        intake=None if tau is None else dt / (tau + dt),
        effort_step=None if params.effort_rate_limit is None else params.effort_rate_limit * dt,
        b=params.setpoint_weight,
        c=c,
        c_given=c_given,
        origin_dt=None if params.setpoint_weight is None else dt,
        acceleration_share=share,
        tracking=None if tracking is None else dt / namespace(tracking, dt).maximum(tracking, dt),
        turns=None if params.continuous is None else params.continuous / TURN,
        tiny=None if tau is None and tracking is None else tiny_of(params.dtype),
    )
    if num_envs is None:
        return k
    return spread(k, num_envs)


def spread(k: Coefficients, num_envs: int) -> Coefficients:
    """Return ``k`` with arrays of shape (num_envs, joints): NumPy then steps small batches twice as
    fast.
    """
    # Masks and options that are off have no rows.
    xp = namespace(*k)
    dtype = k.kp.dtype
    zeros = xp.zeros((num_envs, k.kp.shape[-1]), dtype)
    off = (type(None), tuple)
    return Coefficients._make(
        leaf if isinstance(leaf, off) else zeros + xp.asarray(leaf, dtype=dtype) for leaf in k
    )
