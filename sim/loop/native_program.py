"""Programs of native code for the stages of a sim step: see tick.h.

Stages that are pure functions of arrays are traced, and neighbours become one program. The others
have a native function.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import DType, Pytree, Rows
from batchpid.arrays.trees import leaves
from batchpid.sim.engine import native
from batchpid.sim.engine.native import interface
from batchpid.sim.loop.group_control import GroupControl
from batchpid.sim.loop.numpy_executor import COUPLING_STEPS
from batchpid.stages.program import StageProgram
from batchpid.stages.stage import States, recalled
from batchpid.stages.values import Command, Measured, Outputs, Step, Values


class Buffers(NamedTuple):
    """Arrays that native code reads and writes in each sim step."""

    states: States
    command: Command
    measured: Measured
    before: Rows
    """Positions before the last sim step (M, dof)."""


class TickProgram:
    """Stages and arrays of the ticks of a group.

    ``copies`` returns the copies before and after each tick, between tables (ticks, M, ...) and
    arrays of a sim step: commands are tables of float64. ``reads_force`` says whether the engine's
    sim step reads the passive force, ``moves`` whether joint setpoints move within a tick, and
    ``noise`` is that of positions and velocities in a sim step.

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
    buffers
        Arrays of a sim step.
    """

    def __init__(
        self,
        setup: GroupControl,
        buffers: Buffers,
        copies: Callable[[TickProgram], list[tuple[Rows, Rows]]],
        noise: Pytree,
        reads_force: bool,
        moves: bool,
    ) -> None:
        _, pack, control, _, model = setup
        self._setup, self.buffers = setup, buffers
        self.pack, self.model = pack, model
        self._native = native.extension("_gateway")
        self._programs, self._stages = list[Any](), list[interface.Stage]()
        self._references = list[Any]()  # keeps arrays alive that native code has addresses of
        self.control: Any = None
        # The structure has the addresses of all arrays.
        self.tick = interface.Tick(
            timestep=control.timestep,
            dof=pack.dof,
            late=control.late,
            matrix_steps=getattr(setup.stage("matrix"), "steps", 1),
            gravity=control.gravity,
            coriolis=control.coriolis,
        )
        self._left = np.zeros(())
        self.place(**buffers.measured._asdict(), before=buffers.before, left=self._left)
        # SAPIEN knows neither measured states nor the model of varied robots.
        if control.gravity and (control.measures or not reads_force):
            if control.measures:
                field = "measured_force"
            else:
                field = "read_force"
            setattr(self.tick, field, pack.force_model.address)
        values = Values(
            command=buffers.command if moves else buffers.command.resting(),
            measured=buffers.measured,
            seen=buffers.measured,
            timestep=control.timestep,
            step=Step(0, 1, self._left if moves else None),
            noise=noise,
        )
        self.outputs = self._add_stages(recalled(setup.stages, buffers.states, values), moves)
        self.place(qf=self.outputs.qf)
        stages = (interface.Stage * len(self._stages))(*self._stages)
        self.tick.stages, self.tick.stage_count = ctypes.addressof(stages), len(stages)
        pairs = [self._transfer(*pair) for pair in copies(self)]
        transfers = (interface.Transfer * len(pairs))(*pairs)
        self.tick.transfers = ctypes.addressof(transfers)
        self.tick.transfer_count = len(transfers)
        self._references += stages, transfers
        self.bound = self._native.bind_ticks(tuple(self._programs), ctypes.addressof(self.tick))

    # -- for stages in C++

    def place(self, **arrays: Rows | None) -> None:
        """Let fields of the structure of native code point to these arrays."""
        for name, array in arrays.items():
            if array is not None:
                setattr(self.tick, name, self._address(array, _TYPES.get(name, np.float64)))

    def use(self, **owners: Any) -> None:
        """Let fields of the structure of native code point to the structures of these objects."""
        for name, owner in owners.items():
            setattr(self.tick, name, owner.address)
            self._references.append(owner)

    def control_by(self, state: Pytree, *seen: Rows) -> tuple[Rows, Rows]:
        """Let the native controller follow ``seen``: qpos, qvel and feedforward; return its
        effort, and the joints whose effort it limits.
        """
        controller: Any = self._setup.options.control
        self.control = controller.bound(*seen, self._left)
        self.control.set_state(state)
        self.use(control=self.control)
        return self.control.effort, self.control.limited

    def _address(self, array: Rows, dtype: DType) -> int:
        """Return the address of an array for native code, which has this dtype."""
        if array.dtype != dtype or not array.flags.c_contiguous:
            raise ValueError(f"not a contiguous array of {np.dtype(dtype)}")
        self._references.append(array)
        return array.ctypes.data

    def _transfer(self, table: Rows, row: Rows) -> interface.Transfer:
        """Return a copy between a row (M, ...) and the first of the ticks of ``table``."""
        # Of arrays of numbers only commands have tables in double precision.
        kind, size = "write_bytes", row.nbytes
        if row.dtype == np.float64:
            kind, size = "write_floats", table[0].size
            if table.dtype == np.float64:
                kind = "read"
        return interface.Transfer(
            table=self._address(table[0], table.dtype),
            row=self._address(row, row.dtype),
            stride=0 if len(table) == 1 else table.strides[0],
            size=size,
            # A number of each env has the same value for all joints of the row.
            step=row.size // table[0].size,
            kind=interface.TRANSFERS.index(kind),
        )

    # -- stages

    def _add_stages(self, values: Values, moves: bool) -> Outputs:
        """Add the stages; return the results after them."""
        setup = self._setup
        waiting = list[tuple[Any, Pytree]]()
        for stage, state in zip(setup.stages, self.buffers.states, strict=True):
            if not stage.native:
                waiting.append((stage, state))
                continue
            values = self._add_program(waiting, values, passes=True)
            waiting = []
            values = stage.bind(self, state, values)
            self._add_stage(stage.native, stage.every)
        outputs = self._add_program(waiting, values).outputs
        if outputs.target is not None:
            self.place(target=outputs.target, target_rate=outputs.target_rate)
            # Writing the targets of drives costs a call for each joint.
            self._add_stage("targets", int(moves or setup.moves_drives))
        if not setup.control.coupling.is_identity:
            self._add_stage("constraint", COUPLING_STEPS)
        if setup.pack.steps_natively:
            self._add_stage("engine")
        return outputs

    def _add_program(
        self, pairs: list[tuple[Any, Pytree]], values: Values, passes: bool = False
    ) -> Values:
        """Add a program of stages and their states; return the values after it, which it
        ``passes`` on to further stages.
        """
        if not pairs:
            return values
        stages, states = zip(*pairs, strict=True)
        made = StageProgram(stages, states, values, self.buffers.before.shape, passes)
        if made.outputs:
            # Native code sets the addresses of the noise, which is another in each sim step.
            drawn = [id(block) for block in leaves(values.noise)]
            noise = [at for at, array in enumerate(made.inputs) if id(array) in drawn]
            self._add_stage(
                "program",
                program=len(self._programs),
                noise=(*noise, -1, -1)[:2],
            )
            rows = tuple([(array, _row_size(array)) for array in made.inputs])
            arguments = made.program.arguments
            self._programs.append(self._native.bind(arguments, rows, tuple(made.outputs)))
            self._references.append(made)
        return made.values

    def _add_stage(self, kind: str, every: int = 1, **fields: Any) -> None:
        self._stages.append(
            interface.Stage(kind=interface.STAGES.index(kind), every=every, **fields)
        )


_TYPES = {"tree": np.int32, "leader": np.int32, "age": np.int64}
"""Dtypes of arrays that are not float64."""


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
