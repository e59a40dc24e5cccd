"""Ticks in native code: one call of the extension runs them until an event needs Python.

With a controller in Python, or more than MOST_SUMMED joints, the stages run in NumPy. One native
call then applies efforts, does the engine's step and reads the state.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.arrays.trees import leaves, mapped
from batchpid.native.operations import MOST_SUMMED
from batchpid.sim.engine.protocol import CompiledModel, CompiledPack, CompiledStep, DrivenPack
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.native_ticks import NativeTicks, Table
from batchpid.sim.loop.numpy_executor import NumPyExecutor, Ran, Span
from batchpid.sim.loop.step_values import Constants, Layout, Measured, StepState, Values
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.tool_space.osc_controller import OperationalSpace


class NativeExecutor(NumPyExecutor):
    """Executor of control steps in native code, for the robots of ``pack``; ``layout`` has its
    model functions.
    """

    _pack: CompiledPack

    def __init__(
        self, options: RunnerOptions, pack: CompiledPack, layout: Layout, constants: Constants
    ) -> None:
        super().__init__(options, pack, layout, constants)
        self._step: CompiledStep | None = None
        self._bound: object = None
        self._ticks: dict[tuple[bool, ...], NativeTicks] = {}
        self._reads_qvel = True  # for the observation
        self._steps_read_force = pack.steps_read_force(self._gravity, self._coriolis)
        self._force: CompiledModel | None = None
        if (layout.measures and self._gravity) or (
            self._reads_force and not self._steps_read_force
        ):
            self._force = pack.force_model()
        has_native_law = layout.control != "custom" or _is_native(self._controller)
        self._compiles = has_native_law and is_compiled(constants, pack.dof)

    def run(
        self,
        state: StepState,
        measured: Measured,
        command: Command,
        span: Span,
        table: Table | None = None,
    ) -> Ran:
        """Run sim steps until an event needs Python: an env may have failed, or a command is not
        finite.

        With ``table``, its ticks run: commands are read from it, and observations are written to
        it. Otherwise one tick runs under ``command``.
        """
        if not self._compiles:
            return super().run(state, measured, command, span)
        if self._layout.control == "custom":  # a native controller takes setpoints from Python
            table = None
        ticks = self._ticks_for(state, command)
        ticks.load(state, measured, None if table else command)
        if table:
            ticks.exchange(table)
        until = span.until if table else span.tick + 1
        tick, done, status = ticks.run(
            self._prepared(), span.tick, span.begin, until, span.steps, table is not None
        )
        failed = self._prepared().may_have_failed(status)
        return Ran(ticks.state, ticks.outputs, ticks.measured, ticks.before, tick, done, failed)

    def numpy_state(self, state: StepState) -> StepState:
        """Return a copy of ``state``, since the next sim steps overwrite its arrays."""
        own = (
            {name: np.array(leaf) for name, leaf in state.law.items()}
            if isinstance(state.law, dict)
            else state.law
        )
        return mapped(np.array, state._replace(law=own))

    def _step_engine(self, values: Values) -> Values:
        """Do a sim step by one native call; see :meth:`NumPyExecutor._step_engine`."""
        qf = values.outputs.qf
        qpos, qvel, passive = np.empty((3, *qf.shape))
        status = self._prepared()(np.ascontiguousarray(qf, np.float64), qpos, qvel, passive)
        if not self._reads_force:
            passive = None
        elif not self._steps_read_force:
            passive = self._pack.passive_force(self._gravity, self._coriolis)
        self._failed = self._prepared().may_have_failed(status)
        return values._replace(measured=Measured(qpos, qvel, passive))

    def _prepared(self) -> CompiledStep:
        """Return the compiled sim step of the present robots and systems."""
        pack = self._pack
        if self._step is None or self._bound is not pack.calls:
            limit = None if self._speed_limit is None else np.asarray(self._speed_limit)
            reads_force = self._reads_force and self._steps_read_force
            force = (self._gravity, self._coriolis) if reads_force else (False, False)
            drives = self._layout.control == "drive" and isinstance(pack, DrivenPack)
            self._bound, self._step = (
                pack.calls,
                pack.compiled_step(*force, self._reads_qvel, limit, drives),
            )
        return self._step

    def _ticks_for(self, state: StepState, command: Command) -> NativeTicks:
        """Return the ticks for commands with these arrays."""
        key = command.given
        if key not in self._ticks:
            compensated = self._gravity, self._coriolis
            given = (
                self._layout,
                self._constants,
                state,
                command,
                compensated,
                self._controller,
                self._force,
            )
            self._ticks[key] = NativeTicks(self._pack, *given)
        return self._ticks[key]


def _is_native(controller: Any) -> bool:
    """Return whether a controller is native: operational-space control."""
    if not isinstance(controller, OperationalSpace):
        return False
    return controller.bound(*np.zeros((3, 1, controller.tree.dof))) is not None


def is_compiled(constants: Constants, dof: int) -> bool:
    """Return whether the control step can be a program: in float64, with at most MOST_SUMMED
    joints.
    """
    return dof <= MOST_SUMMED and all(leaf.dtype != np.float32 for leaf in leaves(constants))
