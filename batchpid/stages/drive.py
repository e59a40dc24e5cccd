"""Drives of the engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace, nearest_turn
from batchpid.law.coefficients import Coefficients, discretise
from batchpid.law.params import PIDParams
from batchpid.law.pid import advance_drive, init
from batchpid.law.state import PIDState
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class Drive(Stage):
    """The engine's drives with stiffness kp and damping kd; qf = f.

    With ki the drive's target moves by the integral over kp (:func:`batchpid.drive_target`), so
    that the drive acts as a PID whose P and D the engine integrates implicitly. The engine's drives
    do not know whole turns, so the target of a continuous joint is the one next to y, which may
    jump at every sim step.
    """

    integral: Coefficients | None
    """Coefficients of the integral that moves the targets."""
    turns: Array
    params: PIDParams

    name = "law"
    starting = ("params",)

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if control.mode != "drive":
            return None
        params, integral = control.params, None
        if params.ki is not None and np.any(params.ki > 0):
            integral = discretise(control.gains._replace(measurement_rate=None), control.timestep)
        return cls(integral, control.turns, params)

    def init(self, values: Values) -> Told:
        return init(self.params, values.seen.qpos), values

    def step(self, state: PIDState, values: Values) -> Told:
        target, rate, *_ = values.command
        qpos, forward = values.seen.qpos, values.forward
        target = nearest_turn(target, qpos, self.turns, namespace(qpos))
        if self.integral is not None:
            rates = {"setpoint_rate": rate, "feedforward": forward}
            state, target = advance_drive(self.integral, state, target, qpos, **rates)
        if rate is None:
            rate = namespace(target).zeros_like(target)
        return state, values.told(qf=forward, motor=forward, target=target, target_rate=rate)
