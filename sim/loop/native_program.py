"""Programs of native code for the stages of a sim step: see tick.h.

Stages that are pure functions of arrays are traced, and neighbours become one program. The others
have a native function.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, DType, Pytree, Rows
from batchpid.arrays.trees import filled, leaves, mapped, structure
from batchpid.native.array_program import ArrayProgram
from batchpid.native.symbols import Symbol
from batchpid.native.tracing import Trace, trace
from batchpid.sim.engine import native
from batchpid.sim.engine.native import interface
from batchpid.sim.loop.arrays import Arrays, Command, FaultArrays
from batchpid.sim.loop.control_step import COUPLING_STEPS, STAGES, SimStage
from batchpid.sim.loop.step_setup import Setup, moves_drives
from batchpid.sim.loop.step_values import (
    Layout,
    Measured,
    Model,
    Step,
    StepState,
    Values,
)


class Table(NamedTuple):
    """Commands and observations of the ticks of a run, and arrays of its last observation."""

    arrays: Arrays
    """(ticks, envs, ...), the same in every run."""
    effort: NDArray[np.float32]
    """Effort of the last tick (envs, dof), as are the next two."""
    saturated: NDArray[np.bool_]
    guarded: NDArray[np.bool_]
    fault: FaultArrays
    """Last fault of each env (envs,)."""


class Buffers(NamedTuple):
    """Arrays that native code reads and writes in each sim step."""

    state: StepState
    command: Command
    measured: Measured
    before: Rows
    """Positions before the last sim step (M, dof)."""


class TickProgram:
    """Stages and arrays of the ticks of a group.

    ``reads_force`` says whether the engine's sim step reads the passive force, and ``noise`` is
    that of positions and velocities in a sim step.

    Attributes
    ----------
    tick
        Structure of native code: place in the ticks, noise, status.
    bound
        Capsule of the programs and ``tick``, for the extension.
    outputs
        Results of the last sim step.
    control
        Native controller, or None.
    """

    def __init__(
        self,
        setup: Setup,
        buffers: Buffers,
        table: Table,
        noise: Pytree,
        reads_force: bool,
    ) -> None:
        _, pack, layout, constants, _ = setup
        self._setup, self._buffers = setup, buffers
        self._native = native.extension("_gateway")
        self._programs, self._stages = list[Any](), list[interface.Stage]()
        self._references = list[Any]()  # keeps arrays alive that native code has addresses of
        self.control: Any = None
        # The structure has the addresses of all arrays.
        self.tick = interface.Tick(
            timestep=constants.timestep,
            dof=pack.dof,
            late=layout.late,
            matrix_steps=1 if layout.law is None else layout.law.matrix_steps,
            gravity=layout.gravity,
            coriolis=layout.coriolis,
        )
        self._left = np.zeros(())
        self._place(**buffers.measured._asdict(), before=buffers.before, left=self._left)
        # SAPIEN knows neither measured states nor the model of varied robots.
        if layout.gravity and (layout.measures or not reads_force):
            if layout.measures:
                field = "measured_force"
            else:
                field = "read_force"
            setattr(self.tick, field, pack.force_model.address)
        # Programs have no key of the noise, counts, or state of a controller.
        state, motors = buffers.state, buffers.state.motors
        if motors is not None:
            state = state._replace(motors=motors._replace(key=None, step=None))
        law = None if layout.control == "custom" else state.law
        values = Values(
            state=state._replace(law=law, age=None),
            command=buffers.command,
            measured=buffers.measured,
            step=Step(0, 1, self._left if layout.moves else None),
            seen=buffers.measured,
            noise=noise,
        )
        self.outputs = self._add_stages(values).outputs
        self._place(qf=self.outputs.qf)
        stages = (interface.Stage * len(self._stages))(*self._stages)
        self.tick.stages, self.tick.stage_count = ctypes.addressof(stages), len(stages)
        transfers = self._transfers(table)
        self.tick.transfers = ctypes.addressof(transfers)
        self.tick.transfer_count = len(transfers)
        self._references += stages, transfers, table
        self.bound = self._native.bind_ticks(tuple(self._programs), ctypes.addressof(self.tick))

    def _place(self, **arrays: Rows | None) -> None:
        """Let fields of the structure of native code point to these arrays."""
        for name, array in arrays.items():
            if array is not None:
                setattr(self.tick, name, self._address(array, _TYPES.get(name, np.float64)))

    def _address(self, array: Rows, dtype: DType) -> int:
        """Return the address of an array for native code, which has this dtype."""
        if array.dtype != dtype or not array.flags.c_contiguous:
            raise ValueError(f"not a contiguous array of {np.dtype(dtype)}")
        self._references.append(array)
        return array.ctypes.data

    # -- commands and observations

    def _transfers(self, table: Table) -> ctypes.Array[interface.Transfer]:
        """Return the copies between the tables of the ticks and the arrays of a sim step."""
        command, seen, fault = table.arrays
        outputs = self.outputs
        measured = self._buffers.measured
        none = np.zeros(measured.qpos.shape, bool)
        copies: list[tuple[Rows, Rows]] = [
            (seen.qpos, measured.qpos),
            (seen.qvel, measured.qvel),
            (seen.effort, outputs.motor),
            (seen.ok, np.ones(len(none), bool)),
            # One row, which each tick overwrites.
            (table.effort[None], outputs.motor),
            *zip(fault, table.fault, strict=True),
        ]
        for name in ("saturated", "guarded"):
            mask = getattr(outputs, name)
            if mask is None:
                mask = none
            copies.append((getattr(seen, name), mask))
            copies.append((getattr(table, name)[None], mask))
        if seen.base_pose is not None and seen.base_twist is not None:
            pose = np.zeros((len(none), 7))
            twist = np.zeros((len(none), 6))
            self._place(base_pose=pose, base_twist=twist)
            copies += (seen.base_pose, pose), (seen.base_twist, twist)
        transfers = [self._transfer(rows, row) for rows, row in copies]
        for rows, row in zip(command, self._buffers.command, strict=True):
            if row is not None:
                transfers.append(self._transfer(rows, row))
        return (interface.Transfer * len(transfers))(*transfers)

    def _transfer(self, table: Rows, row: Rows) -> interface.Transfer:
        """Return a copy between a row (M, ...) and the first of the ticks of ``table``."""
        # Of arrays of numbers only commands have tables in double precision.
        kind, size = "write_bytes", row.nbytes
        if row.dtype == np.float64:
            kind, size = "write_floats", row.size
            if table.dtype == np.float64:
                kind = "read"
        return interface.Transfer(
            table=self._address(table[0], table.dtype),
            row=self._address(row, row.dtype),
            stride=0 if len(table) == 1 else table.strides[0],
            size=size,
            kind=interface.TRANSFERS.index(kind),
        )

    # -- stages

    def _add_stages(self, values: Values) -> Values:
        """Add the stages that apply; return the values after them."""
        _, _, layout, constants, _ = self._setup
        stages = [stage for stage in STAGES if stage.applies(layout, constants)]
        every = {"constraint": COUPLING_STEPS}
        # Writing the targets of drives costs a call for each joint.
        every["targets"] = int(moves_drives(layout, constants))
        if layout.law is not None:
            every["mass matrix"] = layout.law.matrix_steps
        waiting = list[SimStage]()
        for stage in stages:
            if stage.name not in _NATIVE:
                waiting.append(stage)
                continue
            if waiting:
                values = self._add_program(tuple(waiting), values)
                waiting = []
            values = _NATIVE[stage.name](self, values)
            self._add_stage(stage.name, every.get(stage.name, 1))
        return values

    def _add_program(self, stages: tuple[SimStage, ...], values: Values) -> Values:
        """Add a program of stages; return ``values`` with the arrays that it writes.

        State is changed in place. Other results have arrays of their own.
        """
        shape = self._buffers.before.shape
        constants = mapped(_split, self._setup.constants)
        inputs = leaves(values)
        state = leaves(values.state)
        layout = self._setup.layout._replace(model=Model())
        histories = tuple(array.ndim == 3 for array in state)
        traced = _trace(stages, layout, histories, structure(constants), structure(values))
        # Arrays for the results: the state's own, and new ones for the others.
        outputs = [np.zeros(shape, bool if is_mask else float) for is_mask in traced.program.masks]
        for array, place in zip(state, traced.places, strict=False):  # the state comes first
            if place >= len(inputs):
                outputs[place - len(inputs)] = array
        arrays = [*inputs, *outputs]
        changed = filled(traced.changed, iter([arrays[place] for place in traced.places]))
        after = values._replace(**dict(zip(_CHANGED, changed, strict=True)), noise=None)
        if outputs:
            program = ArrayProgram(traced.program, leaves(constants), len(inputs), shape)
            pairs = tuple([(array, _row_size(array)) for array in inputs])
            # Native code sets the addresses of the noise, which is another in each sim step.
            drawn = [id(block) for block in leaves(values.noise)]
            noise = [at for at, array in enumerate(inputs) if id(array) in drawn]
            self._add_stage(
                "program",
                program=len(self._programs),
                noise=(*noise, -1, -1)[:2],
            )
            self._programs.append(self._native.bind(program.arguments, pairs, tuple(outputs)))
            self._references += inputs, outputs
        return after

    def _add_stage(self, kind: str, every: int = 1, **fields: Any) -> None:
        self._stages.append(
            interface.Stage(kind=interface.STAGES.index(kind), every=every, **fields)
        )

    def _add_force(self, values: Values) -> Values:
        self._place(pose=values.seen.qpos, rate=values.seen.qvel)
        return values

    def _add_inertia(self, values: Values) -> Values:
        refresh = self._setup.layout.model.refresh
        state = self._buffers.state
        self.tick.refresh = refresh.address
        self._references.append(refresh)
        self._place(age=state.age, gain=state.friction.gain, memory=state.friction.memory)
        return values

    def _add_mass_matrix(self, values: Values) -> Values:
        _, pack, _, constants, _ = self._setup
        tree, bodies = pack.rigid_tree.tables
        self._place(pose=values.seen.qpos, rate=values.seen.qvel, tree=tree, bodies=bodies)
        self._place(matrix=self._buffers.state.matrix, armature=constants.armature)
        self._place(damping=constants.damping, **constants.coupling.native())
        return values

    def _add_controller(self, values: Values) -> Values:
        controller: Any = self._setup.options.control
        self.control = controller.bound(*values.seen, self._left)
        self.control.set_state(self._buffers.state.law)
        self.tick.control = self.control.address
        outputs = values.outputs._replace(returned=self.control.effort)
        return values._replace(limited=self.control.limited, outputs=outputs)

    def _add_targets(self, values: Values) -> Values:
        self._place(target=values.outputs.target, target_rate=values.outputs.target_rate)
        return values

    def _add_nothing(self, values: Values) -> Values:
        return values


_NATIVE: dict[str, Callable[[TickProgram, Values], Values]] = {
    "passive force": TickProgram._add_force,
    "inertia": TickProgram._add_inertia,
    "mass matrix": TickProgram._add_mass_matrix,
    "controller": TickProgram._add_controller,
    "targets": TickProgram._add_targets,
    "constraint": TickProgram._add_nothing,
    "engine": TickProgram._add_nothing,
}
"""Stages that are not traced, with the method that adds their arrays."""

_TYPES = {"tree": np.int32, "leader": np.int32, "age": np.int64}
"""Dtypes of arrays that are not float64."""


_CHANGED = ("state", "seen", "outputs")
"""Values that programs change."""


class _Traced(NamedTuple):
    """Program of some stages."""

    program: Trace
    changed: Pytree
    """Structure of the values :data:`_CHANGED` after it."""
    places: tuple[int, ...]
    """Index of each of their arrays: inputs first, then results."""


@lru_cache(maxsize=64)
def _trace(
    stages: tuple[SimStage, ...],
    layout: Layout,
    histories: tuple[bool, ...],
    constants: Any,
    inputs: Any,
) -> _Traced:
    """Return the program of stages.

    ``constants`` and ``inputs`` are structures of the constants and of the values before it.
    ``histories`` says which arrays of the state are histories, which a program changes in place.
    """
    first = len(leaves(constants))
    count = len(leaves(inputs))
    result_parts: list[Any] = []

    def function(*symbols: Symbol) -> list[Any]:
        remaining = iter(symbols)
        k = filled(constants, remaining)
        values = filled(inputs, remaining)
        for stage in stages:
            assert stage.function is not None
            values = stage.function(layout, k, values)
        changed = tuple([getattr(values, name) for name in _CHANGED])
        numbers = {symbol: number for number, symbol in enumerate(symbols[first:])}
        outputs = set(map(id, leaves(values.outputs)))
        results = list[Any]()
        places = list[int]()
        for at, leaf in enumerate(leaves(changed)):
            is_state = at < len(histories)
            number = numbers.get(leaf)
            if is_state and (number == at or histories[at]):
                places.append(at)
            # An output that is an input is copied, since the next sim step changes the input.
            elif number is not None and not is_state and id(leaf) not in outputs:
                places.append(number)
            else:
                places.append(count + len(results))
                results.append(leaf)
        result_parts[:] = structure(changed), tuple(places)
        return results

    program = trace(function, first, count)
    return _Traced(program, *result_parts)


def _split(array: Array) -> Any:
    """Return an array (n, envs, dof) as a tuple of n arrays, and other arrays unchanged."""
    if array.ndim == 3:
        return tuple(array)
    return array


def _row_size(array: Rows) -> int:
    """Return the numbers in each row of a table (rows, ...), as the extension counts them: 0 for
    as many as joints, -1 for an input that is one number.
    """
    if array.ndim == 0:
        return -1
    if array.ndim == 2:
        return 0
    size: int = array[0].size
    return size
