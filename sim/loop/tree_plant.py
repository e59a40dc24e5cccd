r"""Rigid tree on a fixed base as a plant, in pure functions for NumPy and JAX: MuJoCo's motion without
contact.

With mass matrix M, armature A, damping B, bias h and the effort u of motors and friction, semi-implicit
Euler steps follow from::

    (M + A + dt B) a = u - h        v <- v + dt a        q <- q + dt v

MuJoCo makes joint limits soft: it minimizes the sum of (a - a_free)^T M (a - a_free) / 2 and D_j
min(0, s_j a_j - r_j)^2 / 2 over the joints beyond a limit ("Computation" in MuJoCo's
documentation). Newton steps on the set of active limits find the minimum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.elementwise import namespace
from batchpid.motors.coupling import Coupling
from batchpid.task_space.rigid_tree import Bodies, RigidTree
from batchpid.task_space.tree_quantities import evaluated

DYNAMICS = ("mass_matrix", "bias")
TURNS = 4
"""Newton steps on the active limits: more sets than a robot changes in a time step."""
IMPEDANCE = (0.99, 0.999, 1e-4)
"""Least and largest impedance of a limit, and the depth at which it is largest [rad or m]: the first
three numbers of MuJoCo's ``solimp``.
"""


@dataclass(frozen=True)
class TreePlant:
    """Rigid tree with ``inertia``: A + dt B (1 | envs, dof). Its state is (qpos, qvel)."""

    tree: RigidTree
    bodies: Bodies
    inertia: Array
    coupling: Coupling
    low: Float64
    high: Float64
    """Limits (dof,) [rad or m]."""
    weight: Float64
    """Diagonal of M^-1 at the pose 0 (dof,): MuJoCo's ``dof_invweight0``."""
    timestep: float

    def init(self, qpos: Array, qvel: Array) -> tuple[Array, Array]:
        """Return the state of robots at ``qpos`` and ``qvel`` (envs, dof)."""
        return self.coupling.positions(qpos), self.coupling.rates(qvel)

    def read(self, state: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return positions and velocities (envs, dof)."""
        return state

    def step(
        self,
        state: tuple[Array, Array],
        effort: Array,
        nominal: Mapping[str, Array] | None = None,
    ) -> tuple[Array, Array]:
        """Return the state after a time step under ``effort`` (envs, dof) [N m or N].

        ``nominal`` are the mass matrix and the bias of the tree at the state, if they are known.
        """
        qpos, qvel = state
        if nominal is None or self.bodies is not self.tree.bodies:
            nominal = evaluated(self.tree, DYNAMICS, qpos, qvel, bodies=self.bodies)
        matrix, bias = nominal["mass_matrix"], nominal["bias"]
        xp = namespace(matrix)
        eye = xp.eye(matrix.shape[-1], dtype=matrix.dtype)
        matrix = matrix + self.inertia[..., None] * eye
        # Followers move with their leaders: the equations are those of the leaders.
        matrix = self.coupling.mass_matrix(matrix)
        effort = self.coupling.efforts(effort - bias)
        acceleration = self._acceleration(matrix, effort, qpos, qvel, xp)
        qvel = self.coupling.rates(qvel + self.timestep * acceleration)
        return self.coupling.positions(qpos + self.timestep * qvel), qvel

    def _acceleration(
        self,
        matrix: Array,
        effort: Array,
        qpos: Array,
        qvel: Array,
        xp: Any,
    ) -> Array:
        """Return the accelerations (envs, dof) with the active joint limits."""
        below, above = qpos - self.low, self.high - qpos
        sign = (below < 0).astype(qpos.dtype) - (above < 0).astype(qpos.dtype)
        if xp is not np:
            from jax import lax
        least, most, width = IMPEDANCE
        distance = xp.where(sign > 0, below, xp.where(sign < 0, above, 0.0))
        x = abs(distance) / width
        curve = xp.where(x > 0.5, 1.0 - 2.0 * (1.0 - x) ** 2, 2.0 * x * x)
        impedance = xp.where(x < 1.0, least + curve * (most - least), most)
        cost = impedance / ((1.0 - impedance) * self.weight)
        time = 2 * self.timestep  # constant of the limits: MuJoCo's solref
        stiffness, rate_gain = (most * time) ** -2.0, 2.0 / (most * time)
        push = sign * (-rate_gain * sign * qvel - stiffness * impedance * distance)
        eye = xp.eye(matrix.shape[-1], dtype=matrix.dtype)

        def solution(active: Array, system: Any) -> Array:
            matrix, effort, cost, push = system
            pulled = xp.where(active, cost, 0.0)
            return _solved(matrix + pulled[..., None] * eye, effort + pulled * push, xp)

        # The set of limits has no derivative, so a loop of unknown length may find it.
        system = matrix, effort, cost, push
        fixed = system if xp is np else lax.stop_gradient(system)

        def turn(carry: Any) -> Any:
            turns, active, _ = carry
            held = sign * (solution(active, fixed) - fixed[3]) < 0
            return turns + 1, held, (held != active).any()

        def changes(carry: Any) -> Any:
            return carry[2] & (carry[0] < TURNS)

        carry = 0, sign != 0, (sign != 0).any()
        if xp is not np:
            carry = lax.while_loop(changes, turn, carry)
        while xp is np and changes(carry):
            carry = turn(carry)
        return solution(carry[1], system)


def _solved(matrix: Array, right: Array, xp: Any) -> Array:
    """Return the solutions (envs, dof) of positive definite systems."""
    if xp is np:
        solution: Array = np.linalg.solve(matrix, right[..., None])[..., 0]
        return solution
    from jax.lax import linalg

    # The mass matrix is symmetric.
    factor = linalg.cholesky(matrix, symmetrize_input=False)
    solved = right[..., None]
    for transposed in (False, True):
        solved = linalg.triangular_solve(
            factor,
            solved,
            left_side=True,
            lower=True,
            transpose_a=transposed,
        )
    return solved[..., 0]
