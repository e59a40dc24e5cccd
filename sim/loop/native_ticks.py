"""Ticks of a group of envs in one native call: the stages of a sim step as programs and native
functions; see tick.h.

The constructor has three steps: buffers for everything that the stages read and write; programs,
traced from the stages that are pure functions of arrays, one for each run of neighbouring stages;
the table of stages that native code runs.

Longer than 350 lines because all three steps work on the same buffers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, Pytree, Rows
from batchpid.arrays.trees import filled, leaves, mapped, structure
from batchpid.native.array_program import ArrayProgram
from batchpid.native.symbols import Symbol
from batchpid.native.tracing import Trace, trace
from batchpid.sim.engine import native
from batchpid.sim.engine.native import interface
from batchpid.sim.engine.protocol import CompiledModel, CompiledPack, CompiledStep
from batchpid.sim.engine.robot_model import scene_tree
from batchpid.sim.loop import control_step
from batchpid.sim.loop.arrays import Arrays, Command, FaultArrays
from batchpid.sim.loop.control_step import COUPLING_STEPS, SimStage
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


class Table(NamedTuple):
    """Commands and observations of the ticks of a run, and arrays of its last observation."""

    arrays: Arrays
    """(ticks, envs, ...), the same in every run."""
    effort: NDArray[np.float32]
    """Of the last tick (envs, dof), as the next two."""
    saturated: NDArray[np.bool_]
    guarded: NDArray[np.bool_]
    fault: FaultArrays
    """Last fault of each env (envs,)."""


class NativeTicks:
    """Ticks of the robots of ``pack`` in native code, for commands with the entries of ``command``.

    ``compensated`` says whether gravity is compensated, and whether Coriolis and centrifugal forces
    are. A ``controller`` (:class:`batchpid.sim.OperationalSpace`) is a native call. ``force`` is
    the model of the passive force where the engine's steps do not read it.

    Attributes
    ----------
    state, command, measured, outputs
        Arrays that the sim steps read and write.
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
    ) -> None:
        self._pack = pack
        self._layout = layout
        self._constants = constants
        self._controller = controller
        self._force, self._noise = force, layout.model.noise
        self._native = native.extension("_gateway")
        self._control: Any = None
        self._programs, self._stages = list[Any](), list[interface.Stage]()
        self._transfers: ctypes.Array[interface.Transfer] | None = None
        self._kept = list[Any]()
        # 1: buffers
        shape, law = (pack.size, pack.dof), layout.law
        self._shape = shape
        matrix = None
        if law is not None and law.uses_mass_matrix:
            matrix = np.zeros((*shape, pack.dof))
        self.state = mapped(partial(np.array, order="C"), state._replace(matrix=matrix))
        self._reading = Measured(*np.zeros((3, *shape)))
        self.measured = self._reading if compensated[0] else self._reading._replace(passive=None)
        self.before, self.outputs = np.zeros(shape), Outputs()
        self.command = command.map(lambda rows: np.zeros(shape))
        if controller is not None:  # it has its own copy of setpoints, of any size
            self.command = self.command._replace(setpoint=None)
        moves = command.setpoint_rate is not None and layout.control in ("pid", "drive")
        left = np.zeros(()) if moves else None
        noise = mapped(lambda block: block[0].copy(), self._draw()) if layout.measures else None
        self._tick = interface.Tick(
            timestep=constants.timestep,
            dof=pack.dof,
            late=layout.late,
            matrix_steps=1 if law is None else law.matrix_steps,
            **dict(zip(("gravity", "coriolis"), compensated, strict=True)),
        )
        self._place(**self._reading._asdict(), before=self.before, left=left)
        # 2: programs
        values = Values(
            state=self._traced_state(),
            command=self.command,
            measured=self.measured,
            step=Step(0, 1, left),
            seen=self.measured,
            noise=noise,
        )
        stages = [(stage, _NATIVE.get(stage.name)) for stage in control_step.STAGES]
        stages = [(stage, kind) for stage, kind in stages if kind is None or kind.applies(self)]
        left_over, waiting = sum(kind is None for _, kind in stages), list[SimStage]()
        for stage, kind in stages:
            if kind is None:
                waiting.append(stage)
                continue
            if waiting:
                left_over -= len(waiting)
                values, waiting = self._add_program(waiting, values, left_over == 0), []
            values = kind.add(self, values)
        self.outputs = values.outputs
        if self._control is not None:
            self.state = self.state._replace(law=self._control.state)
        # 3: binding
        self._place(qf=self.outputs.qf)
        self._kept.append(table := (interface.Stage * len(self._stages))(*self._stages))
        self._tick.stages, self._tick.stage_count = ctypes.addressof(table), len(table)
        self._calls, self._address = tuple(self._programs), ctypes.addressof(self._tick)
        self._is_noisy = bool(leaves(noise))
        self._counted = None if self.state.motors is None else self.state.motors.step

    # -- running
    # ----------------------------------------------------------------------------------------------

    def load(self, state: StepState, measured: Measured, command: Command | None) -> None:
        """Copy the arguments into the arrays, where they are not these arrays."""
        if state is not self.state:
            self._copy(state)
        if measured is not self.measured:
            for array, value in zip(self.measured, measured, strict=True):
                if array is not None:
                    array[...] = value
        if command is None:
            return
        if self._control is not None:
            self._control.load(command.setpoint)
        for array, value in zip(self.command, command, strict=True):
            if array is not None:
                array[...] = value

    def exchange(self, table: Table) -> None:
        """Take commands from ``table``, and write observations to it."""
        if self._transfers is None:
            self._transfers = found = self._transfers_of(table)
            self._tick.transfers, self._tick.transfer_count = ctypes.addressof(found), len(found)

    def run(
        self, step: CompiledStep, tick: int, begin: int, until: int, steps: int, whole: bool
    ) -> tuple[int, int, int]:
        """Run ticks of ``steps`` sim steps, from sim step ``begin`` of ``tick``, up to the tick
        ``until``.

        With ``whole``, commands and observations are those of :meth:`exchange`. Return the first
        tick that is not complete or not observed, its sim steps that are done, and the last status.
        An event that needs Python stops the ticks: a status that is not 0, and with ``whole`` a
        command or velocities that are not finite.
        """
        arguments, status = (self._calls, self._address, step.prepare()), _NO_NOISE
        while status == _NO_NOISE:
            drawn, before = self._give_noise() if self._is_noisy else -1, (tick, begin)
            tick, begin, status = self._native.ticks(
                *arguments, tick, begin, until, steps, drawn, whole
            )
            if self._counted is not None:
                self._counted[...] += (tick - before[0]) * steps + begin - before[1]
        return tick, begin, status

    def _give_noise(self) -> int:
        """Let native code read the noise of the next sim steps; return their number."""
        noise = leaves(self._draw())
        for place, block in enumerate(noise):
            self._tick.noise[place] = block.ctypes.data
        return min(map(len, noise))

    def _draw(self) -> Any:
        """Return the noise of positions and velocities in the next steps (steps, M, dof) each, or
        None.
        """
        if self.state.motors is None or not self._layout.measures:
            return None
        return self._noise.from_step(self._constants.motors, self.state.motors, self.before)

    def _copy(self, state: StepState) -> None:
        if self._control is not None:
            self._control.set_state(state.law)
        for array, value in zip(leaves(_copied(self.state)), leaves(_copied(state)), strict=True):
            array[...] = value
        if state.matrix is not None:
            self.state.matrix[...] = state.matrix
        if state.motors is not None:  # the same object, by which the executor knows its noise
            self.state = self.state._replace(
                motors=self.state.motors._replace(key=state.motors.key)
            )

    # -- buffers
    # ----------------------------------------------------------------------------------------------

    def _place(self, **arrays: Rows | None) -> None:
        """Let fields of the structure of native code point to these arrays."""
        for name, array in arrays.items():
            if array is None:
                continue
            expected = np.dtype(_TYPES.get(name, np.float64))
            if array.dtype != expected or not array.flags.c_contiguous:
                raise ValueError(f"{name} is not a contiguous array of {expected}")
            setattr(self._tick, name, array.ctypes.data)
            self._kept.append(array)

    def _traced_state(self) -> StepState:
        """Return the part of the state that programs have: no key of the noise, counts, or state of
        a controller.
        """
        state, motors = self.state, self.state.motors
        if motors is not None:
            motors = motors._replace(key=None, step=None)
        law = state.law if self._controller is None else None
        return state._replace(law=law, age=None, motors=motors)

    def _transfers_of(self, own: Table) -> ctypes.Array[interface.Transfer]:
        outputs = self.outputs
        seen = own.arrays.observation
        transfers = list[interface.Transfer]()

        def add(kind: str, table: Rows, row: Rows, stride: int | None = None) -> None:
            dtype = {"read": np.float64, "write_floats": np.float32}.get(kind, row.dtype)
            is_fit = table.dtype == dtype and row.flags.c_contiguous and table[0].flags.c_contiguous
            if not is_fit or table.shape[1:] != row.shape:
                raise ValueError(
                    f"a table {table.shape} of {table.dtype} does not fit rows {row.shape} of"
                    f" {row.dtype}"
                )
            addresses, size = (
                (table.ctypes.data, row.ctypes.data),
                row.nbytes if kind == "write_bytes" else row.size,
            )
            stride = table.strides[0] if stride is None else stride
            transfers.append(
                interface.Transfer(*addresses, stride, size, interface.TRANSFERS.index(kind))
            )
            self._kept.extend((table, row))

        for table, row in zip(own.arrays.command, self.command, strict=True):
            if row is not None:
                add("read", table, row)
        for table, row in ((seen.qpos, self._reading.qpos), (seen.qvel, self._reading.qvel)):
            add("write_floats", table, row)
        if seen.base_pose is not None and seen.base_twist is not None:
            rows = {name: np.zeros((self._shape[0], size)) for name, size in _BASE.items()}
            self._place(**rows)
            add("write_floats", seen.base_pose, rows["base_pose"])
            add("write_floats", seen.base_twist, rows["base_twist"])
        add("write_floats", seen.effort, outputs.motor)
        add("write_floats", own.effort[None], outputs.motor, 0)
        none = np.zeros(self._shape, bool)
        for table, kept, output in (
            (seen.saturated, own.saturated, outputs.saturated),
            (seen.guarded, own.guarded, outputs.guarded),
        ):
            row = none if output is None else output
            add("write_bytes", table, row)
            add("write_bytes", kept[None], row, 0)
        add("write_bytes", seen.ok, np.ones(len(none), bool))
        for table, row in zip(own.arrays.fault, own.fault, strict=True):
            add("write_bytes", table, row)
        return (interface.Transfer * len(transfers))(*transfers)

    # -- programs
    # ----------------------------------------------------------------------------------------------

    def _add_program(self, stages: Sequence[SimStage], values: Values, is_last: bool) -> Values:
        """Add a program of stages; return ``values`` with the arrays that it writes.

        State is changed in place. Other results have arrays of their own.
        """
        before = values.outputs
        masks = [
            name
            for name, value in before._asdict().items()
            if value is not None and value.dtype == bool
        ]
        values = values._replace(
            outputs=before._replace(**dict.fromkeys(masks))
        )  # programs take no masks
        constants = mapped(_split, self._constants)
        inputs = leaves(values)
        state = leaves(values.state)
        layout, histories = (
            self._layout._replace(model=Model()),
            tuple(array.ndim == 3 for array in state),
        )
        traced = _trace(
            tuple(stages), is_last, layout, histories, structure(constants), structure(values)
        )
        outputs = [
            np.zeros(self._shape, bool if is_mask else np.float64)
            for is_mask in traced.program.masks
        ]
        for array, place in zip(state, traced.places, strict=False):  # the state comes first
            if place.is_result:
                outputs[place.number] = array
        arrays = ((outputs if place.is_result else inputs)[place.number] for place in traced.places)
        new = filled(traced.values, arrays)
        same = {name: getattr(before, name) for name in masks if getattr(new.outputs, name) is None}
        new = new._replace(outputs=new.outputs._replace(**same))
        if not outputs:
            return new
        program = ArrayProgram(traced.program, leaves(constants), len(inputs), self._shape)
        pairs = tuple(
            [
                (array, 0 if array.ndim == 2 else array[0].size if array.ndim else -1)
                for array in inputs
            ]
        )
        noise = [
            next(at for at, each in enumerate(inputs) if each is block)
            for block in leaves(values.noise)
        ]
        self._add_stage("program", program=len(self._programs), noise=(*noise, -1, -1)[:2])
        self._programs.append(self._native.bind(program.arguments, pairs, tuple(outputs)))
        self._kept.append((inputs, outputs))
        return new

    def _add_stage(self, kind: str, every: int = 1, **fields: Any) -> None:
        self._stages.append(
            interface.Stage(kind=interface.STAGES.index(kind), every=every, **fields)
        )

    # -- stages of native code
    # ---------------------------------------------------------------------------------

    def _add_force(self, values: Values) -> Values:
        assert self._force is not None
        self._tick.measured_force = self._force.address
        self._place(pose=values.seen.qpos, rate=values.seen.qvel)
        self._add_stage("force")
        return values._replace(seen=values.seen._replace(passive=self._reading.passive))

    def _add_inertia(self, values: Values) -> Values:
        refresh, friction = self._layout.model.refresh, self.state.friction
        self._tick.refresh = refresh.address
        self._kept.append(refresh)
        self._place(age=self.state.age, gain=friction.gain, memory=friction.memory)
        self._add_stage("inertia")
        return values

    def _add_mass_matrix(self, values: Values) -> Values:
        law, constants = self._layout.law, self._constants
        assert law is not None
        tree, bodies = scene_tree(self._pack.spec).tables
        self._place(
            pose=values.seen.qpos,
            rate=values.seen.qvel,
            matrix=self.state.matrix,
            tree=tree,
            bodies=bodies,
        )
        self._place(
            armature=constants.armature, damping=constants.damping, **constants.coupling.native()
        )
        self._add_stage("mass_matrix", law.matrix_steps)
        return values

    def _add_controller(self, values: Values) -> Values:
        qpos, qvel, bias = values.seen
        self._control = self._controller.bound(
            qpos, qvel, self._reading.passive if bias is None else bias
        )
        self._tick.control = self._control.address
        self._add_stage("controller")
        outputs = values.outputs._replace(returned=self._control.effort)
        return values._replace(limited=self._control.limited, outputs=outputs)

    def _add_targets(self, values: Values) -> Values:
        target, rate = values.outputs.target, values.outputs.target_rate
        self._place(target=target, target_rate=rate)
        # Writing the targets costs a call for each joint.
        self._add_stage("targets", int(moves_drives(self._layout, self._constants, self.command)))
        return values

    def _add_constraint(self, values: Values) -> Values:
        self._add_stage("constraint", COUPLING_STEPS)
        return values

    def _add_engine(self, values: Values) -> Values:
        if self._force is not None and not self._layout.measures:
            self._tick.read_force = self._force.address
        self._add_stage("engine")
        return values


class _Native(NamedTuple):
    """How a stage becomes one of native code."""

    applies: Callable[[NativeTicks], Any]
    add: Callable[[NativeTicks, Values], Values]


_NATIVE = {
    "passive force": _Native(
        lambda of: of._layout.measures and of._force is not None, NativeTicks._add_force
    ),
    "inertia": _Native(lambda of: of.state.age is not None, NativeTicks._add_inertia),
    "mass matrix": _Native(lambda of: of.state.matrix is not None, NativeTicks._add_mass_matrix),
    "controller": _Native(lambda of: of._controller is not None, NativeTicks._add_controller),
    "targets": _Native(lambda of: of._layout.control == "drive", NativeTicks._add_targets),
    "constraint": _Native(
        lambda of: not of._constants.coupling.is_identity, NativeTicks._add_constraint
    ),
    "engine": _Native(lambda of: True, NativeTicks._add_engine),
}
"""Stages that are no programs, or have a native function."""

_NO_NOISE = 1 << interface.STATUS.index("no_noise")
_BASE = {"base_pose": 7, "base_twist": 6}
"""Numbers of each quantity of a floating base."""
_TYPES = {"tree": np.int32, "leader": np.int32, "age": np.int64}
"""Dtypes of arrays that are not float64."""


class _Place(NamedTuple):
    """Place of an array of the values after a program."""

    is_result: bool
    """Whether the program computes it; otherwise it is one of its inputs."""
    number: int


class _Traced(NamedTuple):
    """Program of some stages."""

    program: Trace
    values: Pytree
    """Structure of the values after it."""
    places: tuple[_Place, ...]
    """Places of the arrays in these."""


def moves_drives(layout: Layout, constants: Constants, command: Command) -> bool:
    """Return whether the targets of the engine's drives move within a tick."""
    moving = constants.driven, constants.guard, constants.turns, command.setpoint_rate
    return layout.control == "drive" and any(value is not None for value in moving)


@lru_cache(maxsize=64)
def _trace(
    stages: tuple[SimStage, ...],
    is_last: bool,
    layout: Layout,
    histories: tuple[bool, ...],
    constants: Any,
    given: Any,
) -> _Traced:
    """Return the program of stages.

    ``constants`` and ``given`` are structures of the constants and of the values before it.
    ``histories`` says which arrays of the state are histories, which a program changes in place.
    The last program has no results but state and outputs.
    """
    first, count = len(leaves(constants)), len(leaves(given))
    result_parts: list[Any] = []

    def function(*symbols: Symbol) -> list[Any]:
        each = iter(symbols)
        k, values = filled(constants, each), filled(given, each)
        for stage in stages:
            assert stage.function is not None
            values = stage.function(layout, k, values)
        if is_last:
            nothing = Measured(None, None, None)
            values = Values(
                values.state, Command(None), nothing, values.step, nothing, outputs=values.outputs
            )
        numbers = {symbol: number for number, symbol in enumerate(symbols[first:])}
        results, places = list[Any](), list[_Place]()
        returned = set(map(id, leaves(values.outputs)))
        for at, leaf in enumerate(leaves(values)):
            is_state, number = at < len(histories), numbers.get(leaf)
            if is_state and (number == at or histories[at]):
                places.append(_Place(False, at))
            elif number is not None and not is_state and id(leaf) not in returned:
                places.append(_Place(False, number))
            else:
                places.append(_Place(True, len(results)))
                results.append(leaf)
        result_parts[:] = structure(values), tuple(places)
        return results

    program = trace(function, first, count)
    return _Traced(program, *result_parts)


def _copied(state: StepState) -> StepState:
    """Return the part of a state whose arrays keep their structure: without matrices and the key of
    the noise.
    """
    motors = None if state.motors is None else state.motors._replace(key=None)
    return state._replace(matrix=None, motors=motors)


def _split(array: Array) -> Any:
    """Return an array (n, envs, dof) as a tuple of n arrays, and other arrays unchanged."""
    return tuple(array) if array.ndim == 3 else array
