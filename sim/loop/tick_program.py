"""Program of the sim steps of a tick: the control step, traced, with the arrays that hold the state between them."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.motors import ActuatorState, advance_measurement
from batchpid.native.array_program import ArrayProgram
from batchpid.native.symbols import Stack, Symbol
from batchpid.native.tracing import Trace, trace
from batchpid.native.trees import filled, leaves, mapped, structure
from batchpid.sim.engine.native.native_tick import NativeTick
from batchpid.sim.engine.protocol import CompiledModel, CompiledPack, CompiledStep
from batchpid.sim.engine.robot_model import scene_tree
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import (
    Constants,
    Layout,
    Measured,
    Model,
    Outputs,
    Step,
    StepState,
    control_step,
    feedforward,
)


class TickProgram:
    """Control step of a group of envs as a program, and its arrays.

    ``compensated`` says whether gravity is compensated, and whether Coriolis and centrifugal forces are. A
    ``controller`` (:class:`batchpid.sim.OperationalSpace`) runs as a native call before the program. ``force`` is the
    model of the passive force where the engine's steps do not read it. Constraint efforts keep their mass matrix for
    ``coupling_steps``.

    Attributes
    ----------
    state, command, measured, outputs
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
        compensated: tuple[bool, bool],
        controller: Any,
        force: CompiledModel | None,
        coupling_steps: int,
    ) -> None:
        shape, law, matrix = (pack.size, pack.dof), layout.law, None
        if law is not None and law.needs_matrix:
            matrix = np.zeros((*shape, pack.dof) if law.whole else shape)
        self.state = mapped(partial(np.array, order="C"), state._replace(matrix=matrix))
        self.reading = Measured(*np.zeros((3, *shape)))
        self.measured = self.reading if compensated[0] else self.reading._replace(passive=None)
        self._seen = tuple(np.zeros((2, *shape))) if layout.measures else None
        self._constants = mapped(_stacked, constants)
        self.before = np.zeros(shape)
        at = self.reading[:2] if self._seen is None else self._seen
        self.command = command.map(lambda rows: np.zeros(shape))
        if controller is not None:  # it has its own copy of setpoints, of any size
            self.command = self.command._replace(setpoint=None)
        forward = None if controller is None else self._make_forward()
        bias = self.reading.passive if forward is None else forward[-1][0]
        self._control = None if controller is None else controller.bound(*at, bias)
        self._kept = force, layout.model.refresh
        self._noise = layout.model.noise
        self._sensors = self._make_sensors() if layout.measures else None
        if self._control is not None:
            self.state = self.state._replace(law=self._control.state)
        guarded = None if constants.guard is None else np.zeros(shape, bool)
        saturated = None if layout.control == "drive" else np.zeros(shape, bool)
        self.outputs = Outputs(np.zeros(shape), np.zeros(shape), saturated, guarded)
        arrays = {**self.reading._asdict(), "before": self.before, "qf": self.outputs.qf}
        left = None if command.setpoint_rate is None else np.zeros(())
        if moves_drives(layout, constants, command):
            target, rate = np.zeros((2, *shape))
            arrays |= {"target": target, "target_rate": rate}
            known = None if command.setpoint_rate is None else rate
            self.outputs = self.outputs._replace(target=target, target_rate=known)
        if self._control is not None:
            self.outputs = self.outputs._replace(returned=self._control.effort)
        fixed = self.state._replace(age=None, motors=_motor_side(self.state.motors))
        if self._control is not None:
            fixed = fixed._replace(law=None)
        limited = None if self._control is None else self._control.limited
        inputs = (fixed, self.command, self.measured, self._seen, self.outputs.returned, limited, left)
        traced = _trace(layout._replace(model=Model()), *map(structure, (self._constants, *inputs)))
        given = leaves(inputs)
        program = ArrayProgram(traced, leaves(self._constants), len(given), shape)
        results = [*leaves(_returned(fixed)), *leaves(self.outputs._replace(returned=None))]
        if self._seen is not None:
            arrays |= zip(("pose", "rate"), self._seen, strict=True)
        if (age := self.state.age) is not None:
            arrays |= {"age": age, "gain": self.state.friction.gain, "memory": self.state.friction.memory}
        if matrix is not None:
            tree, bodies = scene_tree(pack.spec).tables
            arrays |= {"matrix": self.state.matrix, "tree": tree, "bodies": bodies}
            arrays |= {"armature": constants.armature, "damping": constants.damping}
            arrays |= constants.coupling.native()
        whole, steps = (False, 1) if law is None else (law.whole, law.matrix_steps)
        self._tick = NativeTick(
            program,
            given,
            results,
            timestep=constants.timestep,
            matrix_steps=steps,
            whole=whole,
            control=None if self._control is None else self._control.address,
            compensated=compensated,
            refresh=None if age is None else layout.model.refresh.address,
            coupling_steps=coupling_steps,
            sensors=self._sensors,
            forward=forward,
            measured_force=force.address if force is not None and layout.measures else None,
            read_force=None if force is None or layout.measures else force.address,
            late=layout.late,
            left=left,
            **arrays,
        )

    def load(self, state: StepState, measured: Measured, command: Command | None) -> None:
        """Copy the arguments into the program's arrays, where they are not these arrays."""
        if state is not self.state:
            self._copy(state)
        if measured is not self.measured:
            for array, value in zip(self.measured, measured, strict=True):
                if value is not None:
                    array[...] = value
        if command is None:
            return
        if self._control is not None:
            self._control.load(command.setpoint)
        for array, value in zip(self.command, command, strict=True):
            if array is not None:
                array[...] = value

    def run(self, step: CompiledStep, begin: int, end: int) -> tuple[int, int]:
        """Run sim steps from ``begin`` on of a tick of ``end`` steps; return steps done and status.

        Fewer steps are done after an event, and where the noise of the sensors has to be drawn.
        """
        noise = [] if self._sensors is None else leaves(self._draw())
        until = min([end, *(begin + len(block) for block in noise)])
        done, status = self._tick.run(step.prepare(), begin, until, end, *noise)
        self._count(done - begin)
        return done, status

    def run_ticks(self, step: CompiledStep, transfers: Any, first: int, until: int, steps: int) -> tuple[int, int, int]:
        """Run ticks as :meth:`batchpid.sim.engine.native.native_tick.NativeTick.run_ticks` does."""
        tick, done, status = self._tick.run_ticks(step.prepare(), transfers, first, until, steps)
        self._count((tick - first) * steps + done)
        return tick, done, status

    def _count(self, steps: int) -> None:
        """Count sim steps in the state of the motors."""
        if self.state.motors is not None and self.state.motors.step is not None:
            self.state.motors.step[...] += steps

    def _draw(self) -> tuple[Any, Any]:
        """Return the noise of positions and velocities in the next steps (steps, M, dof) each, or None."""
        return self._noise.from_step(self._constants.motors, self.state.motors, self.before) or (None, None)

    def _make_forward(self) -> tuple[ArrayProgram, list[Float64], list[Float64]] | None:
        """Return the program of a controller's feedforward, its inputs and its output; None for the passive force."""
        command, passive = self.command, self.measured.passive
        if command.feedforward is None and (passive is None or self._constants.coupling.is_identity):
            return None
        inputs, k = leaves((command, passive)), self._constants
        traced = _trace_forward(*map(structure, (k, command, passive)))
        program = ArrayProgram(traced, leaves(k), len(inputs), self.reading.qpos.shape)
        return program, inputs, [np.zeros_like(self.reading.qpos)]

    def _make_sensors(self) -> tuple[ArrayProgram, list[Float64], list[Float64]]:
        """Return the program of the sensors, its inputs and its outputs."""
        assert self.state.motors is not None
        side, k = _sensor_side(self.state.motors), self._constants.motors
        noise = mapped(lambda block: block[0].copy(), self._draw())
        drawn, fixed = leaves(noise), leaves((side, *self.reading[:2]))
        traced = _trace_sensors(*map(structure, (k, side, *self.reading[:2], noise)))
        inputs = [*fixed, *drawn]
        program = ArrayProgram(traced, leaves(k), len(inputs), self.reading.qpos.shape)
        return program, inputs, [*leaves(side.encoder), *leaves(self._seen)]

    def _copy(self, state: StepState) -> None:
        if self._control is not None:
            self._control.set_state(state.law)
        _write(_copied(self.state), _copied(state))
        if state.matrix is not None:
            self.state.matrix[...] = state.matrix
        if state.motors is not None:  # the same object, by which the executor knows its noise
            self.state = self.state._replace(motors=self.state.motors._replace(key=state.motors.key))


def moves_drives(layout: Layout, constants: Constants, command: Command) -> bool:
    """Return whether the targets of the engine's drives move within a tick."""
    moving = constants.driven, constants.guard, constants.turns, command.setpoint_rate
    return layout.control == "drive" and any(each is not None for each in moving)


@lru_cache(maxsize=64)
def _trace(layout: Layout, *structures: Any) -> Trace:
    """Return the trace of the control step: new state, qf, effort of the motors, saturated and guarded joints, targets.

    ``structures`` describe constants, state, command, reading, measured positions and velocities, and of a controller
    the effort and the joints where it is limited. No update of mass matrix or friction is due.
    """

    def function(*symbols: Symbol) -> list[Any]:
        given = iter(symbols)
        k, before, command, measured, seen, effort, limited, left = (filled(each, given) for each in structures)
        model = Model(when=lambda due, function, otherwise: otherwise)
        if limited is not None:
            model = model._replace(controller=lambda law, *_: (law, effort, limited > 0))
        if seen is not None:
            model = model._replace(measure=lambda k, motors, *_: (motors, *seen))
        rubs = k.friction.coulomb is not None
        start = before._replace(age=symbols[0] if rubs else None)
        step = Step(0, 1, left=left)
        new, outputs = control_step(layout._replace(model=model), k, start, command, measured, step)
        results = leaves(_returned(new._replace(age=None)))
        assert len(results) == len(leaves(_returned(before)))
        outputs = outputs._replace(returned=None)
        return [
            *results,
            *leaves(outputs if moves_drives(layout, k, command) else outputs._replace(target=None, target_rate=None)),
        ]

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


@lru_cache(maxsize=64)
def _trace_forward(*structures: Any) -> Trace:
    """Return the trace of the feedforward; ``structures`` describe constants, command and passive force."""

    def function(*symbols: Symbol) -> list[Any]:
        given = iter(symbols)
        k, command, passive = (filled(each, given) for each in structures)
        return [feedforward(k, command, None, passive)]

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


def _stacked(array: Any) -> Any:
    """Return an array (n, envs, dof) as a stack of n arrays, and other arrays unchanged."""
    return Stack(array) if array.ndim == 3 else array


def _write(to: Any, values: Any) -> None:
    """Copy the arrays of a nested tuple into another one of the same structure."""
    for array, value in zip(leaves(to), leaves(values), strict=True):
        array[...] = value
