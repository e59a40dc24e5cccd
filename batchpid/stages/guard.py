"""Limits of setpoints: :mod:`batchpid.motors.guard`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace
from batchpid.motors import guard as model
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class Guard(Stage):
    """r <- guard(r). It limits leaders; a follower's setpoint comes from its leader's."""

    limits: model.Guard
    coupling: Coupling
    timestep: Any

    name = "guard"

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if control.guard is None:
            return None
        return cls(control.guard, control.coupling, control.timestep)

    def init(self, values: Values) -> Told:
        return model.init(self.limits, values.measured.qpos), values

    def step(self, state: model.GuardState, values: Values) -> Told:
        setpoint, rate, acceleration, _ = values.command
        coupling = self.coupling
        state, changed = model.advance(self.limits, state, setpoint, self.timestep)
        command = values.command._replace(setpoint=coupling.positions(state.setpoint))
        if rate is not None:

            def chosen(guarded: Array, given: Array) -> Array:
                return coupling.rates(namespace(changed).where(changed, guarded, given))

            # A given acceleration is 0 where the guard changes the setpoint.
            command = command._replace(
                setpoint_rate=chosen(state.rate, rate),
                setpoint_acceleration=chosen(0.0, acceleration),
            )
        return state, values._replace(command=command).told(guarded=coupling.of_leaders(changed))
