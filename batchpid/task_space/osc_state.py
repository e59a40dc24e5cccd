r"""Inputs, state, terms and coefficients of operational-space control.

A loop with constant params computes the coefficients at its time step once. They are marked with an
asterisk in the acceleration of the task (:mod:`batchpid.task_space.operational_space`), where e is
the error of the pose, v the twist of the tool, V and V' the twist and acceleration of the setpoint,
and I the integral::

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

from batchpid.arrays.array_types import Array, NamedChoice
from batchpid.arrays.elementwise import exported, namespace
from batchpid.arrays.records import array_summary
from batchpid.checks import check_time_step, instance
from batchpid.task_space.osc_params import MAKE_PARAMS, OSCParams
from batchpid.task_space.rigid_tree import RigidTree


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
    """Damping over margin (1 | envs, dof)."""
    limit_low: Array
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
    xp = namespace(*params, dt)
    is_implicit = params.discretization is not None
    kp = params.stiffness
    ki = params.integral_gain
    if is_implicit and ki is not None:
        kp = kp + dt * ki
    kp, kd, share = _at_step(params, kp, params.damping, dt)
    ki_dt = None if ki is None else share * ki * dt
    ki_dt2 = ki_dt * dt if is_implicit and ki is not None else None
    posture_kp, posture_kd, _ = _at_step(
        params, params.posture_stiffness, params.posture_damping, dt
    )
    limit_kp = params.limit_stiffness
    limit_kd = None
    if limit_kp is not None:
        limit_kp, limit_kd, _ = _at_step(params, limit_kp, 2 * xp.sqrt(limit_kp), dt)
        limit_kd = limit_kd / xp.where(params.limit_margin > 0, params.limit_margin, 1.0)
    same = {
        name: leaf for name, leaf in params._asdict().items() if name in OSCCoefficients._fields
    }
    return OSCCoefficients(
        **same,
        kp=kp,
        kd=kd,
        c=params.damping * share,
        acceleration_share=share,
        ki_dt=ki_dt,
        ki_dt2=ki_dt2,
        posture_kp=posture_kp,
        posture_kd=posture_kd,
        limit_kp=limit_kp,
        limit_kd=limit_kd,
    )


def _at_step(
    params: OSCParams,
    kp: Array,
    kd: Array,
    dt: Array,
) -> tuple[Array, Array, Array]:
    """Return kp*, kd* and g* of a law without integral."""
    if params.discretization is None:
        return kp, kd, namespace(kp).ones_like(kp)
    share = 1 / (1 + dt * kd + dt * dt * kp)
    return kp * share, (kd + dt * kp) * share, share


class Tool(NamedTuple):
    """A point of a robot's link."""

    tree: RigidTree
    link: str
    point: Array = None
    """Point (3,) in the frame of the link [m]; None: its origin."""


class OSCInputs(NamedTuple):
    """Inputs of one step, arrays (envs, ...), or (1, ...) for all envs; None: 0."""

    setpoint: Array
    """Poses (envs, 7): position [m] and quaternion (w, x, y, z) of any length, in the world."""
    qpos: Array
    """(envs, dof) [rad or m]."""
    qvel: Array
    """(envs, dof) [rad/s or m/s]."""
    twist: Array = None
    """V of the setpoint (envs, 6) [m/s, rad/s], in the axes of the world."""
    acceleration: Array = None
    """V' of the setpoint (envs, 6) [m/s^2, rad/s^2], in these axes."""
    wrench: Array = None
    """Wrench of the tool on its surroundings (envs, 6) [N, N m], in the axes of the params'
    frame.
    """
    feedforward: Array = None
    """Effort added (envs, dof), such as the effort of viscous damping [N m or N]."""

    def __repr__(self) -> str:
        return array_summary(self, "envs", "columns")


class TaskDynamics(NamedTuple):
    """Dynamics of a robot and its tool at present positions and velocities, from
    :func:`.task_dynamics` or an engine.
    """

    pose: Array
    """Of the tool (envs, 7): position [m] and quaternion (w, x, y, z)."""
    jacobian: Array
    """J of the tool (envs, 6, dof), in the axes of the world."""
    jacobian_rate: Array
    """J' q' (envs, 6)."""
    mass_matrix: Array
    """M (envs, dof, dof) [kg m^2 or kg]."""
    bias: Array
    """h (envs, dof): gravity, Coriolis and centrifugal forces [N m or N]."""
    chain: Array
    """1.0 for the joints between the base and the tool, else 0.0 (dof,)."""


@exported
class OSCState(NamedTuple):
    """State of the law."""

    posture: Array
    """Positions (envs, dof) that the joints are drawn to, by the posture gains [rad or m]."""
    integral: Array = None
    """I (envs, 6): acceleration of the task [m/s^2, rad/s^2]. None without
    ``integral_gain``."""

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")


class OSCTerms(NamedTuple):
    """Terms of one step."""

    error: Array
    """Error of the pose (envs, 6) [m, rad], in the axes of the params' frame, before its norms are
    limited.
    """
    wrench: Array
    """Wrench F of the task (envs, 6) [N, N m], in these axes, before saturation."""
    task: Array
    """Efforts of F, J^T F (envs, dof)."""
    posture: Array
    """Efforts of the posture, before saturation (envs, dof)."""
    unsaturated: Array
    """Sum of all efforts (envs, dof) [N m or N]."""
    effort: Array
    """Efforts after saturation (envs, dof)."""
    task_share: Array
    """s1 (envs,): share of F that the limits allow."""
    posture_share: Array
    """s2 (envs,): share of the posture's efforts."""
    near_singular: Array
    """Bool (envs,): an eigenvalue of A is below s0, so that some direction has lost stiffness; True
    for NaN.
    """

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")
