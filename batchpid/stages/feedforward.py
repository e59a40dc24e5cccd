"""Passive force at the measured state, and the feedforward that a law adds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace, wrap
from batchpid.motors import friction as friction_model
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class Passive(Stage):
    """p = p(y, y'): the passive force of the description at the measured state, which the engine
    does not know.
    """

    name = "passive force"
    native = "FORCE"
    calls_model = True

    @classmethod
    def of(cls, control: Control) -> Self | None:
        return cls() if control.measures and control.gravity else None

    def step(self, state: tuple[()], values: Values) -> Told:
        passive = values.model.passive_force(values.seen.qpos, values.seen.qvel)
        return state, values._replace(seen=values.seen._replace(passive=passive))

    def bind(self, program: Any, state: tuple[()], values: Values) -> Values:
        program.place(pose=values.seen.qpos, rate=values.seen.qvel)
        return values


@dataclass(frozen=True)
class Feedforward(Stage):
    """f = p + the caller's feedforward + modelled friction, for the leaders."""

    coupling: Coupling
    powered: Array
    """1.0 for joints with a motor, where p is compensated, else 0.0 (dof,); None: all."""
    friction: Array
    """Friction that the compensation cancels (dof,) [N m or N]; None for none."""
    band: Array
    turns: Array

    name = "feedforward"

    @classmethod
    def of(cls, control: Control) -> Self:
        if control.modelled is None:
            return cls(control.coupling, control.powered, None, None, None)
        friction = control.modelled, control.band, control.turns
        return cls(control.coupling, control.powered, *friction)

    def step(self, state: tuple[()], values: Values) -> Told:
        command, seen = values.command, values.seen
        passive = seen.passive
        if self.powered is not None:
            passive = self.powered * passive
        forward = self.coupling.efforts(passive + command.feedforward)
        if self.friction is not None:
            error = wrap(command.setpoint - seen.qpos, self.turns, namespace(seen.qpos))
            forward = forward + friction_model.compensation(
                self.friction, error, command.setpoint_rate, self.band
            )
        return state, values._replace(forward=forward)
