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

from batchpid.arrays.array_types import Array, Pytree, Rows
from batchpid.arrays.jax_settings import own_settings
from batchpid.arrays.trees import mapped
from batchpid.sim.engine.native import xla
from batchpid.sim.engine.protocol import CompiledPack, CompiledStep
from batchpid.sim.engine.robot_model import scene_tree
from batchpid.sim.loop.arrays import Command
from batchpid.sim.loop.control_step import sim_step
from batchpid.sim.loop.custom import OwnController, controller_errors
from batchpid.sim.loop.numpy_executor import Ran, Span, passive_forces
from batchpid.sim.loop.step_setup import needs_qvel
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
from batchpid.sim.options.options import RunnerOptions

ROWS = 16
"""Number of which the rows in a program are a multiple."""


def padded(rows: Any) -> Rows:
    """Return ``rows`` (envs, ...) followed by copies of the first row, up to a multiple of ROWS."""
    rows = np.asarray(rows)
    missing = -len(rows) % ROWS
    return np.concatenate([rows, np.repeat(rows[:1], missing, 0)])


def put(tree: Pytree) -> Any:
    """Return a structure of arrays as JAX arrays on the CPU."""
    import jax

    return jax.device_put(tree, jax.local_devices(backend="cpu")[0])


class Carry(NamedTuple):
    """State of the loop over sim steps."""

    progress: Any
    """Sim steps of the tick that are done, and the last status (2,)."""
    state: StepState
    measured: Measured
    outputs: Outputs
    before: Any
    """qpos before the last step."""


class XLAExecutor:
    """Executor of the ticks of the robots of ``pack`` by one program.

    It has the methods of :class:`batchpid.sim.loop.numpy_executor.NumPyExecutor`.
    """

    def __init__(
        self,
        options: RunnerOptions,
        pack: CompiledPack,
        layout: Layout,
        constants: Constants,
        controller: OwnController | None,
    ) -> None:
        self._pack = pack
        self._options = options
        self._layout = layout._replace(model=Model())
        self._gravity, self._coriolis = passive_forces(options)
        self._controller = controller
        self._speed_limit = None if options.speed_limit is None else np.asarray(options.speed_limit)
        self._reads_qvel = needs_qvel(layout, constants, None)
        self._native: CompiledStep | None = None
        self._bound: Any = None
        self._no_matrix: Any = None
        law = layout.law
        needs_bodies = (
            law is not None and law.uses_mass_matrix
        ) or constants.friction.coulomb is not None
        tables = scene_tree(pack.spec).tables if needs_bodies else None

        def spread(part: Any) -> Array:
            return mapped(lambda array: padded(np.broadcast_to(array, (pack.size, pack.dof))), part)

        limits = (None, None) if law is not None else spread(constants.limits)
        k = spread(constants.k)
        friction = spread(constants.friction)
        timestep = np.float64(constants.timestep)
        arrays = constants._replace(timestep=timestep, k=k, limits=limits, friction=friction)
        rows = (pack.size, pack.dof)
        with own_settings("float64"):
            self._constants = put(arrays)
            self._bodies = put(tables)
            self._zero = put(padded(np.zeros(rows)))

    def measure(self) -> Measured:
        """Return a reading of the robots."""
        pack = self._pack
        qpos, qvel = pack.read_qpos(), pack.read_qvel()
        passive = pack.passive_force(self._gravity, self._coriolis) if self._gravity else None
        with own_settings("float64"):
            return put(
                Measured(padded(qpos), padded(qvel), None if passive is None else padded(passive))
            )

    def run(
        self, state: StepState, measured: Measured, command: Command, span: Span, table: Any = None
    ) -> Ran:
        """Run the sim steps of a tick, or until an env may have failed."""
        native = self._bind()
        with own_settings("float64"):
            steps = np.array([span.begin, span.steps, 0, 0], np.int32)
            steps[2:].view(np.uint64)[0] = native.prepare()
            command = command.map(padded)
            # Always a JAX array: for another kind the program would be compiled again.
            extra = self._zero if command.feedforward is None else put(command.feedforward)
            command = command._replace(feedforward=extra)
            traced = None if self._controller is None else self._controller.traced
            with controller_errors(self._controller and self._options.control, span.begin + 1):
                program = compiled(self._layout, traced, self._gravity)
                carry = program(
                    steps, self._constants, self._bodies, self._started(state), measured, command
                )
            done, status = np.asarray(carry.progress).tolist()
        failed = native.may_have_failed(status)
        return Ran(
            carry.state, carry.outputs, carry.measured, carry.before, span.tick, done, failed
        )

    def rows(self, array: Array) -> Rows:
        """Return an array of the executor as a new NumPy array."""
        return np.array(array)[: self._pack.size]

    def numpy_state(self, state: StepState) -> StepState:
        """Return a state of the executor with NumPy arrays."""
        import jax

        state = jax.tree.map(lambda leaf: np.array(leaf)[: self._pack.size], state)
        return state if state.age is None else state._replace(age=state.age.astype(np.int64))

    def _started(self, state: StepState) -> StepState:
        """Return ``state`` as the program takes it: padded JAX arrays, with a mass matrix if the
        law needs one.
        """
        import jax

        law, pack = self._layout.law, self._pack
        if any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(state)):
            age = None if state.age is None else state.age.astype(np.int32)
            state = put(jax.tree.map(padded, state._replace(age=age)))
        if state.matrix is None and law is not None and law.uses_mass_matrix:
            if self._no_matrix is None:
                self._no_matrix = put(padded(np.zeros((pack.size, pack.dof, pack.dof))))
            state = state._replace(matrix=self._no_matrix)
        return state

    def _bind(self) -> CompiledStep:
        """Return the compiled sim step of the present robots and systems."""
        pack = self._pack
        if self._native is None or self._bound is not pack.calls:
            self._bound = pack.calls
            self._native = pack.compiled_step(
                self._gravity, self._coriolis, self._reads_qvel, self._speed_limit
            )
        return self._native


def tick(
    layout: Layout,
    controller: Any,
    gravity: bool,
    span: Any,
    constants: Constants,
    bodies: tuple[Any, Any] | None,
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
    end, address = span[1], lax.bitcast_convert_type(span[2:], np.uint32)

    def mass_matrix(qpos: Array) -> Array:
        assert bodies is not None
        return xla.mass_matrix(*bodies, qpos)

    def when(due: Any, function: Any, otherwise: Array) -> Any:
        return lax.cond(due.any(), function, lambda: otherwise)

    model = Model(mass_matrix, mass_matrix, when=when, controller=controller)
    whole = layout._replace(model=model)

    def body(carry: Carry) -> Carry:
        index, status = carry.progress[0], carry.progress[1]

        def engine(values: Values) -> Values:
            nonlocal status
            qpos, qvel, passive, status = xla.sim_step(address, index, values.outputs.qf)
            return values._replace(measured=Measured(qpos, qvel, passive if gravity else None))

        step = Step(index, end, left=layout.left(index, end, constants.timestep))
        values = Values(carry.state, command, carry.measured, step, carry.measured)
        values = sim_step(whole, constants, values, {"engine": engine})
        progress = xp.stack([index + 1, status])
        return Carry(progress, values.state, values.measured, values.outputs, carry.measured.qpos)

    qpos = measured.qpos
    zero, none = xp.zeros_like(qpos), xp.zeros(qpos.shape, bool)
    outputs = Outputs(zero, zero, none, returned=None if controller is None else zero)
    carry = Carry(xp.stack([span[0], xp.zeros_like(end)]), state, measured, outputs, qpos)
    return lax.while_loop(
        lambda carry: (carry.progress[0] < end) & (carry.progress[1] == 0), body, carry
    )


@lru_cache(maxsize=8)
def compiled(layout: Layout, controller: Any, gravity: bool) -> Any:
    """Return :func:`tick` of this layout, compiled at its first call."""
    import jax

    return jax.jit(
        partial(tick, layout, controller, gravity),
        compiler_options={"xla_cpu_multi_thread_eigen": False},
    )
