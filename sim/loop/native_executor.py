"""Sim steps of a tick in native code: control step and engine in one call of the extension for all of them.

:func:`batchpid.sim.loop.control_step.control_step` is traced (:mod:`batchpid.native.tracing`) and runs as a program, on
arrays that hold the state from step to step. Where it cannot be traced (sensors and motors, a caller's own controller),
it runs in NumPy, and one native call applies the efforts, steps the engine and reads it. A sim step in which the
friction model updates its mass matrix runs in the same way.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.native.array_program import ArrayProgram
from batchpid.native.operations import MOST_SUMMED
from batchpid.native.tracing import Symbol, Trace, trace
from batchpid.sim.engine.engines import scene_dynamics
from batchpid.sim.engine.native.interface import STATUS
from batchpid.sim.engine.native.native_tick import NativeTick
from batchpid.sim.engine.protocol import FAILED, CompiledPack, CompiledStep
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import (
    REFRESH_STEPS,
    Constants,
    Layout,
    Measured,
    Model,
    Outputs,
    Step,
    StepState,
    control_step,
)
from batchpid.sim.loop.numpy_executor import NumPyExecutor, Ran
from batchpid.sim.options import RunnerOptions

LOOK = 1 << STATUS.index("not_finite") | 1 << STATUS.index("too_fast")
"""Bits of the status of a sim step after which an env may have failed."""


class NativeExecutor(NumPyExecutor):
    """Executor of control steps in native code, for the robots of ``pack``; ``layout`` has its model functions."""

    _pack: CompiledPack

    def __init__(self, options: RunnerOptions, pack: CompiledPack, layout: Layout, constants: Constants) -> None:
        super().__init__(options, pack, layout, constants)
        self._step: CompiledStep | None = None
        self._bound: object = None
        self._ticks: dict[tuple[bool, bool], TickProgram] = {}
        self._steps_read_force = pack.steps_read_force(self._gravity, self._coriolis)
        reads_all = self._steps_read_force or not self._reads_force
        self._compiles = reads_all and is_compiled(layout, constants, pack.dof)

    def run(self, state: StepState, measured: Measured, command: Command, begin: int, end: int) -> Ran:
        """Run the sim steps of a tick from ``begin`` to ``end``, or until a possible contact or a failed env."""
        if not self._compiles:
            return super().run(state, measured, command, begin, end)
        program = self._program(state, command)
        program.load(state, measured, command)
        done, status = begin, 0
        while done < end and not status:
            due = end if state.age is None else done + REFRESH_STEPS - int(program.state.age.max())
            if due > done:
                done, status = program.run(self._prepared(), done, min(due, end), end)
                continue
            step = Step(done, end, done + 1 == end)
            new, outputs = control_step(self._layout, self._constants, program.state, command, program.measured, step)
            program.take(new, outputs)
            status = self._native_step(program.outputs.qf, *program.reading)
            done += 1
        failed, measured = bool(status & LOOK), program.measured
        if status:
            measured = self._look(status, measured)
        return Ran(program.state, program.outputs, measured, program.before, done, failed)

    def numpy_state(self, state: StepState) -> StepState:
        """Return a copy of ``state``, since the next sim steps overwrite its arrays."""
        return mapped(np.array, state)

    def _advance(self, qf: Float64, index: int) -> tuple[Measured, bool]:
        """Do a sim step by one native call; arguments and results as in :meth:`NumPyExecutor._advance`."""
        qpos, qvel, passive = np.empty((3, *qf.shape))
        status = self._native_step(np.ascontiguousarray(qf, np.float64), qpos, qvel, passive)
        if not self._reads_force:
            passive = None
        elif not self._steps_read_force:
            passive = self._pack.passive_force(self._gravity, self._coriolis)
        measured = Measured(qpos, qvel, passive)
        return (self._look(status, measured) if status else measured), bool(status & LOOK)

    def _native_step(self, *arrays: Float64) -> int:
        return self._prepared()(*arrays)

    def _look(self, status: int, measured: Measured) -> Measured:
        """Handle the event that a sim step reported in ``status``; return the reading."""
        assert self._step is not None
        if status & FAILED:
            raise RuntimeError(self._step.message)
        self._pack.look(self._step.left())
        return measured if self._bound is self._pack.calls else self.measure()

    def _prepared(self) -> CompiledStep:
        """Return the compiled sim step of the present robots and systems."""
        pack = self._pack
        if self._step is None or self._bound is not pack.calls:
            limit = None if self._speed_limit is None else np.asarray(self._speed_limit)
            reads_force = self._reads_force and self._steps_read_force
            force = (self._gravity, self._coriolis) if reads_force else (False, False)
            self._bound, self._step = pack.calls, pack.compiled_step(*force, self._reads_qvel, limit)
        return self._step

    def _program(self, state: StepState, command: Command) -> TickProgram:
        """Return the program for commands with or without rate and feedforward."""
        key = command.setpoint_rate is None, command.feedforward is None
        if key not in self._ticks:
            self._ticks[key] = TickProgram(self._pack, self._layout, self._constants, state, command, self._reads_force)
        return self._ticks[key]


def is_compiled(layout: Layout, constants: Constants, dof: int) -> bool:
    """Return whether the control step can be a program: PID or efforts, ideal motors, no coupling, float64."""
    fits = layout.control in ("pid", "effort") and constants.motors is None and layout.coupling is None
    return fits and dof <= MOST_SUMMED and all(leaf.dtype != np.float32 for leaf in leaves(constants))


class TickProgram:
    """Control step of a group of envs as a program, and its arrays.

    Attributes
    ----------
    state, measured, outputs
        Arrays that the sim steps read and write.
    reading
        ``measured`` with an array for the passive force, even if it is not used.
    before
        Positions before the last sim step (M, dof).
    """

    def __init__(
        self,
        pack: CompiledPack,
        layout: Layout,
        constants: Constants,
        state: StepState,
        command: Command,
        reads_force: bool,
    ) -> None:
        shape, law, matrix = (pack.size, pack.dof), layout.law, None
        if law is not None and law.needs_matrix:
            matrix = np.zeros((*shape, pack.dof) if law.whole else shape)
        self.state = mapped(np.array, state._replace(matrix=matrix))
        self.reading = Measured(*np.zeros((3, *shape)))
        self.measured = self.reading if reads_force else self.reading._replace(passive=None)
        self._command = command.map(lambda rows: np.zeros(shape))
        guarded = None if constants.guard is None else np.zeros(shape, bool)
        self.outputs = Outputs(np.zeros(shape), np.zeros(shape), np.zeros(shape, bool), guarded)
        self.before = np.zeros(shape)
        fixed = self.state._replace(age=None)
        inputs = (fixed, self._command, self.measured)
        traced = _trace(layout._replace(model=Model()), *map(structure, (constants, *inputs)))
        given = leaves(inputs)
        program = ArrayProgram(traced, leaves(constants), len(given), shape)
        results = [*leaves(fixed._replace(matrix=None)), self.outputs.qf, self.outputs.motor, self.outputs.saturated]
        results += [] if guarded is None else [guarded]
        arrays = {**self.reading._asdict(), "before": self.before, "qf": self.outputs.qf}
        if matrix is not None:
            bodies = scene_dynamics(pack.spec).bodies
            tree = np.ascontiguousarray(bodies.tree, np.int32)
            arrays |= {"matrix": self.state.matrix, "tree": tree, "bodies": np.ascontiguousarray(bodies.table())}
            arrays |= {"armature": constants.armature, "damping": constants.damping}
        whole, steps = (False, 1) if law is None else (law.whole, law.matrix_steps)
        self._tick = NativeTick(
            program, given, results, timestep=constants.timestep, matrix_steps=steps, whole=whole, **arrays
        )

    def load(self, state: StepState, measured: Measured, command: Command) -> None:
        """Copy the arguments into the program's arrays, where they are not these arrays."""
        if state is not self.state:
            self._copy(state)
        if measured is not self.measured:
            for array, value in zip(self.measured, measured, strict=True):
                if value is not None:
                    array[...] = value
        for array, value in zip(self._command, command, strict=True):
            if array is not None:
                array[...] = value

    def run(self, step: CompiledStep, begin: int, until: int, end: int) -> tuple[int, int]:
        """Run sim steps from ``begin`` to ``until`` of a tick of ``end`` steps; return steps done and status."""
        done, status = self._tick.run(step.prepare(), begin, until, end)
        if self.state.age is not None:
            self.state.age[...] += done - begin
        return done, status

    def take(self, state: StepState, outputs: Outputs) -> None:
        """Copy the results of a control step in NumPy."""
        self._copy(state)
        self.before[...] = self.measured.qpos
        for name in ("qf", "motor", "saturated", "guarded"):
            if (array := getattr(outputs, name)) is not None:
                getattr(self.outputs, name)[...] = array

    def _copy(self, state: StepState) -> None:
        _write(self.state._replace(matrix=None), state._replace(matrix=None))
        if state.matrix is not None:
            self.state.matrix[...] = state.matrix


@lru_cache(maxsize=64)
def _trace(layout: Layout, *structures: Any) -> Trace:
    """Return the trace of the control step: new state, qf, effort of the motors, saturated and guarded joints.

    ``structures`` describe constants, state, command and reading. No update of mass matrix or friction is due.
    """

    def function(*symbols: Symbol) -> list[Any]:
        given = iter(symbols)
        k, before, command, measured = (filled(each, given) for each in structures)
        model = Model(when=lambda due, function, otherwise: otherwise)
        rubs = k.friction.coulomb is not None
        start = before._replace(age=symbols[0] if rubs else None)
        new, outputs = control_step(layout._replace(model=model), k, start, command, measured, Step(0, 1))
        results = leaves(new._replace(age=None, matrix=None))
        assert len(results) == len(leaves(before._replace(matrix=None)))
        shown = (outputs.qf, outputs.motor, outputs.saturated, outputs.guarded)
        return [*results, *(each for each in shown if each is not None)]

    first = len(leaves(structures[0]))
    return trace(function, first, sum(len(leaves(each)) for each in structures[1:]))


# -- nested named tuples of arrays -------------------------------------------------------------------------------------


def is_leaf(tree: Any) -> bool:
    """Return whether ``tree`` is an array, a symbol, or the place of one (``...``)."""
    return isinstance(tree, np.ndarray | Symbol) or tree is ...


def leaves(tree: Any) -> list[Any]:
    """Return the arrays in a nested tuple, in order."""
    if is_leaf(tree):
        return [tree]
    return [leaf for part in tree for leaf in leaves(part)] if isinstance(tree, tuple) else []


def mapped(function: Any, tree: Any) -> Any:
    """Return a nested tuple with ``function`` applied to its arrays."""
    if is_leaf(tree):
        return function(tree)
    if not isinstance(tree, tuple) or not tree:
        return tree
    parts = [mapped(function, part) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def structure(tree: Any) -> Any:
    """Return a nested tuple with ``...`` in place of each array; it is hashable."""
    return mapped(lambda _: ..., tree)


def filled(tree: Any, given: Any) -> Any:
    """Return a structure with its places filled from an iterator."""
    return mapped(lambda _: next(given), tree)


def _write(to: Any, values: Any) -> None:
    """Copy the arrays of a nested tuple into another one of the same structure."""
    for array, value in zip(leaves(to), leaves(values), strict=True):
        array[...] = value
