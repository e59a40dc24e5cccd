"""Law of the control "pid" in a sim step: pure functions of arrays (envs, dof), for NumPy and JAX."""

from __future__ import annotations

from typing import Any, NamedTuple

import batchpid as bp
from batchpid.choices import PerInertia, PerMassMatrix
from batchpid.coefficients import Coefficients
from batchpid.computed_torque import advance_with_mass_matrix, per_inertia
from batchpid.coupling import Coupling
from batchpid.elementwise import clip, namespace

MASS_MATRIX_STEPS = 4
"""Sim steps for which a mass matrix is kept within a tick."""


class PIDLaw(NamedTuple):
    """Ways in which the params ask for the law to be run on a robot."""

    whole: bool
    """Gains per mass matrix: u = M a."""
    per_inertia: bool
    """Gains per unit of each joint's inertia."""
    measures_rate: bool
    """The derivative term takes the measured velocity."""

    @classmethod
    def of(cls, params: bp.PIDParams) -> PIDLaw:
        """Return the law that ``params`` ask for."""
        whole, inertia = (isinstance(params.gain_units, kind) for kind in (PerMassMatrix, PerInertia))
        return cls(whole, inertia, params.measurement_rate is not None)

    @property
    def needs_matrix(self) -> bool:
        """Whether the law takes the mass matrix, or its diagonal."""
        return self.whole or self.per_inertia

    def advance(
        self,
        k: Coefficients,
        state: bp.PIDState,
        command: tuple[Any, Any],
        qpos: Any,
        qvel: Any,
        feedforward: Any,
        matrix: Any = None,
        viscous: Any = None,
        low: Any = None,
        high: Any = None,
        observed: bool = False,
    ) -> tuple[bp.PIDState, Any, Any]:
        """Return the new state, the effort, and if it is ``observed`` the mask of its saturation, else None.

        Parameters
        ----------
        command
            Setpoint and its rate, which may be None.
        matrix
            M + dt B (envs, dof, dof) where the whole matrix is used, its diagonal (envs, dof) where gains are per
            inertia.
        viscous
            B q', where the whole matrix is used: the engine integrates it implicitly, (M + dt B) (v+ - v) =
            dt (u - B v), so that u = (M + dt B) a + B v gives exactly v+ = v + dt a.
        low, high
            Least and largest effort of the motors (envs, dof), which saturation and anti-windup take within those of
            the params; None for no limit.
        """
        if self.per_inertia:
            k = per_inertia(k, matrix)
        if low is not None:
            xp = namespace(low, high)
            low, high = (clip(end, k.effort_min, k.effort_max, xp) for end in (low, high))
            k = k._replace(effort_min=low, effort_max=high)
        if viscous is not None:
            feedforward = viscous if feedforward is None else feedforward + viscous
        setpoint, setpoint_rate = command
        rates = (qvel if self.measures_rate else None, setpoint_rate, feedforward)
        if self.whole:
            new, effort, *shown = advance_with_mass_matrix(k, state, setpoint, qpos, matrix, *rates, terms=observed)
        else:
            new, effort, *shown = bp.advance(k, state, setpoint, qpos, *rates, terms=observed)
        return new, effort, shown[0].saturated if shown else None


def half_way(qpos: Any, qvel: Any, steps: Any, timestep: float) -> Any:
    """Return the pose at which to take a mass matrix for so many sim steps from ``qpos``: the one in their middle.

    So its error is zero on average: near upright, axes nearly in line, a jaco2 leaves its path by 18 mrad under
    matrices that are 0.3 steps ahead.
    """
    return qpos + 0.5 * (steps - 1) * timestep * qvel


def acting_params(params: bp.PIDParams, coupling: Coupling | None) -> bp.PIDParams:
    """Return ``params`` with zero gains for followers, which move with their leaders."""
    if coupling is None:
        return params
    gains = {"kp": params.kp, "ki": params.ki, "kd": params.kd}
    return params.replace(**{name: gain * coupling.independent for name, gain in gains.items() if gain is not None})
