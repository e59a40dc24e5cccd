"""Sim steps of a tick as one program of XLA, which reaches the engine by a call of the extension.

The program is a loop over the sim steps, ``lax.while_loop``:
:func:`batchpid.sim.loop.control_step.control_step`, traced, then
:func:`batchpid.sim.engine.native.xla.sim_step`. It stops early where an env may have failed, which
Python handles. The number of rows is a multiple of ROWS for any group of envs, so that one program
serves all groups, and the results of an env do not depend on its group.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Float64, Pytree, Rows
from batchpid.arrays.jax_settings import precision
from batchpid.arrays.trees import mapped
from batchpid.sim.engine.native import xla
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import sim_step, uses_mass_matrix
from batchpid.sim.loop.custom import controller_errors
from batchpid.sim.loop.numpy_executor import EngineSteps
from batchpid.sim.loop.step_setup import Setup
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

ROWS = 16
"""Number of which the rows in a program are a multiple."""


def padded(rows: Array) -> Rows:
    """Return ``rows`` (envs, ...) followed by copies of the first row, up to a multiple of ROWS."""
    rows = np.asarray(rows)
    # Copies of a robot stay finite, which rows of zeros need not.
    missing = -len(rows) % ROWS
    return np.concatenate([rows, np.repeat(rows[:1], missing, 0)])


def put(tree: Pytree) -> Pytree:
    """Return a structure of arrays as JAX arrays on the CPU."""
    import jax

    return jax.device_put(tree, jax.local_devices(backend="cpu")[0])


class Carry(NamedTuple):
    """State of the loop over sim steps."""

    progress: Array
    """Sim steps of the tick that are done, and the last status (2,)."""
    state: StepState
    measured: Measured
    outputs: Outputs
    before: Array
    """qpos before the last step."""


class XLAExecutor:
    """Executor of the ticks of the robots of ``setup`` by one program.

    It has the methods of :class:`batchpid.sim.loop.numpy_executor.NumPyExecutor`.
    """

    def __init__(self, setup: Setup, state: StepState) -> None:
        self.setup = setup
        self._engine = EngineSteps(setup)
        self.failed = False
        pack = setup.pack
        constants = setup.constants
        layout = setup.layout
        rows = (pack.size, pack.dof)

        def spread(part: Any) -> Any:
            return mapped(lambda array: padded(np.broadcast_to(array, rows)), part)

        uses_bodies = uses_mass_matrix(layout, constants) or constants.friction.coulomb is not None
        # A program takes one row of constants for each robot, padded as the robots are.
        # The law has the limits in its coefficients.
        arrays = constants._replace(
            timestep=np.float64(constants.timestep),
            k=spread(constants.k),
            limits=(None, None) if layout.law is not None else spread(constants.limits),
            friction=spread(constants.friction),
        )
        with precision("float64"):
            self._constants = put(arrays)
            if uses_bodies:
                self._bodies = put(pack.rigid_tree.tables)
            else:
                self._bodies = None
        self.write_state(state)
        self.measure()

    def measure(self) -> None:
        """Read the robots, after a change of their states between sim steps."""
        with precision("float64"):
            self._measured = put(mapped(padded, self._engine.measure()))

    def qpos(self) -> Float64:
        """Return the positions of the last reading (M, dof)."""
        return self._rows(self._measured.qpos)

    @property
    def before(self) -> Rows:
        """Positions before the last sim step (M, dof)."""
        return self._rows(self._before)

    def read_state(self) -> StepState:
        """Return the state of the control as new NumPy arrays."""
        state: StepState = self._numpy(self._state)
        if state.age is None:
            return state
        return state._replace(age=state.age.astype(np.int64))

    def write_state(self, state: StepState) -> None:
        """Replace the state of the control."""
        import jax

        if state.age is None:
            age = None
        else:
            # The program's integers have 32 bits, as those of a tick's span.
            age = state.age.astype(np.int32)
        with precision("float64"):
            self._state = put(jax.tree.map(padded, state._replace(age=age)))

    def results(self) -> Outputs:
        """Return the results of the last sim step as new NumPy arrays."""
        outputs: Outputs = self._numpy(self._outputs)
        return outputs

    def run(
        self,
        command: Command,
        moves: bool,
        begin: int,
        end: int,
    ) -> int:
        """Run sim steps of a tick: :meth:`batchpid.sim.loop.numpy_executor.NumPyExecutor.run`."""
        setup = self.setup
        step = self._engine.compiled()
        # The layout is a key of the cache of programs, so it has no functions of this group.
        controller = setup.controller
        layout = setup.layout._replace(model=Model(), moves=moves)
        traced = None if controller is None else controller.traced
        with precision("float64"):
            # An address has two parts: without 64-bit integers JAX would cut it.
            steps = np.array([begin, end, 0, 0], np.int32)
            steps[2:].view(np.uint64)[0] = step.prepare()
            rows = put(mapped(padded, command))
            with controller_errors(controller, begin + 1):
                carry = compiled(layout, traced)(
                    steps, self._constants, self._bodies, self._state, self._measured, rows
                )
            done, status = np.asarray(carry.progress).tolist()
        _, self._state, self._measured, self._outputs, self._before = carry
        self.failed = step.may_have_failed(status)
        return int(done)

    def _rows(self, array: Array) -> Rows:
        return np.array(array)[: self.setup.pack.size]

    def _numpy(self, tree: Any) -> Any:
        import jax

        return jax.tree.map(self._rows, tree)


def tick(
    layout: Layout,
    controller: object,
    span: Array,
    constants: Constants,
    bodies: tuple[Array, Array] | None,
    state: StepState,
    measured: Measured,
    command: Command,
) -> Carry:
    """Run sim steps of a tick; arrays (rows, dof).

    ``span`` (4,) of int32 holds the first step, the step after the last, and the address of the
    group in two parts. They share one array because each array from NumPy adds some microseconds to
    a call.
    """
    import jax
    from jax import lax

    xp = jax.numpy
    end = span[1]
    address = lax.bitcast_convert_type(span[2:], np.uint32)

    def mass_matrix(qpos: Array) -> Array:
        assert bodies is not None
        return xla.mass_matrix(*bodies, qpos)

    # One branch for all rows: a choice for each row would compute both.
    def when(due: Any, function: Any, otherwise: Array) -> Any:
        return lax.cond(due.any(), function, lambda: otherwise)

    model = Model(mass_matrix, mass_matrix, when=when, controller=controller)
    with_model = layout._replace(model=model)

    def body(carry: Carry) -> Carry:
        index = carry.progress[0]
        status = carry.progress[1]

        def engine(layout: Layout, constants: Constants, values: Values) -> Values:
            nonlocal status
            qpos, qvel, passive, status = xla.sim_step(address, index, values.outputs.qf)
            return values._replace(measured=Measured(qpos, qvel, passive))

        step = Step(index, end, left=layout.left(index, end, constants.timestep))
        values = Values(carry.state, command, carry.measured, step, carry.measured)
        values = sim_step(with_model, constants, values, {"engine": engine})
        progress = xp.stack([index + 1, status])
        return Carry(progress, values.state, values.measured, values.outputs, carry.measured.qpos)

    # The loop may end before its first sim step, so its results have values before.
    qpos = measured.qpos
    zero = xp.zeros_like(qpos)
    none = xp.zeros(qpos.shape, bool)
    outputs = Outputs(zero, zero, none, returned=None if controller is None else zero)
    carry = Carry(xp.stack([span[0], xp.zeros_like(end)]), state, measured, outputs, qpos)
    final: Carry = lax.while_loop(
        lambda carry: (carry.progress[0] < end) & (carry.progress[1] == 0), body, carry
    )
    return final


@lru_cache(maxsize=8)
def compiled(layout: Layout, controller: object) -> Any:
    """Return :func:`tick` of this layout, compiled at its first call."""
    import jax

    return jax.jit(
        partial(tick, layout, controller),
        compiler_options={"xla_cpu_multi_thread_eigen": False},
    )
