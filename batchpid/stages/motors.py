"""Motors: :mod:`batchpid.motors.actuator_dynamics`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from batchpid import motors as model
from batchpid.motors.actuators import MOTOR_SIDE, Actuators, ActuatorState
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class Limits(Stage):
    """low, high = efforts that the motors deliver unclipped, which the law's saturation and
    anti-windup know.
    """

    k: model.MotorCoefficients

    name = "limits"

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if not control.delivers:
            return None
        _, k = control.side(MOTOR_SIDE)
        return cls(model.MotorCoefficients(commands=k.commands))

    def step(self, state: tuple[()], values: Values) -> Told:
        return state, values._replace(limits=model.command_limits(self.k, values.seen.qvel))


@dataclass(frozen=True)
class Motors(Stage):
    """qf <- motors(qf)."""

    actuators: Actuators
    k: model.MotorCoefficients
    coupling: Coupling
    timestep: float

    name = "motors"
    starting = ("actuators", "coupling", "timestep")

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if not control.delivers:
            return None
        return cls(*control.side(MOTOR_SIDE), control.coupling, control.timestep)

    def init(self, values: Values) -> Told:
        qpos, qvel, passive = values.measured
        holding = None if passive is None else self.coupling.efforts(passive)
        return model.init(self.actuators, qpos, self.timestep, qvel=qvel, effort=holding), values

    def step(self, state: ActuatorState, values: Values) -> Told:
        inputs = values.outputs.qf, values.measured.qvel
        state, effort = model.advance_effort(self.k, state, *inputs)
        return state, values.told(qf=effort, motor=effort)
