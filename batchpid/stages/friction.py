"""Friction and damping of the joints: :mod:`batchpid.motors.friction`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace, replace_envs
from batchpid.motors import friction as model
from batchpid.motors.coupling import Coupling
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Told, Values

REFRESH_STEPS = 64
"""Sim steps of an env between updates of the friction model's inertia."""


class InertiaState(NamedTuple):
    """State of :class:`Inertia`."""

    gain: Array
    memory: Array
    """Factors of :class:`batchpid.motors.friction.FrictionState` (M, dof)."""
    age: Array
    """Sim steps since the last update (M,)."""


@dataclass(frozen=True)
class Inertia(Stage):
    """Inertias of the joints for the friction model, updated every ``REFRESH_STEPS`` sim steps of an
    env.
    """

    friction: model.Friction
    coupling: Coupling
    timestep: Any
    drive: tuple[Array, Array]
    """Damping and stiffness of the engine's drives."""
    armature: Array
    """Armature of the actuators, which the model's matrix includes (1 | M, dof); None for none."""

    name = "inertia"
    starting = ("armature",)
    native = "INERTIA"
    calls_model = True

    @classmethod
    def of(cls, control: Control) -> Self | None:
        if control.friction.coulomb is None:
            return None
        actuators = control.actuators
        armature = None if actuators is None else actuators.armature
        inputs = control.friction, control.coupling, control.timestep, control.drive
        return cls(*inputs, armature)

    def init(self, values: Values) -> Told:
        factors = self.factors(values)
        age = np.zeros(len(values.measured.qpos), np.int64)
        return InertiaState(*factors, age), values._replace(inertia=factors)

    def step(self, state: InertiaState, values: Values) -> Told:
        # The age counts from the env's own reset, so that an env does not depend on others.
        due = state.age == REFRESH_STEPS
        present = state.gain, state.memory

        def fresh() -> tuple[Array, Array]:
            return replace_envs(present, self.factors(values), due)

        gain, memory = values.model.when(due, fresh, present)
        age = namespace(due).where(due, 0, state.age) + 1
        return InertiaState(gain, memory, age), values._replace(inertia=(gain, memory))

    def factors(self, values: Values) -> tuple[Array, Array]:
        """Return the factors at the robots' present poses, for the leaders only."""
        qpos = values.measured.qpos
        state = model.FrictionState(effort=qpos)  # which has the shape
        if values.model.refresh is not None:
            state = values.model.refresh(state, qpos)
        else:
            matrix = self.coupling.mass_matrix(values.model.joint_mass_matrix(qpos))
            state = model.refresh(self.friction, state, matrix, self.timestep, *self.drive)
        return state.gain, state.memory

    def adopt(self, before: Self, state: InertiaState, values: Values) -> InertiaState:
        parts = zip(
            (*self.friction, self.armature), (*before.friction, before.armature), strict=True
        )
        # Draws of other envs must not change this env.
        changed = sum(
            np.not_equal(0.0 if new is None else new, 0.0 if old is None else old)
            for new, old in parts
        )
        is_due = np.broadcast_to(changed, state.gain.shape).any(1)
        return state._replace(age=np.where(is_due, REFRESH_STEPS, state.age))

    def bind(self, program: Any, state: InertiaState, values: Values) -> Values:
        program.use(refresh=program.model.refresh)
        program.place(
            age=state.age,
            gain=state.gain,
            memory=state.memory,
        )
        return values._replace(inertia=(state.gain, state.memory))


@dataclass(frozen=True)
class Friction(Stage):
    """qf <- qf - friction(qf, v)."""

    friction: model.Friction
    coupling: Coupling

    name = "friction"
    starting = ("coupling",)

    @classmethod
    def of(cls, control: Control) -> Self:
        return cls(control.friction, control.coupling)

    def init(self, values: Values) -> Told:
        if self.friction.coulomb is None:
            return model.FrictionState(), values
        load = self.coupling.efforts(values.model.load())
        state = _with_inertia(model.started(values.measured.qvel, load), values)
        return _kept(model.with_sliding(self.friction, state)), values

    def step(self, state: model.FrictionState, values: Values) -> Told:
        state = _with_inertia(state, values)
        qvel = values.measured.qvel
        state, qf = model.advance(self.friction, state, values.outputs.qf, qvel)
        return _kept(state), values.told(qf=qf)


def _with_inertia(state: model.FrictionState, values: Values) -> model.FrictionState:
    gain, memory = values.inertia
    return state._replace(gain=gain, memory=memory)


def _kept(state: model.FrictionState) -> model.FrictionState:
    """Return the state without the factors, which are the state of :class:`Inertia`."""
    return state._replace(gain=None, memory=None)
