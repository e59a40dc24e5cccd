"""Plan of a slow policy: :mod:`batchpid.plan`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace, replace_envs
from batchpid.motors.coupling import Coupling
from batchpid.plan import sampling as model
from batchpid.plan.plans import Plan as Options
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class Plan(Stage):
    """r, r', r'' = plan(t). Chunks are added between ticks: :meth:`add`.

    The clock of an env begins with its episode, ``lag`` before the first sample: a law that takes
    its setpoint at the beginning of a sim step is one step behind the tick.
    """

    options: Options
    coupling: Coupling
    timestep: Any
    lag: float

    name = "plan"
    starting = ("lag",)
    due = ("now", "end")

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if control.plan is None:
            return None
        lag = 0.0 if control.late else control.timestep
        return cls(control.plan, control.coupling, control.timestep, lag)

    def init(self, values: Values) -> Told:
        return model.init(self.options, values.measured.qpos, -self.lag), values

    def renewed(self, state: model.PlanState) -> model.PlanState:
        return model.renewed(self.options, state, state.now + self.timestep)

    def step(self, state: model.PlanState, values: Values) -> Told:
        time = state.now + self.timestep
        state, *motion = model.advance(self.options, state, time, self.timestep)
        setpoint, rate, acceleration = motion
        command = values.command._replace(
            setpoint=self.coupling.positions(setpoint),
            setpoint_rate=self.coupling.rates(rate),
            setpoint_acceleration=self.coupling.rates(acceleration),
        )
        return state, values._replace(command=command)

    def add(self, state: model.PlanState, chunk: Array, latency: Array) -> model.PlanState:
        """Return the state with a chunk (envs, rows, dof) that a policy made ``latency`` (envs,)
        [s] before this tick, for the envs where both are finite.
        """
        xp = namespace(chunk, latency)
        mask = xp.isfinite(chunk).all((1, 2)) & xp.isfinite(latency)
        if mask.all():
            return model.add(self.options, state, chunk, state.now[:, 0] + self.lag - latency)
        chunk = xp.where(mask[:, None, None], chunk, 0.0)
        time = state.now[:, 0] + self.lag - xp.where(mask, latency, 0.0)
        return replace_envs(state, model.add(self.options, state, chunk, time), mask)
