"""Actuators and sensors of a group of envs: the models of :mod:`batchpid.actuators` in the loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.actuators import ActuatorState, advance_effort, advance_measurement, discretise

Float64 = NDArray[np.float64]


class JointActuators:
    """Actuators and sensors of M envs; it owns their state. Arrays are (M, dof).

    Attributes
    ----------
    actuators
        Their parameters.
    """

    def __init__(self, actuators: bp.Actuators, qpos: Float64, timestep: float) -> None:
        """Start at rest at ``qpos``, without effort so far."""
        self._timestep = timestep
        self._state = bp.actuators.init(actuators, qpos, timestep)
        self.set_actuators(actuators, qpos)

    def set_actuators(self, actuators: bp.Actuators, qpos: Float64) -> None:
        """Change the parameters in flight; the state carries on."""
        self.actuators = actuators
        self._state = self._state.matched_to(bp.actuators.init(actuators, qpos, self._timestep))
        self._coefficients = discretise(actuators, self._state, self._timestep)

    def reset(self, mask: NDArray[np.bool_], qpos: Float64, qvel: Float64, effort: Float64 | None) -> None:
        """Reset the envs of ``mask`` (M,), at ``qpos`` and ``qvel``, with motors that were asked for ``effort``."""
        fresh = bp.actuators.init(self.actuators, qpos, self._timestep, qvel=qvel, effort=effort)
        self._state = bp.actuators.reset(self._state, fresh, mask)

    def measured(self, qpos: Float64, qvel: Float64) -> tuple[Float64, Float64]:
        """Return the measurement that :meth:`measure` would return, and change nothing."""
        _, qpos, qvel = advance_measurement(self._coefficients, self._state, qpos, qvel)
        return qpos, qvel

    def measure(self, qpos: Float64, qvel: Float64) -> tuple[Float64, Float64]:
        """Advance the sensors by one sim step; return positions and velocities as measured."""
        self._state, qpos, qvel = advance_measurement(self._coefficients, self._state, qpos, qvel)
        return qpos, qvel

    def deliver(self, effort: Float64, qpos: Float64, qvel: Float64) -> Float64:
        """Advance the motors by one sim step; return the efforts that they deliver."""
        self._state, effort = advance_effort(self._coefficients, self._state, effort, qpos, qvel)
        return effort

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the state by name, for :meth:`write`."""
        return self._state.leaves()

    def write(self, state: dict[str, NDArray[Any]]) -> None:
        """Set the state."""
        self._state = ActuatorState(**state)
