"""Law of the control "pid" in a sim step: pure functions of arrays (envs, dof), for NumPy and
JAX.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import batchpid as bp
from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace
from batchpid.law.coefficients import Coefficients
from batchpid.law.computed_torque import advance_with_mass_matrix

MASS_MATRIX_STEPS = 4
"""Sim steps for which a mass matrix is kept within a tick.

The implicit law takes a fresh one in each: in setpoint steps at w dt = 1 panda diverges with a
matrix kept for 4 steps, at w dt = 3 with one kept for 2.
"""


class PIDLaw(NamedTuple):
    """Variants of the law that the params select."""

    uses_mass_matrix: bool
    """Gains per mass matrix: u = M a."""
    measures_rate: bool
    """The derivative term takes the measured velocity."""
    implicit: bool
    """P, I and D act on the end of the step."""

    @classmethod
    def of(cls, params: bp.PIDParams) -> PIDLaw:
        """Return the law that ``params`` select."""
        choices = params.gain_units, params.measurement_rate, params.discretization
        return cls(*(choice is not None for choice in choices))

    @property
    def matrix_steps(self) -> int:
        """Sim steps for which a mass matrix is kept within a tick."""
        if self.implicit:
            return 1
        return MASS_MATRIX_STEPS

    def advance(
        self,
        k: Coefficients,
        state: bp.PIDState,
        command: tuple[Array, Array, Array],
        qpos: Array,
        qvel: Array,
        feedforward: Array,
        matrix: Array = None,
        viscous: Array = None,
        low: Array = None,
        high: Array = None,
    ) -> tuple[bp.PIDState, Any, Any]:
        """Return the new state, the effort, and the mask of saturated joints.

        Parameters
        ----------
        command
            Setpoint, its rate (None: not given), and its acceleration.
        matrix
            M + dt B (envs, dof, dof) for gains per mass matrix.
        viscous
            B q', where the whole matrix is used: the engine integrates it implicitly, (M + dt B)
            (v+ - v) = dt (u - B v), so that u = (M + dt B) a + B v gives exactly v+ = v + dt a.
        low, high
            Least and largest effort of the motors (envs, dof); None for no limit. Saturation and
            anti-windup use them after clipping to the limits of the params.
        """
        if low is not None:
            xp = namespace(low, high)
            low, high = (clip(end, k.effort_min, k.effort_max, xp) for end in (low, high))
            k = k._replace(effort_min=low, effort_max=high)
        if viscous is not None:
            feedforward = viscous + feedforward
        setpoint, setpoint_rate, acceleration = command
        rates = qvel if self.measures_rate else None, setpoint_rate
        if self.uses_mass_matrix:
            inputs = setpoint, qpos, matrix, *rates, acceleration, feedforward
            new, terms = advance_with_mass_matrix(k, state, *inputs)
        else:  # accelerations are for gains per mass matrix only
            new, terms = bp.advance(k, state, setpoint, qpos, *rates, feedforward)
        return new, terms.effort, terms.effort != terms.unsaturated


def half_way(qpos: Array, qvel: Array, steps: Any, timestep: float) -> Array:
    """Return the pose for the mass matrix of the next ``steps`` sim steps from ``qpos``: half way
    through them.

    The matrix error is then zero on average. With matrices 0.3 steps ahead, a jaco2 that is near
    upright, its axes nearly in line, leaves its path by 18 mrad.
    """
    return qpos + 0.5 * (steps - 1) * timestep * qvel
