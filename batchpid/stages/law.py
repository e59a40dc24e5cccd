"""Laws: PID (:mod:`batchpid.law`) with its mass matrix, drives of the engine, the caller's own
controller, and commanded efforts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace, nearest_turn
from batchpid.law.coefficients import Coefficients, discretise, spread
from batchpid.law.computed_torque import advance_with_mass_matrix
from batchpid.law.params import PIDParams
from batchpid.law.pid import advance, advance_drive, init
from batchpid.law.state import PIDState
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values

MASS_MATRIX_STEPS = 4
"""Sim steps for which a mass matrix is kept within a tick.

The implicit law takes a fresh one in each: in setpoint steps at w dt = 1 panda diverges with a
matrix kept for 4 steps, at w dt = 3 with one kept for 2.
"""


@dataclass(frozen=True)
class Matrix(Stage):
    """M = M(y) + known armature + dt B, for the leaders, half way through the sim steps for which
    it serves.

    The matrix error is then zero on average. With matrices 0.3 steps ahead, a jaco2 that is near
    upright, its axes nearly in line, leaves its path by 18 mrad.
    """

    armature: Array
    damping: Array
    coupling: Coupling
    timestep: Any
    every: int
    """Sim steps for which a matrix is kept within a tick."""

    name = "matrix"
    native = "MASS_MATRIX"
    calls_model = True
    is_brief = True

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if not control.uses_matrix:
            return None
        steps = 1 if control.late else MASS_MATRIX_STEPS
        inputs = control.armature, control.damping, control.coupling
        return cls(*inputs, control.timestep, steps)

    def init(self, values: Values) -> Told:
        rows, dof = values.measured.qpos.shape
        return np.zeros((rows, dof, dof)), values

    def step(self, state: Array, values: Values) -> Told:
        qpos, qvel, _ = values.seen
        index, end, _ = values.step

        def fresh() -> Array:
            steps = namespace(qpos).minimum(self.every, end - index).astype(qpos.dtype)
            return self.at(qpos + 0.5 * (steps - 1) * self.timestep * qvel, values)

        state = values.model.when(index % self.every == 0, fresh, state)
        return state, values._replace(matrix=state)

    def at(self, qpos: Array, values: Values) -> Array:
        """Return the matrix at the pose ``qpos`` (M, dof)."""
        xp = namespace(qpos)
        matrix = values.model.mass_matrix(qpos)
        if self.armature is not None:
            matrix = matrix + xp.diag(self.armature)
        if self.damping is not None:
            matrix = matrix + self.timestep * xp.diag(self.damping)
        return self.coupling.mass_matrix(matrix)

    def bind(self, program: Any, state: Array, values: Values) -> Values:
        tree, bodies = program.pack.rigid_tree.tables
        program.place(
            pose=values.seen.qpos,
            rate=values.seen.qvel,
            tree=tree,
            bodies=bodies,
        )
        program.place(
            matrix=state,
            armature=self.armature,
            damping=self.damping,
        )
        program.place(**self.coupling.native())
        return values._replace(matrix=state)


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
            state, terms = advance(
                k,
                state,
                setpoint,
                qpos,
                *rates,
                forward,
            )
        effort, unsaturated = terms.effort, terms.unsaturated
        return state, values.told(
            qf=effort,
            motor=effort,
            saturated=effort != unsaturated,
        )

    def adopt(self, before: Self, state: PIDState, values: Values) -> PIDState:
        # The integral has the unit of the gains, so in other units the law starts again.
        if before.params.gain_units != self.params.gain_units:
            return init(self.params, values.measured.qpos)
        return state


@dataclass(frozen=True)
class Drive(Stage):
    """The engine's drives with stiffness kp and damping kd; qf = f.

    With ki the drive's target moves by the integral over kp (:func:`batchpid.law.pid.advance_drive`), so
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
        return state, values.told(
            qf=forward,
            motor=forward,
            target=target,
            target_rate=rate,
        )


@dataclass(frozen=True)
class Own(Stage):
    """u = the caller's own controller, which has the feedforward as an input."""

    controller: Any

    name = "law"
    native = "CONTROLLER"

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
        return state, values.told(
            qf=effort,
            motor=effort,
            saturated=saturated,
        )
