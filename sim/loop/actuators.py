"""Actuators and sensors of a group of envs: the models of :mod:`batchpid.actuators` in the loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.actuators import (
    ActuatorState,
    advance_effort,
    advance_measurement,
    discretise,
    measurement_noise,
)
from sim.loop.snapshot import EPISODE
from sim.loop.stage_program import compiled_stages

Float64 = NDArray[np.float64]

BLOCK = 64
"""Steps for which noise is drawn at once: a call of NumPy costs as much for 16 envs and one step as for ten steps."""


class JointActuators:
    """Actuators and sensors of M envs; it owns their state. Arrays are (M, dof).

    Attributes
    ----------
    actuators
        Their parameters.
    measures
        Whether measurements differ from the joints' state.
    """

    def __init__(self, actuators: bp.Actuators, qpos: Float64, timestep: float, first_env: int) -> None:
        """Start at rest at ``qpos``, without effort so far; ``first_env`` is the number of the first env."""
        self._timestep, self._envs = timestep, np.arange(first_env, first_env + len(qpos))
        self._episode, self._dof = np.zeros(len(qpos), np.int64), qpos.shape[1]
        self._state = ActuatorState()
        self.set_actuators(actuators, qpos)

    def set_actuators(self, actuators: bp.Actuators, qpos: Float64) -> None:
        """Change the parameters in flight; the state carries on."""
        self.actuators, self.measures = actuators, actuators.measures
        self._state = self._state.matched_to(self._init(qpos))
        self._coefficients = discretise(actuators, self._state, self._timestep, len(qpos))
        self._stages = compiled_stages(self._coefficients, qpos.shape)
        self._drawn = 0
        self._noise_block: tuple[Any, Any] | None = None

    def reset(self, mask: NDArray[np.bool_], qpos: Float64, qvel: Float64, effort: Float64 | None) -> None:
        """Reset the envs of ``mask`` (M,), at ``qpos`` and ``qvel``, with motors that were asked for ``effort``."""
        self._episode[mask] += 1
        self._state = bp.actuators.reset(self._state, self._init(qpos, qvel=qvel, effort=effort), mask)
        self._noise_block = None

    def measured(self, qpos: Float64, qvel: Float64) -> tuple[Float64, Float64]:
        """Return the measurement that :meth:`measure` would return, and change nothing."""
        _, qpos, qvel = advance_measurement(self._coefficients, self._state, qpos, qvel, self._noise(), self._stages)
        return qpos, qvel

    def measure(self, qpos: Float64, qvel: Float64) -> tuple[Float64, Float64]:
        """Advance the sensors by one sim step; return positions and velocities as measured."""
        drawn = self._noise()
        self._state, qpos, qvel = advance_measurement(self._coefficients, self._state, qpos, qvel, drawn, self._stages)
        self._drawn += 1
        return qpos, qvel

    def limits(self, qpos: Float64, qvel: Float64) -> tuple[Float64 | None, Float64 | None]:
        """Return the least and the largest effort to ask for that the motors do not clip; None for no limit."""
        return self._stages.limits(self._coefficients, qpos, qvel)

    def deliver(self, effort: Float64, qpos: Float64, qvel: Float64) -> Float64:
        """Advance the motors by one sim step; return the efforts that they deliver."""
        self._state, effort = advance_effort(self._coefficients, self._state, effort, qpos, qvel, self._stages)
        return effort

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the state by name, for :meth:`write`."""
        return {**self._state.leaves(), EPISODE: self._episode.copy()}

    def write(self, state: dict[str, NDArray[Any]]) -> None:
        """Set the state."""
        leaves = dict(state)
        self._episode = leaves.pop(EPISODE).copy()
        self._state, self._noise_block = ActuatorState(**leaves), None

    def _init(self, qpos: Float64, **since: Any) -> ActuatorState:
        numbers: dict[str, Any] = {"envs": self._envs, "episode": self._episode}
        return bp.actuators.init(self.actuators, qpos, self._timestep, **numbers, **since)

    def _noise(self) -> tuple[Any, Any] | None:
        """Return the noise of the next measurement, None without; it is drawn in blocks."""
        state = self._state
        if state.key is None:
            return None
        if self._noise_block is None or self._drawn == BLOCK:
            steps = state.step + np.arange(BLOCK, dtype=np.uint32)[:, None]
            like = np.zeros((len(self._envs), self._dof))
            self._noise_block, self._drawn = measurement_noise(self._coefficients, state.key, steps, like, np), 0
        position, velocity = self._noise_block
        now = self._drawn
        return None if position is None else position[now], None if velocity is None else velocity[now]
