r"""Implicit law: P, I and D at the end of the time step, for gains of an acceleration. Stable at any time step.

With u = M a + passive force, each joint moves as v+ = v + dt a, y+ = y + dt v+ (semi-implicit Euler). The law takes
its error, rate and integral there, as backward Euler does, with the setpoint r and its rate r' at the end of the step::

    a = kp (b r - y+) + kd (c r' - v+) + I+        I+ = I + ki dt (r - y+)        I includes the present error

y+ and v+ contain a. Solved for it, with D = 1 + dt kd + dt^2 kp + dt^3 ki and e = r - y::

    D a = kp (b r - y - dt v) + kd (c r' - v) + I + ki dt (e - dt v)

This is the explicit law with other gains, so a step costs no more, and nothing but gains changes::

    kp* = (kp + n dt ki) / D            b* = (b kp + n dt ki) / (kp + n dt ki)
    kd* = (kd + dt kp + dt^2 ki) / D    c* = c kd / (kd + dt kp + dt^2 ki)
    ki* = ki / D                        n = 1 if the present error is integrated first, 2 if the output is first

A pole s of the loop in continuous time becomes z = 1 / (1 - s dt): the loop is stable at any dt if it is stable in
continuous time. The explicit law with kd = 2 w, kp = w^2 is stable for w dt < 0.828.

- Integral: the state is I / D, the acceleration that it contributes. Its limits, anti-windup and bumpless transfer
  are those of the explicit law. Within its limits it is exact; the part n dt ki of kp* is outside of them.
- Saturation: limits act on u as before. The prediction assumes that a is delivered.
- Dead zone: P and I see the error less the zone; the predicted motion dt v damps within it, too.
- Rate: v is the measured rate or the difference of positions, which is the same under semi-implicit Euler. A filter of
  the derivative would delay the prediction, and make_params refuses it.
- Load: one that the passive force does not contain shifts a joint by its acceleration / kp*, not / kp, until the
  integral has learnt it. kp* < 1 / dt^2 without integral.
- Model: where the law's M is f times the true one, the ratio of :func:`batchpid.stability_bound` for kp* and kd* is
  multiplied by f. With kp = w^2, kd = 2 w: f < 2 (1 + w dt)^2 / (2 w dt + 1.5 (w dt)^2), which is 4.6, 2.3, 1.64 and
  1.42 at w dt = 0.3, 1, 3 and 10, and 4/3 in the limit. An unmodelled payload (f < 1) is harmless.

E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (Springer, 1996), section IV.3.
"""

from __future__ import annotations

from typing import Any

from batchpid.arrays.elementwise import namespace
from batchpid.law.params import PIDParams


def as_explicit(params: PIDParams, dt: Any) -> PIDParams:
    """Return params of the explicit law that are those of the implicit ``params`` at ``dt`` [s].

    Explicit params are returned as they are. In the others, ``setpoint_weight_derivative`` is the weight c* of a
    setpoint rate that is given; without a given rate and without c, there is none.
    """
    if params.discretization is None:
        return params
    kp, kd, b, c = params.kp, params.kd, params.setpoint_weight, params.setpoint_weight_derivative
    xp = namespace(kp, kd, params.ki, dt)
    ki_dt = 0.0 if params.ki is None else params.ki * dt
    ahead = ki_dt * (2 if params.integration is None else 1)
    stiffness, damping = kp + ahead, kd + dt * (kp + ki_dt)
    per_step = 1 / (1 + dt * damping)

    def share(part: Any, whole: Any, otherwise: Any) -> Any:
        has = whole > 0
        return xp.where(has, part / xp.where(has, whole, 1), otherwise)

    return params._replace(
        kp=stiffness * per_step,
        ki=None if params.ki is None else params.ki * per_step,
        kd=damping * per_step,
        setpoint_weight=None if b is None else share(b * kp + ahead, stiffness, b),
        setpoint_weight_derivative=share(kd if c is None else c * kd, damping, 0 if c is None else c),
        discretization=None,
    )
