"""Guard of the setpoints of a group of envs: :mod:`batchpid.guard` in the loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid import guard
from batchpid.coupling import Coupling
from batchpid.guard import Guard, GuardState
from sim.loop.arrays import Command
from sim.loop.snapshot import CHANGED

Float64 = NDArray[np.float64]


class SetpointGuard:
    """Guard of M envs; it owns the state. Arrays are (M, dof).

    Attributes
    ----------
    changed
        Setpoints that were changed in the last sim step.
    """

    def __init__(self, limits: Guard, coupling: Coupling | None, qpos: Float64, timestep: float) -> None:
        self._limits, self._coupling, self._timestep = limits, coupling, timestep
        self._state = guard.init(limits, qpos)
        self.changed: NDArray[np.bool_] = np.zeros(qpos.shape, bool)

    def reset(self, mask: NDArray[np.bool_], qpos: Float64) -> None:
        """Start the envs of ``mask`` (M,) at rest at ``qpos``."""
        self._state = guard.reset(self._state, guard.init(self._limits, qpos), mask)
        self.changed[mask] = False

    def advance(self, command: Command) -> Command:
        """Advance by one sim step; return ``command`` with guarded setpoints, and with their rates if it has rates.

        Followers move with their leaders.
        """
        self._state, changed = guard.advance(self._limits, self._state, command.setpoint, self._timestep)
        setpoint, rate = self._state.setpoint, command.setpoint_rate
        if rate is not None:
            rate = np.where(changed, self._state.rate, rate)
        if (coupling := self._coupling) is not None:
            setpoint, changed = coupling.positions(setpoint), coupling.of_leaders(changed)
            rate = None if rate is None else coupling.rates(rate)
        self.changed = changed
        return command._replace(setpoint=setpoint, setpoint_rate=rate)

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the state by name, for :meth:`write`."""
        return {**self._state._asdict(), CHANGED: self.changed.copy()}

    def write(self, state: dict[str, NDArray[Any]]) -> None:
        """Set the state."""
        self.changed = state[CHANGED].copy()
        self._state = GuardState(*(state[name] for name in GuardState._fields))
