r"""Operational-space control: the tool as decoupled unit masses on springs, pure functions on (envs, ...) arrays.

With the tool's Jacobian J and pose, the mass matrix M and the bias h at present, the joints c of the chain to the tool
and the other joints o, the setpoint's pose, twist V and acceleration V', and the gains kp, kd of the task and kp_n,
kd_n of the posture::

    e     = position and rotation vector from the pose to the setpoint, each shortened to its limit
    a     = kp e + kd (V - J q') + V'                           acceleration of the task
    A     = J M_cc^-1 J^T
    L     = (S A S^T)^-1, bounded                               its inertia, in the selected axes S
    F     = L (a - J' q') + wrench                              decoupling "full"; F = a + wrench with "none"
    a_n   = kp_n (posture - q) - kd_n q'                        acceleration of the posture
    task  = J^T F
    null  = M_cc a_n - J^T L_n J a_n                            = N^T M_cc a_n, with J M_cc^-1 N^T = 0
    u_c   = h + M_co a_o + s1 task + s2 null + feedforward      a_o = a_n of the other joints
    u_o   = h + M_oo a_o + M_oc M_cc^-1 (s1 task + s2 null) + feedforward

The other joints, such as fingers, are controlled by computed torque: in the task they would move with the hand. L_n is
the inertia over the axes of motion and force, with full decoupling. With "partial" the blocks of A between positions
and rotations are left out of L. A bounded inverse turns an eigenvalue s into 1/s, or s/s0^2 below s0: near a
singularity the direction in which the tool cannot move loses its stiffness to the posture, continuously, and the motion
returns from it.

Saturation keeps the direction of the motion: s1 in [0, 1] is the largest share of the task with which all joints are
within their limits, and s2 the largest share of the posture in the room that is left. A joint whose u is out of limits
with neither is clipped, and left out of both.

O. Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation",
IEEE Journal on Robotics and Automation 3 (1987).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from batchpid.arrays.elementwise import clip, namespace
from batchpid.errors import InvalidArgumentError
from batchpid.task_space import native_rows
from batchpid.task_space.frames import in_axes, matrix_of, pose_error
from batchpid.task_space.kinematic_tree import KinematicTree
from batchpid.task_space.native_rows import elementwise
from batchpid.task_space.osc_params import OSCParams
from batchpid.task_space.osc_state import OSCState, OSCTerms, TaskDynamics, in_tool_axes, task_dynamics
from batchpid.task_space.projections import projections
from batchpid.task_space.symmetric import product, quiet


def init(params: OSCParams, qpos: Any) -> OSCState:
    """Return the state before the first step: the posture is ``qpos`` (envs, dof) [rad or m]."""
    xp = namespace(*params, qpos)
    return OSCState(posture=xp.zeros_like(qpos, dtype=xp.result_type(params.stiffness, qpos)) + qpos)


def reset(params: OSCParams, state: OSCState, qpos: Any, mask: Any) -> OSCState:
    """Return the state with the envs of ``mask`` (envs,) bool restarted at ``qpos`` (envs, dof)."""
    xp = namespace(*state, qpos, mask)
    return OSCState(posture=xp.where(xp.asarray(mask)[:, None], init(params, qpos).posture, state.posture))


def step(
    params: OSCParams,
    state: OSCState,
    tree: KinematicTree,
    link: str,
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    *,
    point: Any = None,
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
    terms: bool = False,
) -> Any:
    """Compute the efforts (envs, dof) [N m or N]; return ``(state, effort)``, with ``terms`` also :class:`OSCTerms`.

    A row does not depend on the others, to the last bit under NumPy; NaN stays in its env.

    Parameters
    ----------
    link, point
        Tool: a point (3,) [m] of a link, default its origin.
    setpoint
        Poses (envs, 7): position [m] and quaternion (w, x, y, z) of any length, in the world.
    qpos, qvel
        (envs, dof) [rad or m, rad/s or m/s].
    twist, acceleration
        V and V' of the setpoint (envs, 6) [m/s, rad/s, ...], in the axes of the world; None: 0.
    wrench
        Wrench of the tool on its surroundings (envs, 6) [N, N m], in the axes of the params' frame; None: 0.
    feedforward
        Effort added (envs, dof), such as the effort of viscous damping; None: 0.

    Raises
    ------
    InvalidArgumentError
        The link is unknown, or an array has a wrong shape.
    """
    setpoints = {
        "setpoint": (setpoint, 7),
        "twist": (twist, 6),
        "acceleration": (acceleration, 6),
        "wrench": (wrench, 6),
    }
    _check_shapes(params, setpoints | {"feedforward": (feedforward, tree.dof)}, qpos)
    dynamics = task_dynamics(tree, qpos, qvel, link, point=point)
    return advance(params, state, dynamics, setpoint, qpos, qvel, twist, acceleration, wrench, feedforward, terms=terms)


def advance(
    params: OSCParams,
    state: OSCState,
    dynamics: TaskDynamics,
    setpoint: Any,
    qpos: Any,
    qvel: Any,
    twist: Any = None,
    acceleration: Any = None,
    wrench: Any = None,
    feedforward: Any = None,
    *,
    terms: bool = False,
) -> Any:
    """Compute the efforts with given dynamics, such as an engine's; otherwise as :func:`step`."""
    with quiet():
        return _advance(params, state, dynamics, setpoint, qpos, qvel, twist, acceleration, wrench, feedforward, terms)


def _check_shapes(params: OSCParams, arrays: dict[str, tuple[Any, int]], qpos: Any) -> None:
    """Raise InvalidArgumentError for an array that is not (envs, size), and for params of other envs."""
    envs = np.shape(qpos)[0]
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


def _advance(
    k: OSCParams,
    state: OSCState,
    d: TaskDynamics,
    setpoint: Any,
    q: Any,
    v: Any,
    twist: Any,
    acceleration: Any,
    wrench: Any,
    feedforward: Any,
    terms: bool,
) -> Any:
    xp = namespace(*k, *state, *d, setpoint, q, v, twist, acceleration, wrench, feedforward)
    error, near, tool_twist = _errors(k, d, setpoint, v, xp)
    rate = -tool_twist if twist is None else twist - tool_twist
    if k.frame is not None:
        turn = matrix_of(d.pose[..., 3:])
        error, near, rate, acceleration = (
            None if x is None else in_axes(turn, x[..., None])[..., 0] for x in (error, near, rate, acceleration)
        )
        d = in_tool_axes(d)
    (a,) = elementwise(_accelerations, k.stiffness, k.damping, near, rate, acceleration)
    (a_n,) = elementwise(_posture_accelerations, k.posture_stiffness, k.posture_damping, state.posture, q, v)
    p = projections(k, d, a, a_n, wrench, feedforward)
    parts = p.base, p.task, p.posture, p.task_of_others, p.posture_of_others, k.effort_min, k.effort_max
    if not terms:
        return state, elementwise(_effort, *parts)[0]
    effort, whole, s1, s2 = elementwise(_saturated, *parts)
    return (
        state,
        effort,
        OSCTerms(error, p.force, p.task, p.posture, whole, effort.copy(), s1[..., 0], s2[..., 0], p.near_singular),
    )


def _errors(k: OSCParams, d: TaskDynamics, setpoint: Any, v: Any, xp: Any) -> Any:
    """Return the error (envs, 6), the same with limited norms, and the twist of the tool J q', in the world."""
    limits = k.position_error_limit, k.rotation_error_limit
    found = native_rows.errors(setpoint, d.pose, limits, d.jacobian, v)
    if found is not None:
        return found
    error = pose_error(setpoint, d.pose)
    near = [_shortened(part, limit, xp) for part, limit in zip((error[..., :3], error[..., 3:]), limits, strict=True)]
    return error, xp.concatenate(near, axis=-1), product(d.jacobian, v)


def _shortened(vector: Any, limit: Any, xp: Any) -> Any:
    """Return vectors (envs, 3), at most ``limit`` (1 | envs, 1) long."""
    length = xp.sqrt((vector * vector).sum(-1, keepdims=True))
    long = length > limit
    return vector * xp.where(long, limit / xp.where(long, length, 1.0), 1.0)


def _accelerations(kp: Any, kd: Any, near: Any, rate: Any, acceleration: Any) -> list[Any]:
    """Return a (envs, 6)."""
    a = kp * near + kd * rate
    return [a if acceleration is None else a + acceleration]


def _posture_accelerations(kp: Any, kd: Any, posture: Any, q: Any, v: Any) -> list[Any]:
    """Return a_n (envs, dof)."""
    return [kp * (posture - q) - kd * v]


def _effort(*parts: Any) -> list[Any]:
    return _saturated(*parts)[:1]


def _saturated(
    base: Any, task: Any, null: Any, task_of_others: Any, null_of_others: Any, low: Any, high: Any
) -> list[Any]:
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
    return [effort, base + task + null + others, s1, s2]
