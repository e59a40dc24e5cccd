r"""Operational-space control: the tool as decoupled unit masses on springs, pure functions on (envs, ...) arrays.

With the tool's Jacobian J and pose, the mass matrix M and the bias h at present, the joints c of the chain to the tool
and the other joints o, the setpoint's pose, twist V and acceleration V', and the gains kp, kd, ki of the task and kp_n,
kd_n of the posture::

    e     = position and rotation vector from the pose to the setpoint, each shortened to its limit
    a     = kp e + kd (V - J q') + V' + I                       acceleration of the task
    A     = J M_cc^-1 J^T
    L     = (S A S^T)^-1, bounded                               its inertia, in the selected axes S
    F     = L (a - J' q') + wrench                              decoupling "full"; F = a + wrench with "none"
    a_n   = a_s - a_d                                           acceleration of the posture: springs and damping
    a_s   = kp_n (posture - q) + kp_l x
    a_d   = kd_n q' + 2 sqrt(kp_l) q' |x| / margin
    task  = J^T F
    null  = M_cc a_n - J^T (L_s J a_s - L_n J a_d)              = N^T M_cc a_n, with J M_cc^-1 N^T = 0
    u_c   = h + M_co a_o + s1 task + s2 null + feedforward      a_o = a_n of the other joints
    u_o   = h + M_oo a_o + M_oc M_cc^-1 (s1 task + s2 null) + feedforward
    I    <- I + ki dt e, within its limit, unless s1 < 1, u is clipped or L is bounded, and a e > 0

These are the gains of the explicit law; :mod:`batchpid.task_space.osc_coefficients` has the implicit one. Springs of
stiffness kp_l push joints of the chain away from their limits; x is the depth of q in the margin.

The other joints, such as fingers, are controlled by computed torque: in the task they would move with the hand. L_n is
the inertia over the axes of motion and force, with full decoupling. With "partial" the blocks of A between positions
and rotations are left out of L. A bounded inverse turns an eigenvalue s into 1/s, or s/s0^2 below s0: near a
singularity the direction in which the tool cannot move loses its stiffness to the posture, continuously, and the motion
returns from it.

Below its bound an inertia lets the posture into the task. The damping has to enter below s0, where the task loses its
own. The springs would pull the tool off poses that it reaches: at rest its error would be (s0^2/s^2 - 1) (v J a_s) / kp
along the eigenvector v. So L_s has a lower bound s1 = s0/5, below which the springs draw the robot out of the singular
pose: an eigenvalue s turns into 1/s, or s (2 - s^2/s1^2) / s1^2 below s1. The derivative is continuous, since a robot
whose setpoint is out of reach rests just below s1, where a kink would chatter.

Saturation keeps the direction of the motion: s1 in [0, 1] is the largest share of the task with which all joints are
within their limits, and s2 the largest share of the posture in the room that is left. A joint whose u is out of limits
with neither is clipped, and left out of both.

O. Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation",
IEEE Journal on Robotics and Automation 3 (1987).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.elementwise import clip, namespace, wrap
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_law
from batchpid.task_space.frames import in_axes, matrix_of, pose_error
from batchpid.task_space.osc_coefficients import OSCCoefficients, discretise
from batchpid.task_space.osc_params import OSCParams
from batchpid.task_space.osc_state import OSCState, OSCTerms, TaskDynamics, in_tool_axes, task_dynamics
from batchpid.task_space.projections import Projections, projections
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.symmetric import product, quiet
from batchpid.task_space.tree_kinematics import prepared, read_point


def init(params: OSCParams, qpos: Any) -> OSCState:
    """Return the state before the first step: the posture is ``qpos`` (envs, dof) [rad or m], the integral 0."""
    xp = namespace(*params, qpos)
    posture = xp.zeros_like(qpos, dtype=xp.result_type(params.stiffness, qpos)) + qpos
    integral = None if params.integral_gain is None else xp.zeros((len(posture), 6), posture.dtype)
    return OSCState(posture, integral)


def reset(params: OSCParams, state: OSCState, qpos: Any, mask: Any) -> OSCState:
    """Return the state with the envs of ``mask`` (envs,) bool restarted at ``qpos`` (envs, dof)."""
    xp, fresh = namespace(*state, qpos, mask), init(params, qpos)
    chosen = xp.asarray(mask)[:, None]
    return OSCState(
        *[None if old is None else xp.where(chosen, new, old) for new, old in zip(fresh, state, strict=True)]
    )


def step(
    params: OSCParams,
    state: OSCState,
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    dt: Any,
    *,
    tree: RigidTree,
    link: str,
    point: Any = None,
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
) -> tuple[OSCState, Any]:
    """Advance the law by ``dt`` [s]; return the state and the effort.

    Efforts are (envs, dof) [N m or N]. A row does not depend on the others, to the last bit under NumPy; NaN stays in
    its env.

    Parameters
    ----------
    setpoint
        Poses (envs, 7): position [m] and quaternion (w, x, y, z) of any length, in the world.
    qpos, qvel
        (envs, dof) [rad or m, rad/s or m/s].
    tree, link, point
        Robot, and its tool: a point (3,) [m] of a link, default its origin.
    twist, acceleration
        V and V' of the setpoint (envs, 6) [m/s, rad/s, ...], in the axes of the world; None: 0.
    wrench
        Wrench of the tool on its surroundings (envs, 6) [N, N m], in the axes of the params' frame; None: 0.
    feedforward
        Effort added (envs, dof), such as the effort of viscous damping; None: 0.

    Raises
    ------
    InvalidArgumentError
        The link is unknown, an array has a wrong shape, or dt is not positive.
    """
    inputs = {"twist": twist, "acceleration": acceleration, "wrench": wrench, "feedforward": feedforward}
    _check_shapes(params, tree, setpoint, qpos, **inputs)
    k, tool = discretise(params, dt), (tree, link, point)
    if (found := _native_step(k, state, tool, setpoint, qpos, qvel, ("effort",), **inputs)) is not None:
        return found[0], found[1][0]
    return advance(k, state, setpoint, qpos, qvel, task_dynamics(tree, qpos, qvel, link, point=point), **inputs)


def step_terms(
    params: OSCParams,
    state: OSCState,
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    dt: Any,
    *,
    tree: RigidTree,
    link: str,
    point: Any = None,
    **inputs: Any,
) -> tuple[OSCState, OSCTerms]:
    """Advance the law as :func:`step`, with the same arguments; return the state and all terms, effort included."""
    _check_shapes(params, tree, setpoint, qpos, **inputs)
    k, tool = discretise(params, dt), (tree, link, point)
    if (found := _native_step(k, state, tool, setpoint, qpos, qvel, _TERMS, **inputs)) is not None:
        return found[0], _terms(found[1])
    dynamics = task_dynamics(tree, qpos, qvel, link, point=point)
    return advance_terms(k, state, setpoint, qpos, qvel, dynamics, **inputs)


def advance(
    k: OSCCoefficients,
    state: OSCState,
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    dynamics: TaskDynamics,
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
) -> tuple[OSCState, Any]:
    """Advance the law with given coefficients and dynamics, such as an engine's; otherwise as :func:`step`."""
    inputs = setpoint, qpos, qvel, twist, acceleration, wrench, feedforward
    if (found := _native(state, partial(native_law.law, k, dynamics), inputs, ("effort",))) is not None:
        return found[0], found[1][0]
    with quiet():
        sums = _sums(k, state, setpoint, qpos, qvel, dynamics, twist, acceleration, wrench, feedforward)
        effort, whole, *_ = _saturated(*sums.parts)
        return _integrated(k, state, sums, effort != whole), effort


def advance_terms(
    k: OSCCoefficients,
    state: OSCState,
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    dynamics: TaskDynamics,
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
) -> tuple[OSCState, OSCTerms]:
    """Advance the law as :func:`advance`, with the same arguments; return the state and all terms, effort included."""
    inputs = setpoint, qpos, qvel, twist, acceleration, wrench, feedforward
    if (found := _native(state, partial(native_law.law, k, dynamics), inputs, _TERMS)) is not None:
        return found[0], _terms(found[1])
    with quiet():
        sums = _sums(k, state, setpoint, qpos, qvel, dynamics, twist, acceleration, wrench, feedforward)
        effort, whole, s1, s2 = _saturated(*sums.parts)
        state = _integrated(k, state, sums, effort != whole)
    p = sums.projections
    shares = s1[..., 0], s2[..., 0]
    return state, OSCTerms(sums.task.error, p.force, p.task, p.posture, whole, effort, *shares, p.near_singular)


_TERMS = (
    *("error", "force", "task", "posture_effort", "unsaturated", "effort"),
    *("task_share", "posture_share", "near_singular"),
)


def _terms(results: list[Any]) -> OSCTerms:
    """Return the terms of the results _TERMS of native code."""
    *arrays, s1, s2, near = results
    return OSCTerms._make([*arrays, s1[:, 0], s2[:, 0], near[:, 0] > 0])


def _native_step(
    k: OSCCoefficients,
    state: OSCState,
    tool: tuple[RigidTree, str, Any],
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    wanted: tuple[str, ...],
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
) -> tuple[OSCState, list[Any]] | None:
    """Return the results of :func:`_native` with the dynamics of a tree, computed in the same call."""
    tree, link, point = tool
    (q, v), _, _ = prepared(tree, qpos=qpos, qvel=qvel)
    native = partial(native_law.step, tree, link, read_point(q, point), k)
    return _native(state, native, (setpoint, q, v, twist, acceleration, wrench, feedforward), wanted)


def _native(
    state: OSCState,
    native: Callable[[tuple[Any, ...], tuple[str, ...]], list[Any] | None],
    inputs: tuple[Any, ...],
    wanted: tuple[str, ...],
) -> tuple[OSCState, list[Any]] | None:
    """Return the state after a step in native code and the results ``wanted``; None where native code is not used."""
    arrays, wanted = (*inputs, None, None, *state), wanted if state.integral is None else (*wanted, "next_integral")
    if (found := native(arrays, wanted)) is None:
        return None
    return (state, found) if state.integral is None else (state._replace(integral=found.pop()), found)


class _Motion(NamedTuple):
    """Vectors (envs, 6) in the axes of the params' frame."""

    near: Any
    """Error with limited norms."""
    tool_twist: Any
    """J q'."""
    twist: Any
    acceleration: Any


class Task(NamedTuple):
    """Error and motion of the tool, in the axes of the params' frame."""

    dynamics: TaskDynamics
    error: Any
    """(envs, 6)"""
    motion: _Motion


def in_frame(
    k: OSCCoefficients, d: TaskDynamics, setpoint: Any, v: Any, twist: Any, acceleration: Any, xp: Any
) -> Task:
    """Return the dynamics, error and motion in the axes of the params' frame."""
    error, near, tool_twist = _errors(k, d, setpoint, v, xp)
    vectors: tuple[Any, ...] = (error, near, tool_twist, twist, acceleration)
    if k.frame is not None:
        turn = matrix_of(d.pose[..., 3:])
        vectors = tuple([None if x is None else in_axes(turn, x[..., None])[..., 0] for x in vectors])
        d = in_tool_axes(d)
    return Task(d, vectors[0], _Motion(*vectors[1:]))


class _Sums(NamedTuple):
    """Efforts before saturation."""

    task: Task
    a: Any
    """Acceleration of the task (envs, 6)."""
    projections: Projections
    parts: tuple[Any, ...]
    """Arguments of :func:`_saturated`."""


def _sums(
    k: OSCCoefficients,
    state: OSCState,
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    dynamics: TaskDynamics,
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
) -> _Sums:
    """Return the efforts of task and posture before saturation."""
    xp = namespace(*k, *state, *dynamics, setpoint, qpos, qvel, twist, acceleration, wrench, feedforward)
    task = in_frame(k, dynamics, setpoint, qvel, twist, acceleration, xp)
    a = _accelerations(k.kp, k.kd, k.c, k.acceleration_share, *task.motion, state.integral)
    a_n, a_s = posture_acceleration(k, dynamics, state.posture, qpos, qvel)
    p = projections(k, task.dynamics, a, a_n, wrench, feedforward, a_s)
    parts = p.base, p.task, p.posture, p.task_of_others, p.posture_of_others, k.effort_min, k.effort_max
    return _Sums(task, a, p, parts)


def _integrated(k: OSCCoefficients, state: OSCState, sums: _Sums, clipped: Any) -> OSCState:
    """Return the state after the step; the integral of an env with ``clipped`` efforts (envs, dof) does not grow."""
    if state.integral is None:
        return state
    motion, held = sums.task.motion, (sums.projections.near_singular | clipped.any(-1))[:, None]
    xp = namespace(state.integral, motion.near)
    new = state.integral + k.ki_dt * motion.near
    if k.ki_dt2 is not None and motion.twist is not None:
        new = new - k.ki_dt2 * motion.twist
    new = clip(new, -k.integral_limit, k.integral_limit, xp)
    return state._replace(integral=xp.where(held & (sums.a * motion.near > 0), state.integral, new))


def _check_shapes(
    params: OSCParams,
    tree: RigidTree,
    setpoint: Any,
    qpos: Any,
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
) -> None:
    """Raise InvalidArgumentError for an array that is not (envs, size), and for params of other envs."""
    envs = np.shape(qpos)[0]
    arrays = {
        "setpoint": (setpoint, 7),
        "twist": (twist, 6),
        "acceleration": (acceleration, 6),
        "wrench": (wrench, 6),
        "feedforward": (feedforward, tree.dof),
    }
    for name, (value, size) in arrays.items():
        if value is None:
            continue
        shape = value.shape if hasattr(value, "shape") else np.shape(value)
        if shape not in ((envs, size), (1, size)):
            problem = f"has shape {shape}, not ({envs}, {size})"
            raise InvalidArgumentError(name, problem, remedy="give one row for each env")
    for name, leaf in zip(params._fields, params, strict=True):
        if hasattr(leaf, "shape") and leaf.shape[0] not in (1, envs):
            problem = f"has rows for {leaf.shape[0]} envs, but qpos for {envs}"
            raise InvalidArgumentError(f"params.{name}", problem, remedy="make params for these envs")


def _errors(k: OSCCoefficients, d: TaskDynamics, setpoint: Any, v: Any, xp: Any) -> Any:
    """Return the error (envs, 6), the same with limited norms, and the twist of the tool J q', in the world."""
    limits = k.position_error_limit, k.rotation_error_limit
    error = pose_error(setpoint, d.pose)
    near = [_shortened(part, limit, xp) for part, limit in zip((error[..., :3], error[..., 3:]), limits, strict=True)]
    return error, xp.concatenate(near, axis=-1), product(d.jacobian, v)


def _shortened(vector: Any, limit: Any, xp: Any) -> Any:
    """Return vectors (envs, 3), at most ``limit`` (1 | envs, 1) long."""
    length = xp.sqrt((vector * vector).sum(-1, keepdims=True))
    long = length > limit
    return vector * xp.where(long, limit / xp.where(long, length, 1.0), 1.0)


def _accelerations(kp: Any, kd: Any, c: Any, share: Any, e: Any, v: Any, twist: Any, given: Any, i: Any) -> Any:
    """Return a (envs, 6)."""
    a = kp * e - kd * v
    a = a if twist is None else a + c * twist
    a = a if given is None else a + share * given
    return a if i is None else a + i


def posture_acceleration(k: OSCCoefficients, d: TaskDynamics, posture: Any, q: Any, v: Any) -> tuple[Any, Any]:
    """Return a_n and its part a_s (envs, dof)."""
    xp = namespace(posture, q, v)
    springs = k.posture_kp * wrap(posture - q, k.turns, xp)
    a = springs - k.posture_kd * v
    if k.limit_kp is None:
        return a, springs
    depth = xp.maximum(k.limit_low - q, 0.0) - xp.maximum(q - k.limit_high, 0.0)
    pushed = k.limit_kp * depth
    return a + d.chain * (pushed - k.limit_kd * v * xp.abs(depth) / k.limit_margin), springs + d.chain * pushed


def _saturated(
    base: Any, task: Any, null: Any, task_of_others: Any, null_of_others: Any, low: Any, high: Any
) -> tuple[Any, ...]:
    """Return the efforts after and before saturation, s1 and s2, all (envs, dof)."""
    xp = namespace(base, task, null, task_of_others, null_of_others, low, high)
    least, most = -math.inf if low is None else low, math.inf if high is None else high
    able = (base >= least) & (base <= most)

    def share(effort: Any, at: Any) -> Any:
        room = xp.maximum(xp.where(effort > 0, most - at, at - least), 0.0)
        size = xp.abs(effort)
        limited = able & (size > room)
        return xp.where(limited, room / xp.where(limited, size, 1.0), 1.0).min(axis=-1, keepdims=True)

    s1 = share(task, base)
    s2 = share(null, base + s1 * task)
    others = s1 * task_of_others + s2 * null_of_others
    effort = clip(base + s1 * task + s2 * null + others, low, high, xp)
    return effort, base + task + null + others, s1, s2
