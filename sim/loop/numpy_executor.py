"""Sim steps of a tick in NumPy, stage by stage: the oracle of the other executors, and the executor
of controllers in Python.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64, Rows
from batchpid.sim.engine.protocol import CompiledStep, EnginePack
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import COUPLING_STEPS, sim_step
from batchpid.sim.loop.custom import controller_errors
from batchpid.sim.loop.faults import is_near
from batchpid.sim.loop.step_setup import Setup, moves_drives
from batchpid.sim.loop.step_values import (
    Constants,
    Layout,
    Measured,
    Outputs,
    Step,
    StepState,
    Values,
)


class NumPyExecutor:
    """Executor of the sim steps of the robots of ``setup``, from the control's ``state`` on.

    Attributes
    ----------
    measured
        Reading of the robots before the next sim step.
    outputs
        Results of the last sim step.
    before
        Positions before the last sim step (M, dof).
    failed
        Whether an env may have failed in the last sim step.
    """

    def __init__(self, setup: Setup, state: StepState) -> None:
        self.setup = setup
        self._state = state
        self._first = 0
        self._engine = EngineSteps(setup)
        self.outputs = Outputs()
        self.before: Any = None
        self.failed = False
        self.measure()

    def measure(self) -> None:
        """Read the robots, after a change of their states between sim steps."""
        self.measured = self._engine.measure()

    def qpos(self) -> Float64:
        """Return the positions of the last reading (M, dof)."""
        qpos: Float64 = self.measured.qpos
        return qpos

    def read_state(self) -> StepState:
        """Return the state of the control as NumPy arrays, which the next sim steps do not
        change.
        """
        return self._state

    def write_state(self, state: StepState) -> None:
        """Replace the state of the control; it has the arrays of the state before."""
        self._state = state

    def results(self) -> Outputs:
        """Return the results of the last sim step as NumPy arrays."""
        return self.outputs

    def run(
        self,
        command: Command,
        moves: bool,
        begin: int,
        end: int,
    ) -> int:
        """Run sim steps ``begin`` to ``end`` of a tick under ``command`` (M, ...), or until an env
        may have failed; return the sim steps of the tick that are done.

        ``moves`` says whether joint setpoints move within the tick, at the given rate.

        Raises ControllerError if a controller in Python does.
        """
        setup = self.setup
        constants = setup.constants
        layout = setup.layout._replace(moves=moves)
        self._first = begin
        engine = {
            "targets": self._write_targets,
            "constraint": self._update_constraint,
            "engine": self._step_engine,
        }
        for index in range(begin, end):
            step = Step(index, end, layout.left(index, end, constants.timestep))
            self.before = self.measured.qpos  # where a robot that fails now is suspended
            values = Values(self._state, command, self.measured, step, self.measured)
            with controller_errors(setup.controller, index + 1):
                values = sim_step(layout, constants, values, engine)
            self._state = values.state
            self.outputs = values.outputs
            self.measured = values.measured
            if self.failed:
                return index + 1
        return end

    def _write_targets(self, layout: Layout, constants: Constants, values: Values) -> Values:
        """Write the targets of the drives where they move, since it costs a call for each joint."""
        pack: Any = self.setup.pack
        if values.step.index == self._first or moves_drives(layout, constants):
            pack.write_drive_target(values.outputs.target, values.outputs.target_rate)
        return values

    def _update_constraint(self, layout: Layout, constants: Constants, values: Values) -> Values:
        if values.step.index % COUPLING_STEPS == 0:
            self.setup.pack.update_constraint()
        return values

    def _step_engine(self, layout: Layout, constants: Constants, values: Values) -> Values:
        measured, self.failed = self._engine.advance(values.outputs.qf)
        return values._replace(measured=measured)


class EngineSteps:
    """Sim steps of the engine for the robots of ``setup``, and their readings: one native call
    each where the engine has it, else calls of Python.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._pack: EnginePack = setup.pack
        layout = setup.layout
        self.reads_force = layout.gravity and not layout.measures
        """Whether a reading has the passive force, which is otherwise 0."""
        self._parts = layout.gravity, layout.coriolis
        self._is_native = setup.pack.steps_natively
        self.native_force = False
        """Whether the native sim step reads the passive force."""
        if self._is_native:
            self.native_force = self.reads_force and setup.pack.steps_read_force(*self._parts)
        self._step: CompiledStep | None = None
        self._bound: object = None

    def measure(self) -> Measured:
        """Return a reading of the robots."""
        qpos = self._pack.read_qpos()
        qvel = self._pack.read_qvel()
        return Measured(qpos, qvel, self._passive_force(qpos))

    def advance(self, qf: Rows) -> tuple[Measured, bool]:
        """Do a sim step with the efforts ``qf`` (M, dof); return the reading after it, and whether
        an env may have failed.
        """
        if not self._is_native:
            self._pack.write_qf(qf)
            self._pack.step()
            measured = self.measure()
            limit = self._setup.options.speed_limit
            is_slow = limit is None or bool((np.abs(measured.qvel) <= limit).all())
            return measured, not (is_near(measured.qpos) and is_slow)
        step = self.compiled()
        qpos, qvel, passive = np.empty((3, *qf.shape))
        status = step(np.ascontiguousarray(qf, np.float64), qpos, qvel, passive)
        if not self.native_force:
            passive = self._passive_force(qpos)
        return Measured(qpos, qvel, passive), step.may_have_failed(status)

    def compiled(self) -> CompiledStep:
        """Return the native sim step of the present robots."""
        pack = self._pack
        if self._step is None or self._bound is not pack.calls:
            if self.native_force:
                parts = self._parts
            else:
                parts = (False, False)
            drives = self._setup.layout.control == "drive"
            self._bound = pack.calls
            self._step = pack.compiled_step(*parts, self._setup.options.speed_limit, drives)
        return self._step

    def _passive_force(self, like: Float64) -> Float64:
        if self.reads_force:
            return self._pack.passive_force(*self._parts)
        return np.zeros_like(like)
