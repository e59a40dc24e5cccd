"""Sim steps of a tick in NumPy: control step, efforts, step of the engine, reading."""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from batchpid.arrays.array_types import Array, Float64, Rows
from batchpid.law.coefficients import spread
from batchpid.motors import ActuatorState, MotorCoefficients, measurement_noise
from batchpid.sim.engine.native_model import NativeRefresh, mass_matrix_of, passive_force_of
from batchpid.sim.engine.protocol import CompiledPack, DrivenPack, EnginePack
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import COUPLING_STEPS, REFRESH_STEPS, sim_step
from batchpid.sim.loop.custom import OwnController, controller_errors
from batchpid.sim.loop.faults import sound
from batchpid.sim.loop.step_setup import needs_qvel
from batchpid.sim.loop.step_values import (
    Constants,
    Layout,
    Measured,
    Model,
    Outputs,
    Step,
    StepState,
    Values,
)
from batchpid.sim.options.options import RunnerOptions


class Span(NamedTuple):
    """Sim steps to run."""

    tick: int
    """First tick, a row of the loop's tables."""
    begin: int
    """Sim steps of it that are done."""
    until: int
    """End of the ticks, for an executor that runs several in one call; others run the first one."""
    steps: int
    """Sim steps of a tick."""


class Ran(NamedTuple):
    """Result of some sim steps, in the arrays of the executor."""

    state: StepState
    outputs: Outputs
    """Results of the last step."""
    measured: Measured
    """Reading after the last step."""
    before: Any
    """qpos before the last step."""
    tick: int
    """First tick that is not complete, or not observed."""
    done: int
    """Sim steps of that tick that are done; 0 if it has not begun."""
    failed: bool
    """Whether an env may have failed in the last step."""


def passive_forces(options: RunnerOptions) -> tuple[bool, bool]:
    """Return whether gravity is compensated, and whether Coriolis and centrifugal forces are."""
    parts = options.compensate.split("+")
    return "gravity" in parts, "coriolis" in parts


class NumPyExecutor:
    """Executor of control steps in NumPy, for the robots of ``pack``; ``layout`` has its model
    functions.
    """

    def __init__(
        self, options: RunnerOptions, pack: EnginePack, layout: Layout, constants: Constants
    ) -> None:
        self._pack = pack
        self._layout = layout
        self._constants = constants
        self._gravity, self._coriolis = passive_forces(options)
        self._speed_limit = options.speed_limit
        self._controller = None if isinstance(options.control, str) else options.control
        self._reads_qvel = needs_qvel(layout, constants, options.speed_limit)
        self._reads_force = self._gravity and not layout.measures
        self._failed = False

    @cached_property
    def _spread(self) -> Constants:
        k = self._constants.k
        return (
            self._constants if k is None else self._constants._replace(k=spread(k, self._pack.size))
        )

    def measure(self) -> Measured:
        """Return a reading of the robots."""
        pack = self._pack
        return Measured(
            pack.read_qpos(),
            pack.read_qvel() if self._reads_qvel else None,
            pack.passive_force(self._gravity, self._coriolis) if self._reads_force else None,
        )

    def run(
        self, state: StepState, measured: Measured, command: Command, span: Span, table: Any = None
    ) -> Ran:
        """Run the sim steps of a tick, or until an env may have failed."""
        constants = self._spread
        end = span.steps
        target = (None, None)

        def write_targets(values: Values) -> Values:
            nonlocal target
            outputs, pack = values.outputs, self._pack
            # Writing the drives' targets costs a call for each joint.
            if outputs.target is not target[0] and isinstance(pack, DrivenPack):
                is_known = outputs.target_rate is target[1] and target[0] is not None
                rate = (
                    np.zeros_like(outputs.target)
                    if outputs.target_rate is None
                    else outputs.target_rate
                )
                pack.write_drive_target(outputs.target, None if is_known else rate)
                target = outputs.target, outputs.target_rate
            return values

        engine = {
            "targets": write_targets,
            "constraint": self._update_constraint,
            "engine": self._step_engine,
        }
        for index in range(span.begin, end):
            left = self._layout.left(index, end, constants.timestep)
            values = Values(state, command, measured, Step(index, end, left), measured)
            with controller_errors(self._controller, index + 1):
                values = sim_step(self._layout, constants, values, engine)
            before, state, measured = measured.qpos, values.state, values.measured
            if self._failed:
                break
        return Ran(state, values.outputs, measured, before, span.tick, index + 1, self._failed)

    def _update_constraint(self, values: Values) -> Values:
        if values.step.index % COUPLING_STEPS == 0:
            self._pack.update_constraint()
        return values

    def _step_engine(self, values: Values) -> Values:
        """Do a sim step; return its reading as the values' ``measured``, and note whether an env
        may have failed.
        """
        self._pack.write_qf(values.outputs.qf)
        self._pack.step()
        measured = self.measure()
        self._failed = not sound(measured, self._speed_limit)
        return values._replace(measured=measured)

    def rows(self, array: Array) -> Rows:
        """Return an array of the executor as a NumPy array."""
        return array

    def numpy_state(self, state: StepState) -> StepState:
        """Return a state of the executor with NumPy arrays."""
        return state


def with_model(
    options: RunnerOptions,
    pack: EnginePack,
    layout: Layout,
    constants: Constants,
    controller: OwnController | None,
) -> Layout:
    """Return ``layout`` with model functions for NumPy arrays, natively compiled where possible."""
    gravity, coriolis = passive_forces(options)
    model = Model(
        mass_matrix_of(pack.spec, _is_native(pack)),
        partial(_joint_mass_matrix, pack),
        controller=controller,
        noise=NoiseBlocks(),
    )
    if constants.friction.coulomb is not None and _is_native(pack):
        given = constants.friction, constants.drive, constants.coupling, constants.timestep
        model = model._replace(
            refresh=NativeRefresh(
                pack.joint_model(), pack.size, pack.armature, *given, REFRESH_STEPS
            )
        )
    if gravity:
        force = passive_force_of(pack.spec, _is_native(pack))
        parts = gravity, coriolis
        model = model._replace(
            passive_force=lambda qpos, qvel: force(qpos, qvel, *parts, pack.read_base_motion())
        )
    return layout._replace(model=model)


def _is_native(pack: EnginePack) -> TypeGuard[CompiledPack]:
    return isinstance(pack, CompiledPack) and pack.steps_natively


def _joint_mass_matrix(pack: EnginePack, qpos: Float64) -> Float64:
    """Return the effective mass matrix of the joints, armature of the motors included."""
    matrix = pack.joint_mass_matrix(qpos)
    return matrix + pack.armature[:, None] * np.eye(pack.dof) if pack.armature.any() else matrix


BLOCK = 64
"""Sim steps of a block."""


class NoiseBlocks:
    """:func:`batchpid.motors.measurement_noise` at the step of a state, from blocks of consecutive
    steps.
    """

    def __init__(self) -> None:
        self._key: Any = None
        self._first = 0
        self._block: tuple[Array, Array] = (None, None)

    def __call__(
        self, k: MotorCoefficients, state: ActuatorState, like: Float64
    ) -> tuple[Array, Array] | None:
        """Return the noise of positions and velocities; None for sensors without noise."""
        blocks = self.from_step(k, state, like)
        return None if blocks is None else (_first(blocks[0]), _first(blocks[1]))

    def from_step(
        self, k: MotorCoefficients, state: ActuatorState, like: Float64
    ) -> tuple[Array, Array] | None:
        """Return the noise of the step of a state and the next ones (steps, M, dof), as far as it
        has been drawn.

        A reset replaces the key. While the key is the same, all envs advance by the same number of
        steps.
        """
        if state.key is None:
            return None
        at = int(state.step[0]) - self._first
        if state.key is not self._key or not 0 <= at < BLOCK:
            steps = state.step + np.arange(BLOCK, dtype=np.uint32)[:, None]
            self._block = measurement_noise(k, state.key, steps, np.zeros_like(like), np)
            self._key = state.key
            self._first = int(state.step[0])
            at = 0
        position, velocity = self._block
        return None if position is None else position[at:], (
            None if velocity is None else velocity[at:]
        )


def _first(block: Any) -> Array:
    return None if block is None else block[0]
