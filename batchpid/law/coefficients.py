r"""Coefficients of the law at one time step. A loop with constant params computes them once.

The implicit law takes P, I and D at the end of the time step, for gains of an acceleration. It is
stable at any time step.

With u = M a + passive force, each joint moves as v+ = v + dt a, y+ = y + dt v+ (semi-implicit
Euler). The law takes its error, rate and integral there, as backward Euler does, with the setpoint
r and its rate r' at the end of the step::

    a = kp (b r - y+) + kd (c r' - v+) + I+ + r''   I+ = I + ki dt (r - y+)       I <- I + ki dt (r - dt r' - y)

The last is the same at the beginning of the step, with the error that was measured. y+ and v+
contain a. Solved for it, with D = 1 + dt kd + dt^2 kp + dt^3 ki and e = r - y::

    D a = kp (b r - y - dt v) + kd (c r' - v) + I + ki dt (e - dt v) + r''

with the setpoint's acceleration r'', 0 unless given. (b r is short for o + b (r - o); a given rate
moves the origin o to the end of the step, too.) That is the explicit law with other gains, so a
step costs no more::

    kp* = (kp + 2 dt ki) / D            b* = (b kp + 2 dt ki) / (kp + 2 dt ki)
    kd* = (kd + dt kp + dt^2 ki) / D    c* = (c kd - dt^2 ki) / (kd + dt kp + dt^2 ki)
    ki* = ki / D                        and I <- I - ki* dt^2 r' where a rate of the setpoint is given; else r' = 0

A pole s of the loop in continuous time becomes z = 1 / (1 - s dt): the loop is stable at any dt if
it is stable in continuous time. The explicit law with kp = w^2 and kd = 2 w is stable for w dt <
0.828.

- Setpoint: r is the position for the end of the step. The explicit law takes it for the beginning,
  and leads by dt r'.
- Integral: the state is I / D, the acceleration that it contributes. Its limits and anti-windup
  work as in the explicit law. The part 2 dt ki of kp* is outside of its limits.
- Saturation: limits act on u as before. The prediction assumes that a is delivered.
- Dead zone: P and I see the error less the zone; the predicted motion dt v damps within it, too.
- Rate: v is the measured rate or the difference of positions, which is the same under semi-implicit
  Euler. A filter of the derivative would delay the prediction: :func:`batchpid.make_params` refuses
  it.
- Load: one that the passive force does not contain shifts a joint by its acceleration / kp*, not /
  kp, until the integral has learnt it. Without integral kp* < 1 / dt^2.
- Model: where the law's M is f times the true one, the ratio of :func:`batchpid.stability_bound`
  for kp* and kd* is multiplied by f. With kp = w^2, kd = 2 w: f < 2 (1 + w dt)^2 / (2 w dt + 1.5 (w
  dt)^2), which is 4.6, 2.3, 1.64 and 1.42 at w dt = 0.3, 1, 3 and 10, and 4/3 in the limit. An
  unmodelled payload (f < 1) is harmless.

E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (Springer, 1996), section IV.3.
"""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array, NamedChoice
from batchpid.arrays.elementwise import TURN, namespace, tiny_of
from batchpid.arrays.records import array_summary
from batchpid.arrays.trees import mapped
from batchpid.checks import instance
from batchpid.law.params import PIDParams
from batchpid.law.state import checked_dt


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
    anti_windup: NamedChoice | None
    turns: Array
    """1 / (2 pi) on continuous joints, 0 elsewhere."""
    tiny: Array
    """Argument of :func:`batchpid.arrays.elementwise.flush`."""
    measurement_rate: Array
    gain_units: NamedChoice | None
    """Unit of gains that :mod:`batchpid.law.computed_torque` turns into efforts; the law alone
    refuses them.
    """

    def __repr__(self) -> str:
        return array_summary(self)


def discretise(params: PIDParams, dt: Array) -> Coefficients:
    """Return the law's coefficients at ``dt`` [s], for :func:`batchpid.advance`.

    Raises InvalidArgumentError for params of another type, and unless dt is positive and finite; an
    array of JAX is not checked.
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
    return Coefficients(
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


def spread(k: Coefficients, num_envs: int) -> Coefficients:
    """Return ``k`` with arrays of shape (num_envs, joints): NumPy then steps small batches twice as
    fast.
    """
    xp = namespace(*k)
    zeros = xp.zeros((num_envs, k.kp.shape[-1]), k.kp.dtype)
    wide: Coefficients = mapped(lambda leaf: zeros + xp.asarray(leaf, dtype=zeros.dtype), k)
    return wide


def implicit_gains(params: PIDParams, dt: Array) -> tuple[Array, ...]:
    """Return (kp*, ki*, kd*, b*, c*, c* of a setpoint rate that is given, 1 / D) of implicit
    ``params`` at ``dt`` [s]; an entry whose option is off is None.

    The first c* weighs the difference quotient of setpoints, which has no part in the integral: it
    is c kd / (kd + dt kp + dt^2 ki). 1 / D weighs a setpoint acceleration that is given.
    """
    kp = params.kp
    ki = params.ki
    kd = params.kd
    b = params.setpoint_weight
    c = params.setpoint_weight_derivative
    xp = namespace(
        kp,
        ki,
        kd,
        b,
        c,
        dt,
    )
    ki_dt = 0.0 if ki is None else ki * dt
    # The symbols of the equations above: numerators first, then 1 / D.
    stiffness = kp + 2 * ki_dt
    damping = kd + dt * (kp + ki_dt)
    per_step = 1 / (1 + dt * damping)
    on_rate = kd if c is None else c * kd

    def share(part: Array, whole: Array, otherwise: Array) -> Array:
        # A joint without gain has no share; the inner where keeps gradients finite.
        has = whole > 0
        return xp.where(has, part / xp.where(has, whole, 1), otherwise)

    return (
        stiffness * per_step,
        None if ki is None else ki * per_step,
        damping * per_step,
        None if b is None else share(b * kp + 2 * ki_dt, stiffness, b),
        None if c is None else share(on_rate, damping, 0),
        share(on_rate - dt * ki_dt, damping, 0),
        per_step,
    )


def as_explicit(params: PIDParams, dt: Array) -> PIDParams:
    """Return explicit ``params`` unchanged, and implicit ones as params of the explicit law with
    the same gains at ``dt`` [s].

    Their ``setpoint_weight_derivative`` is for a setpoint rate that is given.
    """
    if params.discretization is None:
        return params
    kp, ki, kd, b, _, c, _ = implicit_gains(params, dt)
    return params._replace(
        kp=kp,
        ki=ki,
        kd=kd,
        setpoint_weight=b,
        setpoint_weight_derivative=c,
        discretization=None,
    )
