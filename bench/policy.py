"""User-defined controller for the benchmark: a policy network, evaluated at every sim step."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from batchpid.arrays.elementwise import namespace
from batchpid.sim import Robot

HIDDEN = 64
"""Units of each of the two hidden layers."""
RESIDUAL = 0.01
"""Largest share of the effort limits that the network adds."""


class ResidualPolicy:
    """PD law from the tutorial's gains, plus the output of a network with two hidden layers of
    random weights.

    It works with NumPy and JAX. The output is small, so that the robots move as in the other cases.
    The network takes the same time as a trained one.
    """

    def __init__(self, robot: Robot) -> None:
        settings, rng, dof = robot.settings, np.random.default_rng(0), robot.dof
        self._kp, self._kd = (
            2 * settings.kp,
            settings.kd,
        )  # kp is doubled to make up for the missing integral
        self._scale = (RESIDUAL * robot.effort_limit).astype(np.float32)
        sizes = (3 * dof, HIDDEN, HIDDEN, dof)
        self._layers = [
            rng.normal(0, n**-0.5, (n, m)).astype(np.float32) for n, m in pairwise(sizes)
        ]

    def init(self, robot: Robot, num_envs: int, timestep: float) -> None:
        """Return no state."""

    def __call__(
        self, state: None, setpoint: Any, qpos: Any, qvel: Any, passive: Any
    ) -> tuple[None, Any]:
        """Return the state, None, and the efforts (envs, dof) [N m or N]."""
        error = setpoint - qpos
        xp = namespace(error)
        units = xp.concatenate([error, qpos, qvel], axis=1).astype(np.float32)
        for layer in self._layers:
            units = xp.tanh(units @ layer)
        return None, passive + self._kp * error - self._kd * qvel + self._scale * units
