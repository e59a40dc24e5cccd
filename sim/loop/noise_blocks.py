"""Noise of sensors, drawn for many sim steps at once: a NumPy call takes as long for ten steps as for one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.motors import ActuatorState, Coefficients, measurement_noise

BLOCK = 64
"""Sim steps of a block."""


class NoiseBlocks:
    """:func:`batchpid.motors.measurement_noise` at the step of a state, from blocks of consecutive steps."""

    def __init__(self) -> None:
        self._key: Any = None
        self._first = 0
        self._block: tuple[Any, Any] = (None, None)

    def __call__(self, k: Coefficients, state: ActuatorState, like: NDArray[np.float64]) -> tuple[Any, Any] | None:
        """Return the noise of positions and velocities; None for sensors without noise.

        A reset replaces the key. While the key is the same, all envs advance by the same number of steps.
        """
        if state.key is None:
            return None
        at = int(state.step[0]) - self._first
        if state.key is not self._key or not 0 <= at < BLOCK:
            steps = state.step + np.arange(BLOCK, dtype=np.uint32)[:, None]
            self._block = measurement_noise(k, state.key, steps, np.zeros_like(like), np)
            self._key, self._first, at = state.key, int(state.step[0]), 0
        position, velocity = self._block
        return None if position is None else position[at], None if velocity is None else velocity[at]
