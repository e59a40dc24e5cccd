"""Efforts of the caller's own controller, and commanded efforts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class Own(Stage):
    """u = the caller's own controller, which has the feedforward as an input."""

    controller: Any

    name = "law"
    native = "controller"

    @classmethod
    def of(cls, control: Control) -> Self | None:
        return cls(control.controller) if control.mode == "custom" else None

    def init(self, values: Values) -> Told:
        return self.controller.init(len(values.measured.qpos)), values

    def step(self, state: Any, values: Values) -> Told:
        qpos, qvel, _ = values.seen
        inputs = values.command.setpoint, qpos, qvel, values.forward, values.step.left
        state, returned, *limited = self.controller(state, *inputs)
        values = values._replace(limited=limited[0] if limited else None)
        return state, values.told(returned=returned)

    def bind(self, program: Any, state: Any, values: Values) -> Values:
        qpos, qvel, _ = values.seen
        effort, limited = program.control_by(state, qpos, qvel, values.forward)
        return values._replace(limited=limited).told(returned=effort)


@dataclass(frozen=True)
class Effort(Stage):
    """qf = sat(u), or sat(u + f) of a commanded effort u, within the limits of params and
    motors; a follower's effort acts on its leader.
    """

    low: Array
    high: Array
    coupling: Coupling

    name = "saturation"

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if control.mode not in ("effort", "custom"):
            return None
        return cls(control.params.effort_min, control.params.effort_max, control.coupling)

    def step(self, state: tuple[()], values: Values) -> Told:
        returned = values.outputs.returned
        if returned is None:
            total = self.coupling.efforts(values.command.setpoint) + values.forward
        else:
            total = self.coupling.efforts(returned)
        xp = namespace(total, *values.limits)
        effort = clip(clip(total, *values.limits, xp), self.low, self.high, xp)
        saturated = effort != total
        if values.limited is not None:
            saturated = saturated | (values.limited > 0)
        return state, values.told(qf=effort, motor=effort, saturated=saturated)
