"""The law: :mod:`batchpid.law`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from batchpid.arrays.elementwise import clip, namespace
from batchpid.law.coefficients import Coefficients, discretise, spread
from batchpid.law.computed_torque import advance_with_mass_matrix, convert_integral
from batchpid.law.params import PIDParams
from batchpid.law.pid import advance, init
from batchpid.law.state import PIDState
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.matrix import Matrix
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values


@dataclass(frozen=True)
class PID(Stage):
    """qf = sat(PID(r, r', r'', y, y') + f), within the limits of params and motors."""

    k: Coefficients
    params: PIDParams
    coupling: Coupling
    matrix: Matrix | None
    """None with gains in efforts."""
    measures_rate: bool
    """The derivative term takes the measured velocity."""

    name = "law"
    starting = ("params",)

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if control.mode != "pid":
            return None
        params = control.params
        k = spread(discretise(control.gains, control.timestep), control.envs)
        measures_rate = params.measurement_rate is not None
        return cls(k, params, control.coupling, Matrix.of(control), measures_rate)

    def init(self, values: Values) -> Told:
        return init(self.params, values.seen.qpos), values

    def step(self, state: PIDState, values: Values) -> Told:
        qpos, qvel, _ = values.seen
        setpoint, rate, acceleration, _ = values.command
        forward, k = values.forward, self.k
        if self.matrix is not None and self.matrix.damping is not None:
            # The engine integrates this damping implicitly, (M + dt B) (v+ - v) = dt (u - B v), so
            # that u = (M + dt B) a + B v gives exactly v+ = v + dt a.
            forward = self.coupling.efforts(self.matrix.damping * qvel) + forward
        low, high = values.limits
        if low is not None:
            xp = namespace(low, high)
            low, high = (clip(end, k.effort_min, k.effort_max, xp) for end in (low, high))
            k = k._replace(effort_min=low, effort_max=high)
        rates = qvel if self.measures_rate else None, rate
        if self.matrix is not None:
            if acceleration is not None:  # the leaders' mass matrix has the followers' share
                acceleration = self.coupling.of_independent(acceleration)
            inputs = setpoint, qpos, values.matrix, *rates, acceleration, forward
            state, terms = advance_with_mass_matrix(k, state, *inputs)
        else:  # accelerations are for gains per mass matrix only
            state, terms = advance(k, state, setpoint, qpos, *rates, forward)
        effort, unsaturated = terms.effort, terms.unsaturated
        return state, values.told(qf=effort, motor=effort, saturated=effort != unsaturated)

    def adopt(self, before: Self, state: PIDState, values: Values) -> PIDState:
        # The integral in the unit of the new gains, by the params that have them per mass matrix.
        matrix = before.matrix or self.matrix
        if matrix is not None and before.params.gain_units != self.params.gain_units:
            at = matrix.at(values.measured.qpos, values)
            state = convert_integral(state, before.params, self.params, at)
        return state
