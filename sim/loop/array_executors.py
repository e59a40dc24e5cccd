"""Sim steps of a tick in NumPy, stage by stage: the oracle of the other executors, and the executor
of controllers in Python; and in programs of JAX.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from itertools import groupby
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Float64, Pytree, Rows
from batchpid.arrays.elementwise import precision
from batchpid.arrays.trees import filled, leaves, structure
from batchpid.sim.engine.native_model import NativeStep
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.env_parts import controller_errors
from batchpid.sim.loop.faults import is_near
from batchpid.sim.loop.group_control import GroupControl
from batchpid.stages.stage import States, recalled, running, stepped
from batchpid.stages.values import Command, Measured, Model, Outputs, Step, Values

COUPLING_STEPS = 4
"""Sim steps for which the constraint efforts of coupled joints keep their mass matrix within a
tick.
"""


class NumPyExecutor:
    """Executor of the sim steps of the robots of ``setup``, from the states of its stages on.

    Attributes
    ----------
    measured
        Reading of the robots before the next sim step.
    outputs
        Results of the last sim step.
    before
        Positions before the last sim step (M, dof).
    failed
        Whether an env may have failed in the last sim step.
    """

    def __init__(self, setup: GroupControl, states: States) -> None:
        self.setup = setup
        self._engine = EngineSteps(setup)
        self.outputs = Outputs()
        self.before: Any = None
        self.failed = False
        self.write_state(states)
        self.measure()

    def measure(self) -> None:
        """Read the robots, after a change of their states between sim steps."""
        self.measured = self._engine.measure()

    def qpos(self) -> Float64:
        """Return the positions of the last reading (M, dof)."""
        qpos: Float64 = self.measured.qpos
        return qpos

    def read_state(self) -> States:
        """Return the states as NumPy arrays, which the next sim steps do not change."""
        return self._states

    def write_state(self, states: States) -> None:
        """Replace the states; they have the arrays of the states before."""
        self._states = states

    def change(self, name: str, function: Callable[[Any, Pytree], Pytree]) -> None:
        """Change the state of the stage ``name``, between sim steps, to ``function(stage, state)``,
        which has the same arrays or others in their place.
        """
        pairs = zip(self.setup.stages, self._states, strict=True)
        changed = [
            function(stage, state) if stage.name == name else state for stage, state in pairs
        ]
        self._states = tuple(changed)

    def results(self) -> Outputs:
        """Return the results of the last sim step as NumPy arrays."""
        return self.outputs

    def run(
        self,
        command: Command,
        moves: bool,
        begin: int,
        end: int,
    ) -> int:
        """Run sim steps ``begin`` to ``end`` of a tick under ``command`` (M, ...), or until an env
        may have failed; return the sim steps of the tick that are done.

        ``moves`` says whether joint setpoints move within the tick, at the given rate.

        Raises ControllerError if a controller in Python does.
        """
        setup = self.setup
        control, pack = setup.control, setup.pack
        if not moves:
            command = command.resting()
        every = moves or setup.moves_drives
        for index in range(begin, end):
            step = Step(index, end, control.left(index, end))
            self.before = self.measured.qpos  # where a robot that fails now is suspended
            measured = self.measured
            values = Values(
                command,
                measured,
                measured,
                control.timestep,
                step,
                setup.model,
            )
            with controller_errors(control.controller, index + 1):
                self.outputs = outputs = self._stepped(values).outputs
            # Writing the targets of drives costs a call for each joint.
            if outputs.target is not None and (every or index == begin):
                pack.write_drive_target(outputs.target, outputs.target_rate)
            if not control.coupling.is_identity and index % COUPLING_STEPS == 0:
                pack.update_constraint()
            self.measured, self.failed = self._engine.advance(outputs.qf)
            if self.failed:
                return index + 1
        return end

    def _stepped(self, values: Values) -> Values:
        """Advance the stages by a sim step; return the values after them."""
        self._states, values = stepped(self.setup.stages, self._states, values)
        return values


class EngineSteps:
    """Sim steps of the engine for the robots of ``setup``, and their readings: one native call
    each where the engine has it, else calls of Python.
    """

    def __init__(self, setup: GroupControl) -> None:
        self._setup = setup
        self._pack: EnginePack = setup.pack
        control = setup.control
        self.reads_force = control.gravity and not control.measures
        """Whether a reading has the passive force, which is otherwise 0."""
        self._parts = control.gravity, control.coriolis
        self._is_native = setup.pack.steps_natively
        self.native_force = False
        """Whether the native sim step reads the passive force."""
        if self._is_native:
            self.native_force = self.reads_force and setup.pack.steps_read_force(*self._parts)
        self._step: NativeStep | None = None
        self._bound: object = None

    def measure(self) -> Measured:
        """Return a reading of the robots."""
        qpos = self._pack.read_qpos()
        qvel = self._pack.read_qvel()
        return Measured(qpos, qvel, self._passive_force(qpos))

    def advance(self, qf: Rows) -> tuple[Measured, bool]:
        """Do a sim step with the efforts ``qf`` (M, dof); return the reading after it, and whether
        an env may have failed.
        """
        if not self._is_native:
            self._pack.write_qf(qf)
            self._pack.step()
            measured = self.measure()
            limit = self._setup.options.speed_limit
            is_slow = limit is None or bool((np.abs(measured.qvel) <= limit).all())
            return measured, not (is_near(measured.qpos) and is_slow)
        step = self.compiled()
        qpos, qvel, passive = np.empty((3, *qf.shape))
        status = step(np.ascontiguousarray(qf, np.float64), qpos, qvel, passive)
        if not self.native_force:
            passive = self._passive_force(qpos)
        return Measured(qpos, qvel, passive), step.may_have_failed(status)

    def compiled(self) -> NativeStep:
        """Return the native sim step of the present robots."""
        pack = self._pack
        if self._step is None or self._bound is not pack.calls:
            if self.native_force:
                parts = self._parts
            else:
                parts = (False, False)
            drives = self._setup.control.mode == "drive"
            self._bound = pack.calls
            self._step = pack.compiled_step(*parts, self._setup.options.speed_limit, drives)
        return self._step

    def _passive_force(self, like: Float64) -> Float64:
        if self.reads_force:
            return self._pack.passive_force(*self._parts)
        return np.zeros_like(like)


ROWS = 16
"""Number of which the rows in a program are a multiple.

One program then serves all groups, and the results of an env do not depend on its group.
"""


_KEPT_VALUES = ("measured", "timestep", "step", "model", "matrix", "inertia")
"""Values that stages in programs do not change."""


class JAXExecutor(NumPyExecutor):
    """A :class:`.NumPyExecutor` whose stages are programs of JAX, on the CPU.

    Neighbours are one program. Between them are the stages that call functions of the robots'
    model.
    """

    def __init__(self, setup: GroupControl, states: States) -> None:
        super().__init__(setup, states)
        self._parts = list[tuple[slice, Any]]()
        first = 0
        for calls_model, group in groupby(setup.stages, _calls_model):
            part = running(group)
            program = None
            if not calls_model:
                program = partial(_compiled(structure(part)), self._constants(part))
            self._parts.append((slice(first, first + len(part)), program))
            first += len(part)

    def _constants(self, part: Any) -> list[Any]:
        """Return the constants of stages as arrays of JAX, with one row for each robot where they
        have rows.
        """
        import jax

        with precision("float64"):
            rows = [self._padded(leaf, leaf.ndim - 2) for leaf in leaves(part)]
            return list(jax.device_put(rows, jax.local_devices(backend="cpu")[0]))

    def _padded(self, rows: Any, axis: int = 0) -> Any:
        """Return ``rows`` with copies of the first robot's on an axis, up to a multiple of ROWS."""
        size = self.setup.pack.size
        # Copies of a robot stay finite, which rows of zeros need not.
        if axis < 0 or np.ndim(rows) <= axis or rows.shape[axis] != size or size % ROWS == 0:
            return rows
        return np.take(rows, [*range(size), *[0] * (-size % ROWS)], axis)

    def _stepped(self, values: Values) -> Values:
        import jax

        size = self.setup.pack.size
        stages, states = self.setup.stages, self._states
        values = recalled(stages, states, values)
        new = list[Pytree]()
        with precision("float64"):
            for part, program in self._parts:
                if program is None:
                    changed, values = stepped(stages[part], states[part], values)
                else:
                    inputs = states[part], _without(values, "model")
                    results = program(*jax.tree.map(self._padded, inputs))
                    changed, after = jax.tree.map(lambda rows: np.asarray(rows)[:size], results)
                    unchanged = {name: getattr(values, name) for name in _KEPT_VALUES}
                    values = after._replace(**unchanged)
                new += changed
        self._states = tuple(new)
        return values


def _without(values: Values, *names: str) -> Values:
    nothing: dict[str, Any] = dict.fromkeys(names)
    return values._replace(**nothing)


def _calls_model(stage: Any) -> bool:
    calls_model: bool = stage.calls_model
    return calls_model


@lru_cache(maxsize=8)
def _compiled(stages: Any) -> Any:
    """Return the sim step of stages of this structure, compiled at its first call: (constants,
    (states, values)) -> states and values.
    """
    import jax

    def step(constants: list[Array], states: States, values: Values) -> tuple[States, Values]:
        values = values._replace(model=Model())
        states, values = stepped(filled(stages, iter(constants)), states, values)
        return states, _without(values, *_KEPT_VALUES)

    return jax.jit(step, compiler_options={"xla_cpu_multi_thread_eigen": False})
