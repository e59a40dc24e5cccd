r"""Coefficients of operational-space control at one time step.

A loop with constant params computes them once. They are marked with an asterisk in the acceleration
of the task (:mod:`batchpid.task_space.operational_space`), where e is the error of the pose, v the
twist of the tool, V and V' the twist and acceleration of the setpoint, and I the integral::

    a = kp* e - kd* v + c* V + g* V' + I        I <- I + ki* dt e - ki2* V

- "explicit": kp* = kp, kd* = c* = kd, g* = 1, ki* = ki and ki2* = 0. Decoupled axes are stable for
  w dt < 0.828 with kp = w^2, kd = 2 w.
- "implicit": the error, the twist and the integral are those at the end of the step, where V and V'
  are given. As for joints (:mod:`batchpid.law.coefficients`), with D = 1 + dt kd + dt^2 kp + dt^3 ki::

      kp* = (kp + dt ki) / D      kd* = (kd + dt kp + dt^2 ki) / D      c* = kd / D      g* = 1 / D      ki* = ki / D

  and ki2* = ki* dt^2. A pole s becomes 1 / (1 - s dt): decoupled axes are stable at any dt.

The posture has the same law, without V and integral.
"""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.choices import NamedChoice
from batchpid.arrays.elementwise import namespace
from batchpid.checks.validate import check_time_step, instance
from batchpid.task_space.osc_params import MAKE_PARAMS, OSCParams


class OSCCoefficients(NamedTuple):
    """:class:`OSCParams` at one dt; None is off."""

    kp: Array
    kd: Array
    c: Array
    acceleration_share: Array
    """g* (1 | envs, 6)."""
    ki_dt: Array
    ki_dt2: Array
    posture_kp: Array
    posture_kd: Array
    limit_kp: Array
    limit_kd: Array
    limit_margin: Array
    limit_low: Array
    """Positions (1 | envs, dof) from which joints are pushed back: limits less their margins."""
    limit_high: Array
    integral_limit: Array
    position_error_limit: Array
    rotation_error_limit: Array
    smallest_eigenvalue: Array
    axes: Array
    force_axes: Array
    effort_min: Array
    effort_max: Array
    turns: Array
    frame: NamedChoice | None


def discretise(params: OSCParams, dt: Array) -> OSCCoefficients:
    """Return the law's coefficients at ``dt`` [s], for :func:`batchpid.task_space.osc`.

    Raises
    ------
    InvalidArgumentError
        The params are of another type, or dt is not positive, or above 1 s.
    """
    instance("params", params, OSCParams, MAKE_PARAMS)
    check_time_step(dt)
    # Explicit gains first; the implicit law then replaces those that it changes.
    xp = namespace(*params, dt)
    kp = params.stiffness
    kd = params.damping
    ki = params.integral_gain
    posture_kp = params.posture_stiffness
    posture_kd = params.posture_damping
    limit_kp = params.limit_stiffness
    margin = params.limit_margin
    if limit_kp is None:
        limit_kd = None
    else:
        limit_kd = 2 * xp.sqrt(limit_kp)
    c = kd
    share = xp.ones_like(kp)
    ki_dt2 = None
    if params.discretization is not None:
        stiffness = kp if ki is None else kp + dt * ki
        share = 1 / (1 + dt * kd + dt * dt * stiffness)
        c = kd * share
        kd = (kd + dt * stiffness) * share
        kp = stiffness * share
        if ki is not None:
            ki = ki * share
            ki_dt2 = ki * dt * dt
        # Posture and limits have no integral, and a simpler denominator.
        posture_kp, posture_kd = _implicit(posture_kp, posture_kd, dt)
        if limit_kp is not None:
            limit_kp, limit_kd = _implicit(limit_kp, limit_kd, dt)
    same = {
        name: leaf for name, leaf in params._asdict().items() if name in OSCCoefficients._fields
    }
    # A joint with a margin of 0 is pushed from nowhere: its ends lie at infinity.
    part = {
        "limit_margin": None if margin is None else xp.where(margin > 0, margin, 1.0),
        "limit_low": (
            None if margin is None else xp.where(margin > 0, params.lower + margin, -xp.inf)
        ),
        "limit_high": (
            None if margin is None else xp.where(margin > 0, params.upper - margin, xp.inf)
        ),
    }
    return OSCCoefficients(
        **same | part,
        kp=kp,
        kd=kd,
        c=c,
        acceleration_share=share,
        ki_dt=None if ki is None else ki * dt,
        ki_dt2=ki_dt2,
        posture_kp=posture_kp,
        posture_kd=posture_kd,
        limit_kp=limit_kp,
        limit_kd=limit_kd,
    )


def _implicit(kp: Array, kd: Array, dt: Array) -> tuple[Array, Array]:
    """Return kp* and kd* of a law without integral."""
    share = 1 / (1 + dt * kd + dt * dt * kp)
    return kp * share, (kd + dt * kp) * share
