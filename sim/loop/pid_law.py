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

    def scaled(self, k: Coefficients, inertia: Any) -> Coefficients:
        """Return the coefficients at the joints' inertia (envs, dof), where the gains are per unit of it."""
        return per_inertia(k, inertia) if self.per_inertia else k

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
        terms: bool = False,
    ) -> Any:
        """Return the new state and the effort, and with ``terms`` these.

        Parameters
        ----------
        command
            Setpoint and its rate, which may be None.
        k
            Those of :meth:`scaled`.
        matrix
            M + dt B (envs, dof, dof), where the whole matrix is used.
        viscous
            B q', where the whole matrix is used: the engine integrates it implicitly, (M + dt B) (v+ - v) =
            dt (u - B v), so that u = (M + dt B) a + B v gives exactly v+ = v + dt a.
        low, high
            Least and largest effort of the motors (envs, dof), which saturation and anti-windup take within those of
            the params; None for no limit.
        """
        if low is not None:
            xp = namespace(low, high)
            low, high = (clip(end, k.effort_min, k.effort_max, xp) for end in (low, high))
            k = k._replace(effort_min=low, effort_max=high)
        if viscous is not None:
            feedforward = viscous if feedforward is None else feedforward + viscous
        setpoint, setpoint_rate = command
        rates = (qvel if self.measures_rate else None, setpoint_rate, feedforward)
        if self.whole:
            return advance_with_mass_matrix(k, state, setpoint, qpos, matrix, *rates, terms=terms)
        return bp.advance(k, state, setpoint, qpos, *rates, terms=terms)


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
