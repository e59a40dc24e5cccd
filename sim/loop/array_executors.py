"""Sim steps of a tick in NumPy, stage by stage: the oracle of the other executors, and the executor
of controllers in Python; and in programs of JAX.
"""

from __future__ import annotations

from functools import lru_cache, partial
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Float64, Pytree, Rows
from batchpid.arrays.elementwise import precision
from batchpid.arrays.trees import filled, leaves, mapped, structure
from batchpid.motors import measurement_noise
from batchpid.sim.engine.native_model import NativeStep
from batchpid.sim.loop.env_parts import controller_errors
from batchpid.sim.loop.faults import is_near
from batchpid.sim.loop.group_control import GroupControl
from batchpid.stages.stage import States, recalled, running, stepped
from batchpid.stages.values import Command, Measured, Model, Outputs, Step, Values

COUPLING_STEPS = 4
"""Sim steps for which the constraint efforts of coupled joints keep their mass matrix within a
tick.
"""


NOISE_STEPS = 64
"""Sim steps for which the noise of sensors is drawn at once."""


class Executor:
    """Executor of the sim steps of the robots of ``setup``, from the ``states`` of its stages on;
    this base has the engine's steps.

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

    measured: Measured
    outputs: Outputs
    before: Rows

    def __init__(self, setup: GroupControl, states: States) -> None:
        pack, control = setup.pack, setup.control
        self.setup = setup
        self.failed = False
        self._states = states
        self._places = {stage.name: place for place, stage in enumerate(setup.stages)}
        self._parts = control.gravity, control.coriolis
        # Otherwise the force is 0, or a stage computes it at the measured state.
        self._reads_force = control.gravity and not control.measures
        self._is_native = pack.steps_natively
        self._native_force = False  # whether the native sim step reads the force
        if self._is_native and self._reads_force:
            self._native_force = pack.steps_read_force(*self._parts)
        self._step: NativeStep
        self._bound: object = None
        self._noise: Pytree = None
        self._first = -NOISE_STEPS  # sim step of the noise's first row

    def state(self, name: str) -> Any:
        """Return the state of a stage by name; None if it does not apply."""
        place = self._places.get(name)
        return None if place is None else self._states[place]

    def add_chunk(self, chunk: Float64, latency: Float64) -> None:
        """Add a chunk (M, rows, dof) that is ``latency`` (M,) [s] old to the plan."""
        states = list(self._states)
        place = self._places["plan"]
        states[place] = self.setup.stages[place].add(states[place], chunk, latency)
        self.write_state(tuple(states))

    def read_state(self) -> States:
        """Return the states as NumPy arrays, which the next sim steps do not change."""
        return self._states

    def write_state(self, states: States) -> None:
        """Replace the states by others with arrays of the same shapes."""
        self._states = states
        self._first = -NOISE_STEPS  # they may have other keys of noise

    def draw_noise(self) -> Any:
        """Return the noise of positions and velocities in the next sim steps (steps, M, dof), as far
        as it has been drawn: :func:`batchpid.motors.measurement_noise`; None without noise.
        """
        sensors = self.state("sensors")
        if sensors is None or sensors.key is None:
            return None
        # All envs advance by the same number of steps.
        step = int(sensors.step[0])
        if not 0 <= step - self._first < NOISE_STEPS:
            steps = sensors.step + np.arange(NOISE_STEPS, dtype=np.uint32)[:, None]
            k, like = self.setup.stage("sensors").k, np.zeros_like(self.measured.qpos)
            self._noise = measurement_noise(k, sensors.key, steps, like, np)
            self._first = step
        return mapped(itemgetter(slice(step - self._first, None)), self._noise)

    def measure(self) -> None:
        """Read the robots, after a change of their states between sim steps."""
        self.measured = self._reading()

    def _reading(self) -> Measured:
        pack = self.setup.pack
        qpos = pack.read_qpos()
        return Measured(qpos, pack.read_qvel(), self._passive_force(qpos))

    def _passive_force(self, like: Float64) -> Float64:
        if self._reads_force:
            return self.setup.pack.passive_force(*self._parts)
        return np.zeros_like(like)

    def compiled(self) -> NativeStep:
        """Return the native sim step of the present robots."""
        pack = self.setup.pack
        if self._bound is not pack.calls:
            parts = self._parts if self._native_force else (False, False)
            drives = self.setup.control.mode == "drive"
            self._bound = pack.calls
            self._step = pack.compiled_step(*parts, drives)
        return self._step


class NumPyExecutor(Executor):
    """Executor in NumPy: the oracle of the native one."""

    def __init__(self, setup: GroupControl, states: States) -> None:
        super().__init__(setup, states)
        self.outputs = Outputs()
        self.measure()

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
            measured = self.measured
            self.before = measured.qpos  # where a robot that fails now is suspended
            values = Values(
                command,
                measured,
                measured,
                control.timestep,
                step,
                setup.model,
                noise=mapped(itemgetter(0), self.draw_noise()),
            )
            with controller_errors(control.controller, index + 1):
                self.outputs = outputs = self._stepped(values).outputs
            # Writing the targets of drives costs a call for each joint.
            if outputs.target is not None and (every or index == begin):
                pack.write_drive_target(outputs.target, outputs.target_rate)
            if not control.coupling.is_identity and index % COUPLING_STEPS == 0:
                pack.update_constraint()
            self._advance(outputs.qf)
            if self.failed:
                return index + 1
        return end

    def _stepped(self, values: Values) -> Values:
        """Advance the stages by a sim step; return the values after them."""
        self._states, values = stepped(self.setup.stages, self._states, values)
        return values

    def _advance(self, qf: Rows) -> None:
        """Do a sim step of the engine with the efforts ``qf`` (M, dof), in one native call where it
        has it, and read the robots.
        """
        pack = self.setup.pack
        if not self._is_native:
            pack.write_qf(qf)
            pack.step()
            self.measure()
            self.failed = not is_near(self.measured.qpos)
            return
        step = self.compiled()
        qpos, qvel, passive = np.empty((3, *qf.shape))
        status = step(np.ascontiguousarray(qf, np.float64), qpos, qvel, passive)
        if not self._native_force:
            passive = self._passive_force(qpos)
        self.measured = Measured(qpos, qvel, passive)
        self.failed = step.may_have_failed(status)


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
        self._programs = list[tuple[slice, Any]]()
        first = 0
        for calls_model, group in groupby(setup.stages, attrgetter("calls_model")):
            part = running(group)
            program = None
            if not calls_model:
                program = partial(_compiled(structure(part)), self._constants(part))
            self._programs.append((slice(first, first + len(part)), program))
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
            for part, program in self._programs:
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
