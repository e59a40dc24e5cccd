"""Sensors of the joints: :mod:`batchpid.motors.actuator_dynamics`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from batchpid import motors as model
from batchpid.motors.actuators import SENSOR_SIDE, Actuators, ActuatorState
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Measured, Told, Values


@dataclass(frozen=True)
class Sensors(Stage):
    """y = sensors(q), y' = sensors(v)."""

    actuators: Actuators
    k: model.MotorCoefficients
    timestep: float

    name = "sensors"
    starting = ("actuators", "timestep")

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if not control.measures:
            return None
        return cls(*control.side(SENSOR_SIDE), control.timestep)

    def init(self, values: Values) -> Told:
        qpos, qvel, _ = values.measured
        envs, episode = values.model.envs, values.model.episode
        state = model.init(
            self.actuators,
            qpos,
            self.timestep,
            qvel=qvel,
            envs=envs,
            episode=episode,
        )
        # The law starts from what the sensors show.
        return state, self.step(state, values)[1]

    def step(self, state: ActuatorState, values: Values) -> Told:
        qpos, qvel, passive = values.measured
        state, qpos, qvel = model.advance_measurement(self.k, state, qpos, qvel, values.noise)
        return state, values._replace(seen=Measured(qpos, qvel, passive), noise=None)
