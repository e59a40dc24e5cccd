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
    I    <- I + ki dt e, within its limit, unless s1 < 1 or s2 < 1, u is clipped or L is bounded, and a e > 0

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
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import clip, in_dtype_of, namespace, wrap
from batchpid.checks import instance
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_rows
from batchpid.task_space.frames import in_axes, matrix_of, pose_error
from batchpid.task_space.osc_params import MAKE_PARAMS, OSCParams
from batchpid.task_space.osc_state import (
    OSCCoefficients,
    OSCInputs,
    OSCState,
    OSCTerms,
    TaskDynamics,
    Tool,
)
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.symmetric import bounded_inverses, gram, product, quiet, whitened
from batchpid.task_space.tree_quantities import evaluated

SPRING_BOUND = 0.2
"""Bound s1 of L_s, as a share of the bound s0 of L_n."""


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


def task_dynamics(
    tree: RigidTree,
    qpos: Array,
    qvel: Array,
    link: str,
    *,
    point: Array = None,
    bias: Array = None,
) -> TaskDynamics:
    """Return the dynamics of ``tree`` with a tool: a ``point`` (3,) [m] of ``link``, default its
    origin.

    ``qpos`` and ``qvel`` are (envs, dof). A ``bias`` (envs, dof), such as an engine's, takes the
    place of the tree's.

    Raises
    ------
    InvalidArgumentError
        The link is unknown, or a shape is wrong.
    """
    names: tuple[str, ...] = ("pose", "jacobian", "jacobian_rate", "mass_matrix")
    if bias is None:
        names = (*names, "bias")
    results = evaluated(
        tree,
        names,
        qpos,
        qvel,
        link,
        point,
    )
    xp = namespace(results["pose"])
    chain = xp.asarray(tree.chain(link), dtype=results["pose"].dtype)
    return TaskDynamics(**{"bias": bias, "chain": chain, **results})


def osc(
    k: OSCCoefficients,
    state: OSCState,
    dynamics: TaskDynamics | Tool,
    inputs: OSCInputs,
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

    Raises
    ------
    InvalidArgumentError
        The link of the tool is unknown, or an array has a wrong shape.
    """
    try:
        results = native_rows.law(k, state, dynamics, inputs)
    except ValueError:
        _check_shapes(k, inputs)
        raise
    if results is not None:
        return results
    _check_shapes(k, inputs)
    inputs = OSCInputs(*in_dtype_of(k, *inputs))
    if isinstance(dynamics, Tool):
        dynamics = task_dynamics(dynamics.tree, *inputs[1:3], dynamics.link, point=dynamics.point)
    with quiet():
        return _advance(k, state, dynamics, inputs)


def _check_shapes(k: OSCCoefficients, inputs: OSCInputs) -> None:
    """Raise InvalidArgumentError for an input that is not (envs, size), and for coefficients of
    other envs.
    """
    shape = np.shape(inputs.qpos)
    remedy = "give one row for each env"
    if len(shape) != 2:
        raise InvalidArgumentError("qpos", f"has shape {shape}, not (envs, dof)", remedy=remedy)
    envs, dof = shape
    for name, value, size in zip(inputs._fields, inputs, (7, dof, dof, 6, 6, 6, dof), strict=True):
        if value is not None and np.shape(value) not in ((envs, size), (1, size)):
            problem = f"has shape {np.shape(value)}, not ({envs}, {size})"
            raise InvalidArgumentError(name, problem, remedy=remedy)
    for name, leaf in zip(k._fields, k[:-1], strict=False):
        if leaf is not None and leaf.shape[0] not in (1, envs):
            problem = f"has rows for {leaf.shape[0]} envs, but qpos for {envs}"
            raise InvalidArgumentError(f"k.{name}", problem, remedy="make params for these envs")


def _advance(
    k: OSCCoefficients,
    state: OSCState,
    d: TaskDynamics,
    inputs: OSCInputs,
) -> tuple[OSCState, OSCTerms]:
    """Return the results of :func:`osc` by the equations."""
    xp = namespace(*k, *d, *inputs)
    chain = d.chain
    m = d.mass_matrix
    j = d.jacobian
    # Error and motion of the tool, in the axes in which the gains are given.
    vectors: list[Array] = [
        pose_error(inputs.setpoint, d.pose),
        product(j, inputs.qvel),
        d.jacobian_rate,
        inputs.twist,
        inputs.acceleration,
    ]
    if k.frame is not None:
        turn = matrix_of(d.pose[..., 3:])
        j = in_axes(turn, j)
        vectors = [None if x is None else in_axes(turn, x[..., None])[..., 0] for x in vectors]
    error, tool_twist, rate, twist, acceleration = vectors
    # Position and rotation have separate limits: a far target leaves the turn as it is.
    position = _shortened(error[..., :3], k.position_error_limit, xp)
    rotation = _shortened(error[..., 3:], k.rotation_error_limit, xp)
    near = xp.concatenate([position, rotation], axis=-1)
    # Accelerations of task and posture.
    a = k.kp * near - k.kd * tool_twist
    a = a if twist is None else a + k.c * twist
    a = a if acceleration is None else a + k.acceleration_share * acceleration
    a = a if state.integral is None else a + state.integral
    springs, damping = _posture(k, d, state.posture, inputs)
    # Inertias, with unit inertia of the joints outside of the chain.
    eye = xp.zeros_like(m) + xp.eye(m.shape[-1], dtype=m.dtype)
    m_cc = xp.where(chain[:, None] * chain > 0, m, eye)
    y = whitened(m_cc, xp.concatenate([xp.swapaxes(j, -1, -2), eye], axis=-1))
    inverse = gram(y[..., 6:], y[..., 6:])
    task_inertia, null_inertia, spring_inertia, near_singular = _inertias(
        k, gram(y[..., :6], y[..., :6]), xp
    )
    # The wrench that accelerates the tool's inertia, less the acceleration of the motion itself.
    force = product(task_inertia, a - rate)
    force = force if inputs.wrench is None else force + inputs.wrench
    task = gram(j, force[..., None])[..., 0]
    pull = product(spring_inertia, product(j, springs)) - product(null_inertia, product(j, damping))
    a_n = springs - damping
    null = chain * (product(m, chain * a_n) - gram(j, pull[..., None])[..., 0])
    base = d.bias + product(m, (1 - chain) * a_n)
    base = base if inputs.feedforward is None else base + inputs.feedforward

    # Within the effort limits the task comes first, the posture second.
    low = -math.inf if k.effort_min is None else k.effort_min
    high = math.inf if k.effort_max is None else k.effort_max
    able = (base >= low) & (base <= high)

    def share(effort: Array, at: Array) -> Array:
        room = xp.maximum(xp.where(effort > 0, high - at, at - low), 0.0)
        size = xp.abs(effort)
        limited = able & (size > room)
        shares = xp.where(limited, room / xp.where(limited, size, 1.0), 1.0)
        return shares.min(axis=-1, keepdims=True)

    s1 = share(task, base)
    s2 = share(null, base + s1 * task)
    # The other joints hold against the acceleration of the chain.
    within = s1 * task + s2 * null
    others = (1 - chain) * product(m, product(inverse, within))
    effort = clip(base + within + others, low, high, xp)
    whole = base + (task + null) + others
    if state.integral is not None:
        integral = state.integral + k.ki_dt * near
        if k.ki_dt2 is not None and twist is not None:
            integral = integral - k.ki_dt2 * twist
        integral = clip(integral, -k.integral_limit, k.integral_limit, xp)
        held = (near_singular | (effort != whole).any(-1))[:, None] & (a * near > 0)
        state = state._replace(integral=xp.where(held, state.integral, integral))
    return state, OSCTerms(
        error,
        force,
        task,
        null,
        whole,
        effort,
        s1[..., 0],
        s2[..., 0],
        near_singular,
    )


def _shortened(vector: Array, limit: Array, xp: ArrayModule) -> Array:
    """Return vectors (envs, 3), at most ``limit`` (1 | envs, 1) long."""
    length = xp.sqrt((vector * vector).sum(-1, keepdims=True))
    long = length > limit
    return vector * xp.where(long, limit / xp.where(long, length, 1.0), 1.0)


def _posture(
    k: OSCCoefficients,
    d: TaskDynamics,
    posture: Array,
    inputs: OSCInputs,
) -> tuple[Array, Array]:
    """Return a_s and a_d (envs, dof)."""
    _, q, v, *_ = inputs
    xp = namespace(posture, q, v)
    springs = k.posture_kp * wrap(posture - q, k.turns, xp)
    damping = k.posture_kd * v
    if k.limit_kp is None:
        return springs, damping
    # Positive below the lower margin, negative above the upper one.
    depth = xp.maximum(k.limit_low - q, 0.0) - xp.maximum(q - k.limit_high, 0.0)
    return (
        springs + d.chain * (k.limit_kp * depth),
        damping + d.chain * (k.limit_kd * v * xp.abs(depth)),
    )


def _inertias(
    k: OSCCoefficients, mobility: Array, xp: ArrayModule
) -> tuple[Array, Array, Array, Array]:
    """Return L, L_n and L_s of the mobility A (envs, 6, 6), and where any is bounded."""
    # Without axes of force, task and null space need the same inverse, computed once.
    both = k.axes
    if k.axes is not None and k.force_axes is not None:
        both = xp.maximum(k.axes, k.force_axes)
    null, springs, near = _selected_inverses(k, mobility, both, xp)
    if both is k.axes:
        return null, null, springs, near
    task, _, bounded = _selected_inverses(k, mobility, k.axes, xp)
    return task, null, springs, near | bounded


def _selected_inverses(
    k: OSCCoefficients,
    mobility: Array,
    axes: Any,
    xp: ArrayModule,
) -> tuple[Array, Array, Array]:
    """Return S^T (S A S^T)^-1 S for the bounds s0 and s1, with the selected ``axes`` (1 | envs, 6),
    and where it is bounded.
    """
    s0 = k.smallest_eigenvalue[..., 0]
    if axes is None:
        return bounded_inverses(mobility, s0, SPRING_BOUND * s0)
    both = axes[..., :, None] * axes[..., None, :] > 0
    # The other axes get an eigenvalue apart from the selected ones, above the bound by more than
    # rounding.
    free = (1 - axes)[..., None] * xp.eye(6, dtype=mobility.dtype)
    alone = free * xp.maximum(2 * s0, 1.0)[..., None, None]
    first, second, near = bounded_inverses(xp.where(both, mobility, alone), s0, SPRING_BOUND * s0)
    return xp.where(both, first, 0.0), xp.where(both, second, 0.0), near
