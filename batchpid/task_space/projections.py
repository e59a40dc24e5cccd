"""Inertia of the tool, and the efforts of accelerations of the task and of the posture.

The equations stand in :mod:`batchpid.task_space.operational_space`, with their symbols.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from batchpid.arrays.array_types import Array, ArrayModule
from batchpid.arrays.elementwise import namespace
from batchpid.task_space.osc_coefficients import OSCCoefficients
from batchpid.task_space.osc_state import TaskDynamics
from batchpid.task_space.symmetric import bounded_inverse, gram, product, whitened

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
    # The other axes get an eigenvalue apart from the selected ones, at or above the bound.
    alone = free * xp.maximum(smallest, 1.0)[..., None, None]
    *inverses, near = bounded_inverse(xp.where(both, mobility, alone), smallest, *smooth)
    return *[xp.where(both, inverse, xp.zeros_like(inverse)) for inverse in inverses], near
