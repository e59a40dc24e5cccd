"""Sim steps of a tick in native code: one call of the extension runs control step and engine for all of them.

:func:`batchpid.sim.loop.control_step.control_step` is traced (:mod:`batchpid.native.tracing`) and runs as a program, on
arrays that hold the state between steps. Before and after it, native code updates the inertia of the friction model and
the constraint of coupled joints, and writes the targets of drives. It also computes the passive force, if the law needs
another one than the engine's. Sensors have a separate program; Python draws their noise for 64 sim steps at once.
Operational-space control is a native call before the program, which takes its effort as an input. With a controller in
Python, or too many joints, the control step runs in NumPy, and one native call applies efforts, steps and reads.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.native.operations import MOST_SUMMED
from batchpid.native.trees import leaves, mapped
from batchpid.sim.engine.native_model import NativeModel
from batchpid.sim.engine.protocol import FAILED, CompiledModel, CompiledPack, CompiledStep, DrivenPack
from batchpid.sim.loop.arrays import Arrays, Command
from batchpid.sim.loop.control_step import Constants, Layout, Measured, StepState
from batchpid.sim.loop.numpy_executor import COUPLING_STEPS, NumPyExecutor, Ran, Stopped
from batchpid.sim.loop.quiet_ticks import QuietTicks, Shown
from batchpid.sim.loop.tick_program import TickProgram
from batchpid.sim.options import RunnerOptions
from batchpid.sim.tool_space.osc_controller import OperationalSpace


class NativeExecutor(NumPyExecutor):
    """Executor of control steps in native code, for the robots of ``pack``; ``layout`` has its model functions."""

    _pack: CompiledPack

    def __init__(self, options: RunnerOptions, pack: CompiledPack, layout: Layout, constants: Constants) -> None:
        super().__init__(options, pack, layout, constants)
        self._step: CompiledStep | None = None
        self._bound: object = None
        self._ticks: dict[tuple[bool, ...], TickProgram] = {}
        self._steps_read_force = pack.steps_read_force(self._gravity, self._coriolis)
        self._force: CompiledModel | None = None
        if layout.measures and self._gravity:
            self._force = NativeModel(pack.spec)
        elif self._reads_force and not self._steps_read_force:
            self._force = pack.force_model()
        has_own_law = options.backend == "numpy" or layout.law is None  # under "jax" the law is XLA's
        if layout.control == "custom":
            has_own_law = options.backend == "numpy" and _is_native(self._controller)
        self._compiles = has_own_law and is_compiled(constants, pack.dof)

    def run(self, state: StepState, measured: Measured, command: Command, begin: int, end: int) -> Ran:
        """Run the sim steps of a tick from ``begin`` to ``end``, or until an env may have failed."""
        if not self._compiles:
            return super().run(state, measured, command, begin, end)
        program = self._program(state, command)
        program.load(state, measured, command)
        if self._layout.control == "drive" and isinstance(self._pack, DrivenPack) and program.outputs.target is None:
            rate = command.setpoint_rate
            self._pack.write_drive_target(command.setpoint, np.zeros_like(command.setpoint) if rate is None else rate)
        done, status = begin, 0
        while done < end and not status:
            done, status = program.run(self._prepared(), done, end)
        return self._ran(program, done, status)

    def _ran(self, program: TickProgram, done: int, status: int) -> Ran:
        """Return the result of ``done`` sim steps of a tick, of which the last had this status."""
        failed = self._may_have_failed(status)
        return Ran(program.state, program.outputs, program.measured, program.before, done, failed)

    def quiet_ticks(self, state: StepState, command: Command, arrays: Arrays, shown: Shown) -> QuietTicks | None:
        """Return ticks in one call, for commands with the entries of ``command``; None if each tick needs Python."""
        layout = self._layout
        is_whole = self._compiles and self._reads_qvel and not layout.measures
        if not (is_whole and layout.control in ("pid", "effort")):
            return None
        return QuietTicks(self._program(state, command), arrays, shown)

    def run_ticks(
        self, ticks: QuietTicks, state: StepState, measured: Measured, first: int, until: int, steps: int
    ) -> Stopped:
        """Run ticks of ``steps`` sim steps from ``first`` to ``until``, or until an event needs Python."""
        program = ticks.program
        program.load(state, measured, None)
        tick, done, status = ticks.run(self._prepared(), first, until, steps)
        return Stopped(tick, partial(self._ran, program, done, status) if done else None)

    def numpy_state(self, state: StepState) -> StepState:
        """Return a copy of ``state``, since the next sim steps overwrite its arrays."""
        own = {name: np.array(leaf) for name, leaf in state.law.items()} if isinstance(state.law, dict) else state.law
        return mapped(np.array, state._replace(law=own))

    def _advance(self, qf: Float64, index: int) -> tuple[Measured, bool]:
        """Do a sim step by one native call; arguments and results as in :meth:`NumPyExecutor._advance`."""
        if index % COUPLING_STEPS == 0:
            self._pack.update_constraint()
        qpos, qvel, passive = np.empty((3, *qf.shape))
        status = self._prepared()(np.ascontiguousarray(qf, np.float64), qpos, qvel, passive)
        if not self._reads_force:
            passive = None
        elif not self._steps_read_force:
            passive = self._pack.passive_force(self._gravity, self._coriolis)
        return Measured(qpos, qvel, passive), self._may_have_failed(status)

    def _may_have_failed(self, status: int) -> bool:
        """Return whether an env may have failed in a sim step; RuntimeError if the engine has."""
        if status & FAILED:
            raise RuntimeError(self._prepared().message)
        return bool(status)

    def _prepared(self) -> CompiledStep:
        """Return the compiled sim step of the present robots and systems."""
        pack = self._pack
        if self._step is None or self._bound is not pack.calls:
            limit = None if self._speed_limit is None else np.asarray(self._speed_limit)
            reads_force = self._reads_force and self._steps_read_force
            force = (self._gravity, self._coriolis) if reads_force else (False, False)
            drives = self._layout.control == "drive" and isinstance(pack, DrivenPack)
            self._bound, self._step = pack.calls, pack.compiled_step(*force, self._reads_qvel, limit, drives)
        return self._step

    def _program(self, state: StepState, command: Command) -> TickProgram:
        """Return the program for commands with these arrays."""
        key = command.given
        if key not in self._ticks:
            self._ticks[key] = TickProgram(
                self._pack,
                self._layout,
                self._constants,
                state,
                command,
                (self._gravity, self._coriolis),
                self._controller,
                self._force,
                COUPLING_STEPS,
            )
        return self._ticks[key]


def _is_native(controller: Any) -> bool:
    """Return whether a controller is native: operational-space control."""
    if not isinstance(controller, OperationalSpace):
        return False
    return controller.bound(*np.zeros((3, 1, controller.tree.dof))) is not None


def is_compiled(constants: Constants, dof: int) -> bool:
    """Return whether the control step can be a program: in float64, with at most MOST_SUMMED joints."""
    return dof <= MOST_SUMMED and all(leaf.dtype != np.float32 for leaf in leaves(constants))
