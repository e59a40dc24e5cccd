r"""Operational-space control: the tool as decoupled unit masses on springs, pure functions on
(envs, ...) arrays.

With the tool's Jacobian J and pose, the mass matrix M and the bias h at present, the joints c of
the chain to the tool and the other joints o, the setpoint's pose, twist V and acceleration V', and
the gains kp, kd, ki of the task and kp_n, kd_n of the posture::

    e     = position and rotation vector from the pose to the setpoint, each shortened to its limit
    a     = kp e + kd (V - J q') + V' + I                       acceleration of the task
    A     = J M_cc^-1 J^T
    L     = (S A S^T)^-1, bounded                               its inertia, in the selected axes S
    F     = L (a - J' q') + wrench
    a_n   = a_s - a_d                                           acceleration of the posture: springs and damping
    a_s   = kp_n (posture - q) + kp_l x
    a_d   = kd_n q' + 2 sqrt(kp_l) q' |x| / margin
    task  = J^T F
    null  = M_cc a_n - J^T (L_s J a_s - L_n J a_d)              = N^T M_cc a_n, with J M_cc^-1 N^T = 0
    u_c   = h + M_co a_o + s1 task + s2 null + feedforward      a_o = a_n of the other joints
    u_o   = h + M_oo a_o + M_oc M_cc^-1 (s1 task + s2 null) + feedforward
    I    <- I + ki dt e, within its limit, unless s1 < 1, u is clipped or L is bounded, and a e > 0

These are the gains of the explicit law; :mod:`batchpid.task_space.osc_state` has the
implicit one. Springs of stiffness kp_l push joints of the chain away from their limits; x is the
depth of q in the margin.

The other joints, such as fingers, are controlled by computed torque: in the task they would move
with the hand. L_n is the inertia over the axes of motion and force. A bounded inverse turns an
eigenvalue s into 1/s, or s/s0^2 below s0: near a singularity the direction in which the tool cannot
move loses its stiffness to the posture, continuously, and the motion returns from it.

Below its bound an inertia lets the posture into the task. The damping has to enter below s0, where
the task loses its own. The springs would pull the tool off poses that it reaches: at rest its error
would be (s0^2/s^2 - 1) (v J a_s) / kp along the eigenvector v. So L_s has a lower bound s1 = s0/5,
below which the springs draw the robot out of the singular pose: an eigenvalue s turns into 1/s, or
s (2 - s^2/s1^2) / s1^2 below s1. The derivative is continuous, since a robot whose setpoint is out
of reach rests just below s1, where a kink would chatter.

Saturation keeps the direction of the motion: s1 in [0, 1] is the largest share of the task with
which all joints are within their limits, and s2 the largest share of the posture in the room that
is left. A joint whose u is out of limits with neither is clipped, and left out of both.

O. Khatib, "A unified approach for motion and force control of robot manipulators: the operational
space formulation", IEEE Journal on Robotics and Automation 3 (1987).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import clip, in_dtype_of, namespace, wrap
from batchpid.checks import instance
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_law
from batchpid.task_space.frames import in_axes, matrix_of, pose_error
from batchpid.task_space.osc_params import MAKE_PARAMS, OSCParams
from batchpid.task_space.osc_state import (
    OSCCoefficients,
    OSCInputs,
    OSCState,
    OSCTerms,
    TaskDynamics,
    Tool,
    in_tool_axes,
    task_dynamics,
)
from batchpid.task_space.symmetric import bounded_inverse, gram, product, quiet, whitened


def init(params: OSCParams, qpos: Array) -> OSCState:
    """Return the state before the first step: the posture is ``qpos`` (envs, dof) [rad or m], the
    integral 0.

    Raises InvalidArgumentError for params of another type.
    """
    instance("params", params, OSCParams, MAKE_PARAMS)
    # The posture begins where the robot is, so that nothing pulls at first.
    (qpos,) = in_dtype_of(params, qpos)
    xp = namespace(*params, qpos)
    posture = xp.zeros_like(qpos) + qpos
    if params.integral_gain is None:
        integral = None
    else:
        integral = xp.zeros((len(posture), 6), posture.dtype)
    return OSCState(posture, integral)


def reset(
    params: OSCParams,
    state: OSCState,
    qpos: Array,
    mask: Array,
) -> OSCState:
    """Return the state with the envs of ``mask`` (envs,) bool restarted at ``qpos`` (envs, dof)."""
    xp = namespace(*state, qpos, mask)
    fresh = init(params, qpos)
    chosen = xp.asarray(mask)[:, None]
    return OSCState(
        *[
            None if old is None else xp.where(chosen, new, old)
            for new, old in zip(fresh, state, strict=True)
        ]
    )


def osc(
    k: OSCCoefficients,
    state: OSCState,
    dynamics: TaskDynamics | Tool,
    inputs: OSCInputs,
    wanted: tuple[str, ...] = OSCTerms._fields,
) -> tuple[OSCState, OSCTerms]:
    """Advance the law by a time step; return the state and the terms, effort included.

    A row does not depend on the others, to the last bit under NumPy; NaN stays in its env.

    Parameters
    ----------
    k
        Params at the time step: :func:`batchpid.task_space.discretise`.
    dynamics
        Dynamics at the present state, such as an engine's, or a tool, with whose tree they are
        computed.
    wanted
        Names of the terms that the caller uses. Others may be None: native code leaves them out.

    Raises
    ------
    InvalidArgumentError
        The link of the tool is unknown, or an array has a wrong shape.
    """
    try:
        if (results := native_law.law(k, state, dynamics, inputs, wanted)) is not None:
            return results
        _check_shapes(k, inputs)
    except ValueError:
        _check_shapes(k, inputs)
        raise
    inputs = OSCInputs(*in_dtype_of(k, *inputs))
    if isinstance(dynamics, Tool):
        dynamics = task_dynamics(dynamics.tree, *inputs[1:3], dynamics.link, point=dynamics.point)
    with quiet():
        # All that follows is in the axes in which the gains are given.
        task = in_frame(k, dynamics, inputs)
        # Accelerations of task and posture first, then their efforts, then the limits.
        a = task_acceleration(k, task)
        a = a if state.integral is None else a + state.integral
        a_n, a_s = posture_acceleration(k, dynamics, state.posture, inputs.qpos, inputs.qvel)
        p = projections(
            k,
            task.dynamics,
            a,
            a_n,
            inputs.wrench,
            inputs.feedforward,
            a_s,
        )
        effort, whole, s1, s2 = _saturated(p, k.effort_min, k.effort_max)
        if state.integral is not None:
            held = (p.near_singular | (effort != whole).any(-1))[:, None] & (a * task.near > 0)
            state = state._replace(integral=_integrated(k, state.integral, task, held))
    shares = s1[..., 0], s2[..., 0]
    return state, OSCTerms(
        task.error,
        p.force,
        p.task,
        p.posture,
        whole,
        effort,
        *shares,
        p.near_singular,
    )


def _check_shapes(k: OSCCoefficients, inputs: OSCInputs) -> None:
    """Raise InvalidArgumentError for an input that is not (envs, size), and for coefficients of
    other envs.
    """
    if np.ndim(inputs.qpos) != 2:
        problem = f"has shape {np.shape(inputs.qpos)}, not (envs, dof)"
        raise InvalidArgumentError("qpos", problem, remedy="give one row for each env")
    envs, dof = np.shape(inputs.qpos)
    for name, value, size in zip(inputs._fields, inputs, (7, dof, dof, 6, 6, 6, dof), strict=True):
        if value is not None and np.shape(value) not in ((envs, size), (1, size)):
            problem = f"has shape {np.shape(value)}, not ({envs}, {size})"
            raise InvalidArgumentError(name, problem, remedy="give one row for each env")
    for name, leaf in zip(k._fields, k[:-1], strict=False):
        if leaf is not None and leaf.shape[0] not in (1, envs):
            problem = f"has rows for {leaf.shape[0]} envs, but qpos for {envs}"
            raise InvalidArgumentError(f"k.{name}", problem, remedy="make params for these envs")


class Task(NamedTuple):
    """Error and motion of the tool, vectors (envs, 6) in the axes of the params' frame."""

    dynamics: TaskDynamics
    error: Array
    near: Array
    """Error with limited norms."""
    tool_twist: Array
    """J q'."""
    twist: Array
    acceleration: Array


def in_frame(k: OSCCoefficients, d: TaskDynamics, inputs: OSCInputs) -> Task:
    """Return the dynamics, error and motion in the axes of the params' frame."""
    xp = namespace(*k, *d, *inputs)
    # Position and rotation have limits of their own: a far target does not drown a turn.
    error = pose_error(inputs.setpoint, d.pose)
    limits = (k.position_error_limit, k.rotation_error_limit)
    near = [
        _shortened(part, limit, xp)
        for part, limit in zip(
            (error[..., :3], error[..., 3:]),
            limits,
            strict=True,
        )
    ]
    vectors: tuple[Array, ...] = (
        error,
        xp.concatenate(near, axis=-1),
        product(d.jacobian, inputs.qvel),
    )
    vectors += inputs.twist, inputs.acceleration
    if k.frame is not None:
        turn = matrix_of(d.pose[..., 3:])
        vectors = tuple(
            [None if x is None else in_axes(turn, x[..., None])[..., 0] for x in vectors]
        )
        d = in_tool_axes(d)
    return Task(d, *vectors)


def task_acceleration(k: OSCCoefficients, task: Task) -> Array:
    """Return a (envs, 6) without I."""
    a = k.kp * task.near - k.kd * task.tool_twist
    a = a if task.twist is None else a + k.c * task.twist
    if task.acceleration is None:
        return a
    return a + k.acceleration_share * task.acceleration


def _integrated(
    k: OSCCoefficients,
    integral: Array,
    task: Task,
    held: Array,
) -> Array:
    """Return the integral after the step; it stays where it is ``held`` (envs, 6)."""
    xp = namespace(integral, task.near)
    new = integral + k.ki_dt * task.near
    if k.ki_dt2 is not None and task.twist is not None:
        new = new - k.ki_dt2 * task.twist
    return xp.where(held, integral, clip(new, -k.integral_limit, k.integral_limit, xp))


def _shortened(vector: Array, limit: Array, xp: ArrayModule) -> Array:
    """Return vectors (envs, 3), at most ``limit`` (1 | envs, 1) long."""
    length = xp.sqrt((vector * vector).sum(-1, keepdims=True))
    long = length > limit
    return vector * xp.where(long, limit / xp.where(long, length, 1.0), 1.0)


def posture_acceleration(
    k: OSCCoefficients,
    d: TaskDynamics,
    posture: Array,
    q: Array,
    v: Array,
) -> tuple[Array, Array]:
    """Return a_n and its part a_s (envs, dof)."""
    xp = namespace(posture, q, v)
    springs = k.posture_kp * wrap(posture - q, k.turns, xp)
    a = springs - k.posture_kd * v
    if k.limit_kp is None:
        return a, springs
    # Positive below the lower margin, negative above the upper one.
    depth = xp.maximum(k.limit_low - q, 0.0) - xp.maximum(q - k.limit_high, 0.0)
    pushed = k.limit_kp * depth
    return (
        a + d.chain * (pushed - k.limit_kd * v * xp.abs(depth) / k.limit_margin),
        springs + d.chain * pushed,
    )


def _saturated(p: Projections, low: Array, high: Array) -> tuple[Array, ...]:
    """Return the efforts after and before saturation, s1 and s2, all (envs, dof)."""
    xp = namespace(*p, low, high)
    base = p.base
    task = p.task
    null = p.posture
    least = -math.inf if low is None else low
    most = math.inf if high is None else high
    able = (base >= least) & (base <= most)

    def share(effort: Array, at: Array) -> Array:
        room = xp.maximum(xp.where(effort > 0, most - at, at - least), 0.0)
        size = xp.abs(effort)
        limited = able & (size > room)
        return xp.where(limited, room / xp.where(limited, size, 1.0), 1.0).min(
            axis=-1, keepdims=True
        )

    # The task takes the room first, and the posture what is left of it.
    s1 = share(task, base)
    s2 = share(null, base + s1 * task)
    others = s1 * p.task_of_others + s2 * p.posture_of_others
    effort = clip(
        base + s1 * task + s2 * null + others,
        low,
        high,
        xp,
    )
    return effort, base + task + null + others, s1, s2


SPRING_BOUND = 0.2
"""Bound s1 of L_s, as a share of the bound s0 of L_n."""


class Projections(NamedTuple):
    """Efforts before saturation, arrays (envs, dof)."""

    force: Array
    """Wrench F of the task (envs, 6)."""
    task: Array
    """J^T F."""
    posture: Array
    """N^T M_cc a_n of the chain: M_cc a_n - J^T (L_n J a_n + (L_s - L_n) J a_s)."""
    base: Array
    """h + M a_o + feedforward."""
    task_of_others: Array
    """M_oc M_cc^-1 task."""
    posture_of_others: Array
    """M_oc M_cc^-1 posture."""
    near_singular: Array
    """Whether L or L_n is bounded (envs,)."""


def projections(
    k: OSCCoefficients,
    d: TaskDynamics,
    a: Array,
    a_n: Array,
    wrench: Array = None,
    feedforward: Array = None,
    springs: Array = None,
) -> Projections:
    """Return the efforts of the accelerations ``a`` (envs, 6) of the task and ``a_n`` (envs, dof)
    of the posture.

    ``springs`` (envs, dof) is the part a_s of a_n, all of it if None.
    """
    xp = namespace(
        *k,
        *d,
        a,
        a_n,
        wrench,
        feedforward,
    )
    j = d.jacobian
    m = d.mass_matrix
    chain = d.chain
    eye = xp.eye(m.shape[-1], dtype=m.dtype)
    # The other joints apart, with unit inertia.
    m_cc = xp.where((chain[:, None] * chain) > 0, m, eye)
    y = whitened(m_cc, xp.concatenate([xp.swapaxes(j, -1, -2), eye + xp.zeros_like(m)], axis=-1))
    task_inertia, null_inertia, spring_inertia, singular = _inertias(
        k, gram(y[..., :6], y[..., :6]), xp
    )
    # The wrench that accelerates the tool's inertia, less the acceleration of the motion itself.
    f = product(task_inertia, a - d.jacobian_rate)
    f = f if wrench is None else f + wrench
    task = gram(j, f[..., None])[..., 0]

    # Joints outside the chain, such as fingers, are controlled by computed torque.
    a_c = a_n * chain
    a_o = a_n * (1 - chain)
    # The difference is 0 to the bit where neither inertia is bounded.
    held = product(
        spring_inertia - null_inertia, product(j, (a_n if springs is None else springs) * chain)
    )
    null = (
        product(m, a_c)
        - gram(j, (product(null_inertia, product(j, a_c)) + held)[..., None])[..., 0]
    )
    null = null * chain
    base = d.bias + product(m, a_o)
    base = base if feedforward is None else base + feedforward

    # L^-1 of M_cc, from the same factor: two products replace a solution.
    inverse_root = y[..., 6:]

    def of_others(effort: Array) -> Array:
        moved = chain * gram(inverse_root, product(inverse_root, effort)[..., None])[..., 0]
        return (1 - chain) * product(m, moved)

    return Projections(
        f,
        task,
        null,
        base,
        of_others(task),
        of_others(null),
        singular,
    )


def _inertias(
    k: OSCCoefficients, mobility: Array, xp: ArrayModule
) -> tuple[Array, Array, Array, Array]:
    """Return L, L_n and L_s of the mobility A (envs, 6, 6), and where any is bounded."""
    # Without axes of force, task and null space need the same inverse, computed once.
    s0 = k.smallest_eigenvalue[..., 0]
    both = k.axes
    if k.axes is not None and k.force_axes is not None:
        both = xp.maximum(k.axes, k.force_axes)
    null, springs, near = _selected_inverse(mobility, both, xp, s0, SPRING_BOUND * s0)
    if both is k.axes:
        return null, null, springs, near
    task, bounded = _selected_inverse(mobility, k.axes, xp, s0)
    return task, null, springs, near | bounded


def _selected_inverse(
    mobility: Array,
    axes: Any,
    xp: ArrayModule,
    smallest: Array,
    *smooth: Array,
) -> tuple[Array, ...]:
    """Return S^T (S A S^T)^-1 S, for each bound, with the selected ``axes`` (1 | envs, 6), and
    where it is bounded.
    """
    if axes is None:
        return bounded_inverse(mobility, smallest, *smooth)
    both = axes[..., :, None] * axes[..., None, :] > 0
    free = (1 - axes)[..., None] * xp.eye(6, dtype=mobility.dtype)
    # The other axes get an eigenvalue apart from the selected ones, above the bound by more than
    # rounding.
    alone = free * xp.maximum(2 * smallest, 1.0)[..., None, None]
    *inverses, near = bounded_inverse(xp.where(both, mobility, alone), smallest, *smooth)
    return *[xp.where(both, inverse, xp.zeros_like(inverse)) for inverse in inverses], near
