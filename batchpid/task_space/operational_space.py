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
    null  = M_cc a_n - J^T (L_s J a_s - L J a_d)                = N^T M_cc a_n, with J M_cc^-1 N^T = 0
    u_c   = h + M_co a_o + s1 task + s2 null + feedforward      a_o = a_n of the other joints
    u_o   = h + M_oo a_o + M_oc M_cc^-1 (s1 task + s2 null) + feedforward
    I    <- I + ki dt e, within its limit, unless s1 < 1 or s2 < 1, u is clipped or L is bounded, and a e > 0

These are the gains of the explicit law; :mod:`batchpid.task_space.osc_params` has the
implicit one. Springs of stiffness kp_l push joints of the chain away from their limits; x is the
depth of q in the margin.

The other joints, such as fingers, are controlled by computed torque: in the task they would move
with the hand. A bounded inverse turns an eigenvalue s into 1/s, or s/s0^2 below s0: near a
singularity the direction in which the tool cannot move loses its stiffness to the posture,
continuously, and the motion returns from it.

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

import numpy as np

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import clip, in_dtype_of, namespace, wrap
from batchpid.checks import instance
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_rows
from batchpid.task_space.frames import pose_error
from batchpid.task_space.osc_params import OSCParams
from batchpid.task_space.osc_state import (
    OSCInputs,
    OSCState,
    OSCTerms,
    TaskDynamics,
    Tool,
)
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.symmetric import bounded_inverses, gram, product, quiet, whitened
from batchpid.task_space.tree_quantities import evaluated

MAKE_PARAMS = "build them with make_osc_params"
"""Remedy for params of another type."""
SPRING_BOUND = 0.2
"""Bound s1 of L_s, as a share of the bound s0 of L."""


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
    integral = None if params.ki_dt is None else xp.zeros((len(posture), 6), posture.dtype)
    return OSCState(posture, integral)


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
    params: OSCParams,
    state: OSCState,
    dynamics: TaskDynamics | Tool,
    inputs: OSCInputs,
) -> tuple[OSCState, OSCTerms]:
    """Advance the law by the time step of ``params``; return the state and the terms, effort
    included.

    A row does not depend on the others, to the last bit under NumPy; NaN stays in its env.

    Parameters
    ----------
    dynamics
        Dynamics at the present state, such as an engine's, or a tool, with whose tree they are
        computed.

    Raises
    ------
    InvalidArgumentError
        The link of the tool is unknown, or an array has a wrong shape.
    """
    instance("params", params, OSCParams, MAKE_PARAMS)
    try:
        results = native_rows.law(params, state, dynamics, inputs)
    except ValueError:
        _check_shapes(params, inputs)
        raise
    if results is not None:
        return results
    _check_shapes(params, inputs)
    inputs = OSCInputs(*in_dtype_of(params, *inputs))
    if isinstance(dynamics, Tool):
        dynamics = task_dynamics(dynamics.tree, *inputs[1:3], dynamics.link, point=dynamics.point)
    with quiet():
        return _advance(params, state, dynamics, inputs)


def _check_shapes(params: OSCParams, inputs: OSCInputs) -> None:
    """Raise InvalidArgumentError for an input that is not (envs, size), and for params of other
    envs.
    """
    remedy, shape = "give one row for each env", np.shape(inputs.qpos)
    if len(shape) != 2:
        raise InvalidArgumentError("qpos", f"has shape {shape}, not (envs, dof)", remedy=remedy)
    envs, dof = shape
    sizes = dict(zip(inputs._fields, (7, dof, dof, 6, 6, 6, dof), strict=True))
    for name, rows in {**params._asdict(), **inputs._asdict()}.items():
        if rows is not None:
            columns = sizes.get(name, np.shape(rows)[-1])
            if np.shape(rows) not in ((envs, columns), (1, columns)):
                problem = f"has shape {np.shape(rows)}, not ({envs}, {columns})"
                raise InvalidArgumentError(name, problem, remedy=remedy)


def _advance(
    k: OSCParams,
    state: OSCState,
    d: TaskDynamics,
    inputs: OSCInputs,
) -> tuple[OSCState, OSCTerms]:
    """Return the results of :func:`osc` by the equations."""
    xp = namespace(*k, *d, *inputs)
    chain = d.chain
    m = d.mass_matrix
    j = d.jacobian
    error = pose_error(inputs.setpoint, d.pose)
    # Position and rotation have separate limits: a far target leaves the turn as it is.
    position = _shortened(error[..., :3], k.position_error_limit, xp)
    rotation = _shortened(error[..., 3:], k.rotation_error_limit, xp)
    near = xp.concatenate([position, rotation], axis=-1)
    # Accelerations of task and posture.
    a = k.kp * near - k.kd * product(j, inputs.qvel)
    a = a if inputs.twist is None else a + k.c * inputs.twist
    if inputs.acceleration is not None:
        a = a + k.acceleration_share * inputs.acceleration
    a = a if state.integral is None else a + state.integral
    springs = k.posture_kp * wrap(state.posture - inputs.qpos, k.turns, xp)
    damping = k.posture_kd * inputs.qvel
    if k.limit_kp is not None:
        # Positive below the lower margin, negative above the upper one.
        low, high = k.limit_low - inputs.qpos, inputs.qpos - k.limit_high
        depth = chain * (xp.maximum(low, 0.0) - xp.maximum(high, 0.0))
        springs = springs + k.limit_kp * depth
        damping = damping + k.limit_kd * inputs.qvel * xp.abs(depth)
    # Inertias, with unit inertia of the joints outside of the chain.
    eye = xp.zeros_like(m) + xp.eye(m.shape[-1], dtype=m.dtype)
    m_cc = xp.where(chain[:, None] * chain > 0, m, eye)
    y = whitened(m_cc, xp.concatenate([xp.swapaxes(j, -1, -2), eye], axis=-1))
    inverse = gram(y[..., 6:], y[..., 6:])
    inertia, spring_inertia, near_singular = _inertias(k, gram(y[..., :6], y[..., :6]), xp)
    # The wrench that accelerates the tool's inertia, less the acceleration of the motion itself.
    force = product(inertia, a - d.jacobian_rate)
    force = force if inputs.wrench is None else force + inputs.wrench
    task = gram(j, force[..., None])[..., 0]
    pull = product(spring_inertia, product(j, springs)) - product(inertia, product(j, damping))
    a_n = springs - damping
    null = chain * (product(m, chain * a_n) - gram(j, pull[..., None])[..., 0])
    base = d.bias + product(m, (1 - chain) * a_n)
    base = base if inputs.feedforward is None else base + inputs.feedforward

    # Within the effort limits the task comes first, the posture second.
    limit = math.inf if k.effort_limit is None else k.effort_limit
    able = xp.abs(base) <= limit

    def share(effort: Array, at: Array) -> Array:
        room = xp.maximum(xp.where(effort > 0, limit - at, at + limit), 0.0)
        size = xp.abs(effort)
        limited = able & (size > room)
        shares = xp.where(limited, room / xp.where(limited, size, 1.0), 1.0)
        return shares.min(axis=-1, keepdims=True)

    s1 = share(task, base)
    s2 = share(null, base + s1 * task)
    # The other joints hold against the acceleration of the chain.
    within = s1 * task + s2 * null
    others = (1 - chain) * product(m, product(inverse, within))
    effort = clip(base + within + others, -limit, limit, xp)
    whole = base + (task + null) + others
    if state.integral is not None:
        integral = state.integral + k.ki_dt * near
        integral = integral if inputs.twist is None else integral - k.ki_dt2 * inputs.twist
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


def _inertias(k: OSCParams, mobility: Array, xp: ArrayModule) -> tuple[Array, Array, Array]:
    """Return L = S^T (S A S^T)^-1 S and L_s of the mobility A (envs, 6, 6), with the bounds s0 and
    s1, and where they are bounded.
    """
    s0 = k.smallest_eigenvalue[..., 0]
    if k.axes is None:
        return bounded_inverses(mobility, s0, SPRING_BOUND * s0)
    both = k.axes[..., :, None] * k.axes[..., None, :] > 0
    # The other axes get an eigenvalue apart from the selected ones, above the bound by more than
    # rounding.
    free = (1 - k.axes)[..., None] * xp.eye(6, dtype=mobility.dtype)
    alone = free * xp.maximum(2 * s0, 1.0)[..., None, None]
    first, second, near = bounded_inverses(xp.where(both, mobility, alone), s0, SPRING_BOUND * s0)
    return xp.where(both, first, 0.0), xp.where(both, second, 0.0), near
