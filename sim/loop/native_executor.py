"""Ticks in native code: one call of the extension runs those of several groups, until an event
needs Python.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64, Rows
from batchpid.arrays.trees import leaves, mapped
from batchpid.sim.engine import native
from batchpid.sim.engine.native import interface
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.backend import native_obstacle
from batchpid.sim.loop.native_program import Buffers, Table, TickProgram
from batchpid.sim.loop.numpy_executor import EngineSteps
from batchpid.sim.loop.step_setup import Setup
from batchpid.sim.loop.step_values import Measured, Outputs, StepState

_NO_NOISE = 1 << interface.STATUS.index("no_noise")


class NativeExecutor:
    """Executor of the sim steps of the robots of ``setup`` in native code.

    It has the methods of :class:`batchpid.sim.loop.numpy_executor.NumPyExecutor`. With
    :func:`run_ticks` it also runs whole ticks, with their commands and observations in ``table``.
    """

    def __init__(self, setup: Setup, state: StepState, table: Table) -> None:
        self.setup = setup
        self._table = table
        self._engine = EngineSteps(setup)
        shape = table.effort.shape
        command = Command(*np.zeros((4, *shape)))
        if setup.layout.control == "custom":  # it has its own copy of setpoints, of any size
            command = Command(None, feedforward=command.feedforward)
        measured = Measured(*np.zeros((3, *shape)))
        self._buffers = Buffers(_copied(state), command, measured, np.zeros(shape))
        self._programs: dict[bool, TickProgram] = {}
        self._program: TickProgram | None = None
        self.failed = False
        self.measure()

    @property
    def runs_whole_ticks(self) -> bool:
        """Whether :func:`run_ticks` can be used: a native controller takes setpoints from
        Python.
        """
        return self.setup.layout.control != "custom"

    @property
    def before(self) -> Rows:
        """Positions before the last sim step (M, dof)."""
        return self._buffers.before

    def measure(self) -> None:
        """Read the robots, after a change of their states between sim steps."""
        for array, rows in zip(self._buffers.measured, self._engine.measure(), strict=True):
            array[...] = rows

    def qpos(self) -> Float64:
        """Return the positions of the last reading (M, dof)."""
        qpos: Float64 = self._buffers.measured.qpos
        return qpos

    def read_state(self) -> StepState:
        """Return the state of the control as new NumPy arrays."""
        return _copied(self._buffers.state)

    def write_state(self, state: StepState) -> None:
        """Replace the state of the control; it has the arrays of the state before."""
        for array, rows in zip(_arrays(self._buffers.state), _arrays(state), strict=True):
            array[...] = rows
        if state.motors is not None:  # its noise is drawn anew for another object as the key
            motors = self._buffers.state.motors._replace(key=state.motors.key)
            self._change_state(motors=motors)

    def _change_state(self, **parts: Any) -> None:
        self._buffers = self._buffers._replace(state=self._buffers.state._replace(**parts))

    def results(self) -> Outputs:
        """Return the results of the last sim step."""
        assert self._program is not None
        return self._program.outputs

    def run(
        self,
        command: Command,
        moves: bool,
        begin: int,
        end: int,
    ) -> int:
        """Run sim steps of a tick: :meth:`batchpid.sim.loop.numpy_executor.NumPyExecutor.run`."""
        # The tables of ticks are not used here, since the command may differ from theirs.
        # A program for each kind of tick is made once, at the first such tick.
        self.start(moves, begin)
        control = self._programs[moves].control
        if control is not None:
            control.load(command.setpoint)
        for array, rows in zip(self._buffers.command, command, strict=True):
            if array is not None:
                array[...] = rows
        run_ticks([self], 1, end, whole=False)
        _, done = self.complete()
        return done

    def start(self, moves: bool, step: int = 0, tick: int = 0) -> None:
        """Prepare the next ticks, from sim step ``step`` of ``tick`` on."""
        if moves not in self._programs:
            layout = self.setup.layout._replace(moves=moves)
            noise = mapped(lambda block: block[0].copy(), self._noise())
            self._programs[moves] = program = TickProgram(
                self.setup._replace(layout=layout),
                self._buffers,
                self._table,
                noise,
                self._engine.native_force,
            )
            # A native controller has arrays of its own for its state.
            if program.control is not None:
                self._change_state(law=program.control.state)
        self._program = program = self._programs[moves]
        program.tick.tick, program.tick.step = tick, step

    def complete(self) -> tuple[int, int]:
        """Complete ticks that ran: return the first tick that is not observed, and its sim steps
        that are done.

        RuntimeError if the engine has failed.
        """
        assert self._program is not None
        tick = self._program.tick
        self.failed = self._engine.compiled().may_have_failed(tick.status)
        return tick.tick, tick.step

    def prepare(self) -> object:
        """Return the program for the extension, with robots and noise prepared."""
        assert self._program is not None
        tick = self._program.tick
        # The address changes when the engine's robots are built again.
        tick.group = self._engine.compiled().prepare()
        noise = leaves(self._noise())
        tick.drawn = min(map(len, noise), default=-1)
        for place, block in enumerate(noise):
            tick.noise[place] = block.ctypes.data
        return self._program.bound

    def count_steps(self) -> bool:
        """Count the sim steps that ran; return whether the others wait for noise."""
        assert self._program is not None
        tick = self._program.tick
        motors = self._buffers.state.motors
        if motors is not None and motors.step is not None:
            motors.step[...] += tick.ran
        return bool(tick.status & _NO_NOISE)

    def _noise(self) -> Any:
        """Return the noise of positions and velocities in the next sim steps (steps, M, dof)."""
        layout = self.setup.layout
        motors = self._buffers.state.motors
        if motors is None or not layout.measures:
            return ()
        return layout.model.noise.from_step(self.setup.constants.motors, motors, self.before)


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


def runs_natively(setup: Setup) -> bool:
    """Return whether the control step can be native: a law of batchpid, in float64."""
    constants = leaves(setup.constants)
    is_double = all(leaf.dtype != np.float32 for leaf in constants)
    return is_double and not native_obstacle(setup.options)


def _copied(state: StepState) -> StepState:
    """Return new arrays of a state."""
    law = state.law
    if isinstance(law, dict):
        law = {name: np.array(leaf) for name, leaf in law.items()}
    copied: StepState = mapped(partial(np.array, order="C"), state._replace(law=law))
    return copied


def _arrays(state: StepState) -> list[Rows]:
    """Return all arrays of a state."""
    law = state.law
    return [*leaves(state), *(law.values() if isinstance(law, dict) else ())]
