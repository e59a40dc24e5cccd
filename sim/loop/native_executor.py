"""Sim steps of a tick in native code: control step and engine in one call of the extension for all of them.

:func:`batchpid.sim.loop.control_step.control_step` is traced (:mod:`batchpid.native.tracing`) and runs as a program, on
arrays that hold the state from step to step. Sensors are a program of their own, since their noise, and the passive
force at the measured state, are computed in Python: then each sim step is a call, and so it is where the passive force
of the joints' state is (masses that vary). Where the control step cannot be traced (a caller's own controller, drives
whose targets move within a tick), it runs in NumPy, and one native call applies the efforts, steps the engine and reads
it. A sim step in which the friction model updates its mass matrix runs in the same way.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.motors import ActuatorState, advance_measurement
from batchpid.native.array_program import ArrayProgram
from batchpid.native.operations import MOST_SUMMED
from batchpid.native.tracing import Stack, Symbol, Trace, trace
from batchpid.sim.engine.engines import scene_dynamics
from batchpid.sim.engine.native.interface import STATUS
from batchpid.sim.engine.native.native_tick import NativeTick
from batchpid.sim.engine.protocol import FAILED, CompiledPack, CompiledStep, DrivenPack
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
        self._calls_force = self._reads_force and not self._steps_read_force
        self._compiles = is_compiled(layout, constants, pack.dof)
        if options.backend == "jax" and layout.law is not None:  # the law is XLA's
            self._compiles &= constants.motors is None and not self._calls_force

    def run(self, state: StepState, measured: Measured, command: Command, begin: int, end: int) -> Ran:
        """Run the sim steps of a tick from ``begin`` to ``end``, or until a possible contact or a failed env."""
        if not self._compiles:
            return super().run(state, measured, command, begin, end)
        program = self._program(state, command)
        program.load(state, measured, command)
        if self._layout.control == "drive" and isinstance(self._pack, DrivenPack):
            rate = command.setpoint_rate
            self._pack.write_drive_target(command.setpoint, np.zeros_like(command.setpoint) if rate is None else rate)
        by_step, done, status = self._layout.measures or self._calls_force, begin, 0
        while done < end and not status:
            due = end if state.age is None else done + REFRESH_STEPS - int(program.state.age.max())
            if due > done:
                if self._layout.measures:
                    self._measure(program)
                done, status = program.run(self._prepared(), done, done + 1 if by_step else min(due, end), end)
            else:
                step, now = Step(done, end, done + 1 == end), (program.state, command, program.measured)
                program.take(*control_step(self._layout, self._constants, *now, step))
                status = self._native_step(program.outputs.qf, *program.reading)
                done += 1
            if self._calls_force:
                program.reading.passive[...] = self._pack.passive_force(self._gravity, self._coriolis)
        failed, measured = bool(status & LOOK), program.measured
        if status:
            measured = self._look(status, measured)
        return Ran(program.state, program.outputs, measured, program.before, done, failed)

    def _measure(self, program: TickProgram) -> None:
        """Advance the sensors, and compute the passive force at the measured state, if it is compensated."""
        model, motors = self._layout.model, program.state.motors
        noise = model.noise(self._constants.motors, motors, program.reading.qpos)
        seen = program.measure(*((None, None) if noise is None else noise))
        if model.passive_force is not None:
            program.reading.passive[...] = model.passive_force(*seen)

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
            self._ticks[key] = TickProgram(self._pack, self._layout, self._constants, state, command, self._gravity)
        return self._ticks[key]


def is_compiled(layout: Layout, constants: Constants, dof: int) -> bool:
    """Return whether the control step can be a program: no own controller, targets of drives that rest, float64."""
    rests = constants.driven is None and constants.guard is None
    fits = layout.control in ("pid", "effort") or (layout.control == "drive" and rests)
    return (
        fits
        and layout.coupling is None
        and dof <= MOST_SUMMED
        and all(leaf.dtype != np.float32 for leaf in leaves(constants))
    )


class TickProgram:
    """Control step of a group of envs as a program, and its arrays; ``gravity``: it takes a passive force.

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
        gravity: bool,
    ) -> None:
        shape, law, matrix = (pack.size, pack.dof), layout.law, None
        if law is not None and law.needs_matrix:
            matrix = np.zeros((*shape, pack.dof) if law.whole else shape)
        self.state = mapped(partial(np.array, order="C"), state._replace(matrix=matrix))
        self.reading = Measured(*np.zeros((3, *shape)))
        self.measured = self.reading if gravity else self.reading._replace(passive=None)
        self._seen = tuple(np.zeros((2, *shape))) if layout.measures else None
        self._constants = mapped(stacked, constants)
        self._sensors: tuple[ArrayProgram, list[Float64], list[Float64]] | None = None
        self._command = command.map(lambda rows: np.zeros(shape))
        guarded = None if constants.guard is None else np.zeros(shape, bool)
        saturated = None if layout.control == "drive" else np.zeros(shape, bool)
        self.outputs = Outputs(np.zeros(shape), np.zeros(shape), saturated, guarded)
        self.before = np.zeros(shape)
        fixed = self.state._replace(age=None, motors=_motor_side(self.state.motors))
        inputs = (fixed, self._command, self.measured, self._seen)
        traced = _trace(layout._replace(model=Model()), *map(structure, (self._constants, *inputs)))
        given = leaves(inputs)
        program = ArrayProgram(traced, leaves(self._constants), len(given), shape)
        results = [*leaves(_returned(fixed)), *leaves(self.outputs)]
        arrays = {**self.reading._asdict(), "before": self.before, "qf": self.outputs.qf}
        if matrix is not None:
            bodies = scene_dynamics(pack.spec).bodies
            tree = np.ascontiguousarray(bodies.tree, np.int32)
            arrays |= {"matrix": self.state.matrix, "tree": tree, "bodies": np.ascontiguousarray(bodies.table())}
            arrays |= {} if self._seen is None else dict(zip(("pose", "rate"), self._seen, strict=True))
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
        if self.state.motors is not None and self.state.motors.step is not None:
            self.state.motors.step[...] += done - begin
        return done, status

    def measure(self, *noise: Float64 | None) -> Any:
        """Advance the sensors with the noise of positions and velocities; return both as measured, but for a step.

        Only :meth:`run` counts the step.
        """
        drawn = [each for each in noise if each is not None]
        if self._sensors is None:
            side, k = _sensor_side(self.state.motors), self._constants.motors
            inputs = (side, *self.reading[:2])
            traced = _trace_sensors(*map(structure, (k, *inputs, noise)))
            fixed, shape = leaves(inputs), self.before.shape
            program = ArrayProgram(traced, leaves(k), len(fixed) + len(drawn), shape)
            self._sensors = program, fixed, [*leaves(side.encoder), *leaves(self._seen)]
        program, fixed, out = self._sensors
        program(*fixed, *drawn, out=out)
        return self._seen

    def take(self, state: StepState, outputs: Outputs) -> None:
        """Copy the results of a control step in NumPy."""
        self._copy(state)
        self.before[...] = self.measured.qpos
        for name in ("qf", "motor", "saturated", "guarded"):
            if (array := getattr(outputs, name)) is not None:
                getattr(self.outputs, name)[...] = array

    def _copy(self, state: StepState) -> None:
        _write(_copied(self.state), _copied(state))
        if state.matrix is not None:
            self.state.matrix[...] = state.matrix
        if state.motors is not None:  # the same object, by which the executor knows its noise
            self.state = self.state._replace(motors=self.state.motors._replace(key=state.motors.key))


@lru_cache(maxsize=64)
def _trace(layout: Layout, *structures: Any) -> Trace:
    """Return the trace of the control step: new state, qf, effort of the motors, saturated and guarded joints.

    ``structures`` describe constants, state, command, reading, and what the sensors measure. No update of mass matrix
    or friction is due.
    """

    def function(*symbols: Symbol) -> list[Any]:
        given = iter(symbols)
        k, before, command, measured, seen = (filled(each, given) for each in structures)
        model = Model(when=lambda due, function, otherwise: otherwise)
        if seen is not None:
            model = model._replace(measure=lambda k, motors, *_: (motors, *seen))
        rubs = k.friction.coulomb is not None
        start = before._replace(age=symbols[0] if rubs else None)
        new, outputs = control_step(layout._replace(model=model), k, start, command, measured, Step(0, 1))
        results = leaves(_returned(new._replace(age=None)))
        assert len(results) == len(leaves(_returned(before)))
        return [*results, *leaves(outputs._replace(returned=None, target=None, target_rate=None))]

    first = len(leaves(structures[0]))
    return trace(function, first, sum(len(leaves(each)) for each in structures[1:]))


@lru_cache(maxsize=64)
def _trace_sensors(*structures: Any) -> Trace:
    """Return the trace of the sensors: position of the encoder, and measured positions and velocities.

    ``structures`` describe coefficients, state, positions, velocities and noise.
    """

    def function(*symbols: Symbol) -> list[Any]:
        given = iter(symbols)
        new, *seen = advance_measurement(*(filled(each, given) for each in structures))
        return [*leaves(new.encoder), *seen]

    first = len(leaves(structures[0]))
    return trace(function, first, sum(len(leaves(each)) for each in structures[1:]))


def _motor_side(motors: ActuatorState | None) -> ActuatorState | None:
    """Return the state of the motors without the sensors' state."""
    return None if motors is None else ActuatorState(motors.command, motors.effort)


def _sensor_side(motors: ActuatorState) -> ActuatorState:
    """Return the part of the sensors' state that their program has: without key and step."""
    return ActuatorState(sensor=motors.sensor, encoder=motors.encoder)


def _returned(state: StepState) -> StepState:
    """Return the part of a state that programs return: without matrices, and histories, which they change in place."""
    motors = None if state.motors is None else state.motors._replace(command=None)
    return state._replace(matrix=None, motors=motors)


def _copied(state: StepState) -> StepState:
    """Return the part of a state whose arrays keep their structure: without matrices and the key of the noise."""
    motors = None if state.motors is None else state.motors._replace(key=None)
    return state._replace(matrix=None, motors=motors)


# -- nested named tuples of arrays -------------------------------------------------------------------------------------


def is_leaf(tree: Any) -> bool:
    """Return whether ``tree`` is an array, a symbol, or the place of one (``...``)."""
    return isinstance(tree, np.ndarray | Symbol) or tree is ...


def stacked(array: Any) -> Any:
    """Return an array (n, envs, dof) as a stack of n arrays, and other arrays unchanged."""
    return Stack(array) if array.ndim == 3 else array


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
    return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)


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
