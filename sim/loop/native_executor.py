"""Ticks in native code: one call of the extension runs those of several groups, until an event
needs Python.

Stages that are pure functions of arrays are traced, and neighbours become one program; the others
have a native function: see tick.h.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Pytree, Rows
from batchpid.arrays.trees import leaves, mapped
from batchpid.sim.engine import native
from batchpid.sim.engine.native import number, structure
from batchpid.sim.loop.array_executors import (
    COUPLING_STEPS,
    NOISE_STEPS,
    Executor,
    JAXExecutor,
    NumPyExecutor,
)
from batchpid.sim.loop.arrays import Arrays, FaultArrays
from batchpid.sim.loop.group_control import GroupControl, native_obstacle
from batchpid.stages.stage import States, bind_stages, recalled, running
from batchpid.stages.values import Command, Measured, Outputs, Step, Values


class TickProgram:
    """Stages and arrays of the ticks of a group, whose native code changes the ``states`` in place.

    ``values`` are those of a sim step before its stages, without a model, and ``before`` the
    positions before the last sim step (M, dof): arrays that native code writes in each sim step.
    Setpoints move within a tick where ``values`` have their rates. ``copies`` returns the copies
    before and after each tick, between tables (ticks, M, ...) and arrays of a sim step: commands are
    tables of float64. ``reads_force`` says whether the engine's sim step reads the passive force.

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
        setup: GroupControl,
        states: States,
        values: Values,
        before: Rows,
        copies: Callable[[TickProgram], list[tuple[Rows, Rows]]],
        reads_force: bool,
    ) -> None:
        _, pack, control, _, model = setup
        self._setup, self._states = setup, states
        self.pack, self.model, self.values = pack, model, values
        self._shape = before.shape
        self._native = native.extension("_gateway")
        self._programs, self._stages = list[Any](), list[Any]()
        self._references = list[Any]()  # keeps arrays alive that native code has addresses of
        self.control: Any = None
        # The structure has the addresses of all arrays.
        self.tick = structure("Tick")(
            timestep=control.timestep,
            dof=pack.dof,
            late=control.late,
            matrix_steps=getattr(setup.stage("matrix"), "every", 1),
            gravity=control.gravity,
            coriolis=control.coriolis,
        )
        self.place(
            **values.measured._asdict(),
            before=before,
            left=values.step.left,
        )
        # SAPIEN knows neither measured states nor the model of varied robots.
        if control.gravity and (control.measures or not reads_force):
            if control.measures:
                field = "measured_force"
            else:
                field = "read_force"
            setattr(self.tick, field, pack.force_model.address)
        self.outputs = self._add_stages(recalled(setup.stages, states, values))
        self.place(qf=self.outputs.qf)
        stages = (structure("Stage") * len(self._stages))(*self._stages)
        self.tick.stages, self.tick.stage_count = ctypes.addressof(stages), len(stages)
        pairs = [self._transfer(*pair) for pair in copies(self)]
        transfers = (structure("Transfer") * len(pairs))(*pairs)
        self.tick.transfers = ctypes.addressof(transfers)
        self.tick.transfer_count = len(transfers)
        self._references += stages, transfers
        self.bound = self._native.bind_ticks(tuple(self._programs), ctypes.addressof(self.tick))

    # -- for stages in C++

    def place(self, **arrays: Rows | None) -> None:
        """Let fields of the structure of native code point to these arrays."""
        for name, array in arrays.items():
            if array is not None:
                setattr(self.tick, name, self._address(array))

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
        self.control = controller.bound(*seen, self.values.step.left)
        self.control.set_state(state)
        self.use(control=self.control)
        return self.control.effort, self.control.limited

    def _address(self, array: Rows) -> int:
        """Return the address of an array for native code."""
        if not array.flags.c_contiguous:
            raise ValueError("not a contiguous array")
        self._references.append(array)
        return array.ctypes.data

    def _transfer(self, table: Rows, row: Rows) -> Any:
        """Return a copy between a row (M, ...) and the first of the ticks of ``table``."""
        # Of arrays of numbers only commands have tables in double precision.
        kind, size = "WRITE_BYTES", row.nbytes
        if row.dtype == np.float64:
            kind, size = "WRITE_FLOATS", table[0].size
            if table.dtype == np.float64:
                kind = "READ"
        return structure("Transfer")(
            table=self._address(table[0]),
            row=self._address(row),
            stride=0 if len(table) == 1 else table.strides[0],
            size=size,
            # A number of each env has the same value for all joints of the row.
            step=row.size // table[0].size,
            kind=number("TransferKind", kind),
        )

    # -- stages

    def _add_stages(self, values: Values) -> Outputs:
        """Add the stages; return the results after them."""
        setup = self._setup
        moves = values.command.setpoint_rate is not None
        pairs = list(zip(setup.stages, self._states, strict=True))
        for stage, state in pairs:
            if stage.due:
                clock, due = [self._address(getattr(state, name)) for name in stage.due]
                self._add_program(
                    [(stage, state)],
                    values,
                    renews=True,
                    clock=clock,
                    due=due,
                )
        waiting = list[tuple[Any, Pytree]]()
        for stage, state in pairs:
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
            self._add_stage("TARGETS", int(moves or setup.moves_drives))
        if not setup.control.coupling.is_identity:
            self._add_stage("CONSTRAINT", COUPLING_STEPS)
        if setup.pack.steps_natively:
            self._add_stage("ENGINE")
        return outputs

    def _add_program(
        self,
        pairs: list[tuple[Any, Pytree]],
        values: Values,
        passes: bool = False,
        renews: bool = False,
        **fields: Any,
    ) -> Values:
        """Add a program of stages and their states; return the values after it, which it
        ``passes`` on to further stages. ``renews`` as for :func:`bind_stages`; ``fields`` are of
        the program's stage in native code.
        """
        if not pairs:
            return values
        stages, states = zip(*pairs, strict=True)
        # Native code sets the addresses of the noise, which is another in each sim step.
        drawn = [id(block) for block in leaves(values.noise)]
        made, values = bind_stages(
            stages,
            states,
            values,
            self._shape,
            passes,
            renews,
        )
        if made.outputs:
            noise = [at for at, array in enumerate(made.inputs) if id(array) in drawn]
            self._add_stage(
                "PROGRAM",
                program=len(self._programs),
                noise=(*noise, -1, -1)[:2],
                **fields,
            )
            rows = tuple([(array, _row_size(array)) for array in made.inputs])
            arguments = made.program.arguments
            self._programs.append(self._native.bind(arguments, rows, tuple(made.outputs)))
            self._references.append(made)
        return values

    def _add_stage(self, kind: str, every: int = 1, **fields: Any) -> None:
        self._stages.append(
            structure("Stage")(
                kind=number("StageKind", kind),
                every=every,
                **fields,
            )
        )


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


class NativeExecutor(Executor):
    """Executor in native code.

    With :func:`run_ticks` it also runs whole ticks, with their commands and observations in
    ``arrays`` (ticks, envs, ...); it writes the results of the last one to ``shown`` (envs, dof), by
    name, and reads the ``faults`` of the envs.
    """

    def __init__(
        self,
        setup: GroupControl,
        states: States,
        arrays: Arrays,
        shown: Mapping[str, Rows],
        faults: FaultArrays,
    ) -> None:
        super().__init__(setup, _copied(states))
        self._tables = arrays, shown, faults
        shape = setup.pack.size, setup.pack.dof
        command = Command(*np.zeros((4, *shape)))
        if setup.control.mode == "custom":  # it has its own copy of setpoints, of any size
            command = Command(None, feedforward=command.feedforward)
        self._command = command
        # Native code changes these arrays in place.
        self.measured = Measured(*np.zeros((3, *shape)))
        self.before = np.zeros(shape)
        self._programs: dict[bool, TickProgram] = {}
        self._program: TickProgram
        self.measure()

    def measure(self) -> None:
        """Read the robots, in place."""
        for array, rows in zip(self.measured, self._reading(), strict=True):
            array[...] = rows

    def read_state(self) -> States:
        """Return the states as new arrays."""
        return _copied(self._states)

    def write_state(self, states: States) -> None:
        """Replace the states in place."""
        for array, rows in zip(leaves(self._states), leaves(states), strict=True):
            if rows is not array:
                array[...] = rows
        self._first = -NOISE_STEPS

    def run(
        self,
        command: Command,
        moves: bool,
        begin: int,
        end: int,
    ) -> int:
        """Run sim steps of a tick: :meth:`batchpid.sim.loop.array_executors.NumPyExecutor.run`."""
        # The tables of ticks are not used here, since the command may differ from theirs.
        self.start(moves, begin)
        control = self._program.control
        if control is not None:
            control.load(command.setpoint)
        for array, rows in zip(self._command, command, strict=True):
            if array is not None:
                array[...] = rows
        run_ticks([self], 1, end, whole=False)
        _, done = self.complete()
        return done

    def start(self, moves: bool, step: int = 0, tick: int = 0) -> None:
        """Prepare the next ticks, from sim step ``step`` of ``tick`` on."""
        # A program for each kind of tick is made once, at the first such tick.
        if moves not in self._programs:
            measured = self.measured
            values = Values(
                command=self._command if moves else self._command.resting(),
                measured=measured,
                seen=measured,
                timestep=self.setup.control.timestep,
                step=Step(0, 1, np.zeros(())),
                noise=mapped(lambda block: block[0].copy(), self.draw_noise()),
            )
            program = TickProgram(
                self.setup,
                self._states,
                values,
                self.before,
                self._copies,
                self._native_force,
            )
            self._programs[moves] = program
            # A native controller has arrays of its own for its state.
            if program.control is not None:
                states = list(self._states)
                states[self._places["law"]] = program.control.state
                self._states = tuple(states)
        self._program = program = self._programs[moves]
        self.outputs = program.outputs
        program.tick.tick, program.tick.step = tick, step

    def _copies(self, program: TickProgram) -> list[tuple[Rows, Rows]]:
        """Return the copies between the tables of the ticks and the arrays of a sim step."""
        (command, seen, fault), shown, faults = self._tables
        measured = self.measured
        none = np.zeros(measured.qpos.shape, bool)
        copies: list[tuple[Rows, Rows]] = [
            (seen.qpos, measured.qpos),
            (seen.qvel, measured.qvel),
            (seen.ok, np.ones(len(none), bool)),
            *zip(fault, faults, strict=True),
        ]
        for name, rows in program.outputs.shown.items():
            rows = none if rows is None else rows
            # Each tick overwrites the one row of the last.
            copies += (getattr(seen, name), rows), (shown[name][None], rows)
        if seen.base_pose is not None and seen.base_twist is not None:
            pose = np.zeros((len(none), 7))
            twist = np.zeros((len(none), 6))
            program.place(base_pose=pose, base_twist=twist)
            copies += (seen.base_pose, pose), (seen.base_twist, twist)
        if seen.starved is not None:
            copies.append((seen.starved, self.state("plan").starved))
        pairs = zip(command, self._command, strict=True)
        return copies + [(rows, row) for rows, row in pairs if row is not None]

    def complete(self) -> tuple[int, int]:
        """Complete ticks that ran: return the first tick that is not observed, and its sim steps
        that are done.

        RuntimeError if the engine has failed.
        """
        tick = self._program.tick
        self.failed = self.compiled().may_have_failed(tick.status)
        return tick.tick, tick.step

    def prepare(self) -> object:
        """Return the program for the extension, with robots and noise prepared."""
        tick = self._program.tick
        # The address changes when the engine's robots are built again.
        tick.group = self.compiled().prepare()
        drawn = self.draw_noise()
        noise = [] if drawn is None else leaves(drawn)
        tick.drawn = min(map(len, noise), default=-1)
        for place, block in enumerate(noise):
            tick.noise[place] = block.ctypes.data
        return self._program.bound

    def count_steps(self) -> bool:
        """Count the sim steps that ran; return whether the others wait for noise."""
        tick = self._program.tick
        sensors = self.state("sensors")
        if sensors is None:
            return False
        if sensors.step is not None:
            sensors.step[...] += tick.ran
        return bool(tick.status & number("Status", "NO_NOISE"))


def run_ticks(
    executors: Sequence[NativeExecutor],
    until: int,
    steps: int,
    whole: bool = True,
) -> None:
    """In one native call, run each group from its start to tick ``until``, of ``steps`` sim steps
    each; :meth:`NativeExecutor.complete` tells where it stopped.

    A group stops at an event that needs Python: an env that may have failed, and with ``whole`` a
    command or velocities that are not finite. With ``whole``, commands and observations are those
    of the tables; else the ticks stop at the end of the first one.
    """
    while executors:
        ticks = tuple([executor.prepare() for executor in executors])
        native.extension("_gateway").ticks(ticks, until, steps, whole)
        executors = [executor for executor in executors if executor.count_steps()]


def make_executor(
    setup: GroupControl,
    states: States,
    arrays: Arrays,
    shown: Mapping[str, Rows],
    faults: FaultArrays,
) -> NumPyExecutor | NativeExecutor:
    """Return the executor of a control, which begins with ``states``."""
    # Native wherever the engine has native steps, under backend "numpy" too: the bits are the same.
    if setup.options.backend == "jax":
        return JAXExecutor(setup, states)
    if setup.pack.steps_natively and runs_natively(setup):
        return NativeExecutor(setup, states, arrays, shown, faults)
    return NumPyExecutor(setup, states)


def runs_natively(setup: GroupControl) -> bool:
    """Return whether the stages can be native: with a law of batchpid, in float64."""
    constants = leaves(running(setup.stages))
    is_double = all(leaf.dtype != np.float32 for leaf in constants)
    return is_double and not native_obstacle(setup.options)


def _copied(states: States) -> States:
    """Return states with new arrays."""
    copies: States = mapped(lambda leaf: np.array(leaf, order="C"), states)
    return copies
