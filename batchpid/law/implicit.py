r"""Implicit law: P, I and D at the end of the time step, for gains of an acceleration. Stable at
any time step.

With u = M a + passive force, each joint moves as v+ = v + dt a, y+ = y + dt v+ (semi-implicit
Euler). The law takes its error, rate and integral there, as backward Euler does, with the setpoint
r and its rate r' at the end of the step::

    a = kp (b r - y+) + kd (c r' - v+) + I+ + r''   I+ = I + ki dt (r - y+)       I <- I + ki dt (r - dt r' - y)

The last is the same at the beginning of the step, with the error that was measured. y+ and v+
contain a. Solved for it, with D = 1 + dt kd + dt^2 kp + dt^3 ki and e = r - y::

    D a = kp (b r - y - dt v) + kd (c r' - v) + I + ki dt (e - dt v) + r''

with the setpoint's acceleration r'', 0 unless given. (b r stands for o + b (r - o); a given rate
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
- Integral: the state is I / D, the acceleration that it contributes. Its limits, anti-windup and
  bumpless transfer work as in the explicit law. The part 2 dt ki of kp* is outside of its limits.
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

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace
from batchpid.law.params import PIDParams


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
    xp = namespace(kp, ki, kd, b, c, dt)
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
        kp=kp, ki=ki, kd=kd, setpoint_weight=b, setpoint_weight_derivative=c, discretization=None
    )
