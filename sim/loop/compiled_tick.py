"""Ticks of a group of envs by the program of :mod:`sim.loop.program`, and the state that goes in and out of it."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.coefficients import Coefficients
from batchpid.friction import Friction, FrictionState
from batchpid.jax_settings import own_settings
from sim.engine.engines import scene_dynamics
from sim.engine.protocol import FAILED, CompiledPack, CompiledStep
from sim.engine.protocol import EnginePack as Pack
from sim.loop.actuators import JointActuators
from sim.loop.arrays import Command
from sim.loop.backend import obstacle
from sim.loop.control import Control, EffortControl, PIDControl
from sim.loop.custom import CustomControl, controller_errors
from sim.loop.friction import JointFriction
from sim.loop.jitted import padded, program_rows, put, shared_call
from sim.loop.program import Carry, Constants, Layout, compiled
from sim.loop.snapshot import AGE
from sim.options import RunnerOptions


class CompiledTick:
    """Sim steps of the ticks of one group of envs, by one program.

    It takes over the state of ``control`` and ``friction`` with the first sim steps, and gives it back by
    :meth:`release`.
    """

    def __init__(
        self,
        options: RunnerOptions,
        pack: CompiledPack,
        control: Control,
        friction: JointFriction,
        compensated: tuple[bool, bool, bool],
    ) -> None:
        """Prepare; ``compensated``: gravity, Coriolis and centrifugal forces, known friction."""
        self._pack, self._control, self._friction, self._options = pack, control, friction, options
        self._gravity, self._coriolis, compensates = compensated
        self._speed_limit = None if options.speed_limit is None else np.asarray(options.speed_limit)
        controller = shared_call(options, control) if isinstance(control, CustomControl) else None
        law = control.law if isinstance(control, PIDControl) else None
        self._controller = options.control if isinstance(control, CustomControl) else None
        self._layout = Layout(law, controller, compensates)
        self._carry: Carry | None = None
        self._matrix: Any = None
        self._constants: tuple[tuple[Any, ...], Constants] | None = None
        self._zero: Any = None
        self._native: CompiledStep | None = None
        self._bound: tuple[Any, bool] | None = None

    def run(self, command: Command, begin: int, end: int) -> tuple[int, int]:
        """Run the sim steps of a tick from ``begin`` to ``end``; return the steps done, and the status of the last."""
        pack = self._pack
        constants = self._take_constants()
        if self._bound != (bound := (pack.calls, self._needs_qvel)):  # robots, systems or the law have changed
            self._bound = bound
            self._native = pack.compiled_step(self._gravity, self._coriolis, self._needs_qvel, self._speed_limit)
            if self._carry is not None:
                self._carry = self._carry._replace(**self._read())
        native = self._native
        assert native is not None
        with own_settings(self._options.dtype):
            carry = self._take_over() if self._carry is None else self._carry
            span = np.array([begin, end, 0, 0], np.int32)
            span[2:].view(np.uint64)[0] = native.prepare()
            command = command.map(padded)
            extra = self._zero if command.feedforward is None else put(command.feedforward)
            # A JAX array either way: with another kind the program would be compiled again.
            command = command._replace(feedforward=extra)
            with controller_errors(self._controller, begin + 1):
                carry = compiled(self._layout)(span, constants, carry, command)
            done, status = np.asarray(carry.progress).tolist()
        self._carry = carry
        if status & FAILED:
            raise RuntimeError(native.message)
        return done, status

    def read(self, name: str, dtype: Any = np.float64) -> NDArray[Any]:
        """Return an array (envs, dof) of :class:`Carry` after the last sim step, a new array."""
        return self._rows(getattr(self._carry, name), dtype)

    def look(self) -> None:
        """Let the pack do what the last sim step stopped for."""
        self._pack.look([] if self._native is None else self._native.left())

    def release(self) -> None:
        """Give the state back to the control and the friction model, which may change it, and the robots'."""
        carry, self._carry = self._carry, None
        if carry is None:
            return
        count = self._pack.size
        self._matrix = carry.matrix
        law = {name: np.array(leaf)[:count] for name, leaf in carry.law.items()}
        self._control.write(law, self._rows(carry.saturated, bool))
        if carry.friction.effort is not None:
            leaves = {name: self._rows(leaf) for name, leaf in carry.friction._asdict().items()}
            self._friction.write({**leaves, AGE: self._rows(carry.age, np.int64)})

    def _rows(self, array: Any, dtype: Any = np.float64) -> NDArray[Any]:
        """Return the rows of the envs, a new array."""
        return np.array(array, dtype)[: self._pack.size]

    def _read(self) -> dict[str, Any]:
        """Return positions, velocities and passive force of the robots."""
        pack = self._pack
        passive = (
            pack.passive_force(self._gravity, self._coriolis) if self._gravity else np.zeros((pack.size, pack.dof))
        )
        with own_settings(self._options.dtype):
            arrays = {"qpos": pack.read_qpos(), "qvel": pack.read_qvel(), "passive": passive}
            return {name: put(padded(rows)) for name, rows in arrays.items()}

    def _take_over(self) -> Carry:
        """Return the state of control, friction model and robots."""
        state = self._friction.read()
        age = state.pop(AGE, np.zeros(self._pack.size))
        read = self._read()
        matrix = self._matrix
        if (law := self._layout.law) is not None and self._needs_matrix:
            shape = read["qpos"].shape
            shape = (*shape, shape[1]) if law.whole else shape
            matrix = np.zeros(shape) if matrix is None or matrix.shape != shape else matrix
        own = {
            "progress": np.zeros(2, np.int32),
            "law": {name: padded(leaf) for name, leaf in self._control.read().items()},
            "friction": FrictionState(**{name: padded(rows) for name, rows in state.items()}),
            "age": padded(age.astype(np.int32)),
            "matrix": matrix if self._needs_matrix else None,
            "motor": np.zeros((program_rows(self._pack.size), self._pack.dof)),
            "saturated": padded(self._control.saturated),
        }
        return Carry(qpos_before=read["qpos"], **read, **put(own))

    @property
    def _needs_qvel(self) -> bool:
        law, controller = self._layout.law, self._layout.controller
        measured = controller is not None if law is None else law.measures_rate
        return self._needs_matrix or measured or self._friction.acts

    @property
    def _needs_matrix(self) -> bool:
        law = self._layout.law
        return law is not None and (law.whole or law.per_inertia)

    def _take_constants(self) -> Constants:
        """Return the constants, made when params or friction have changed."""
        control, friction, pack = self._control, self._friction, self._pack
        sources = control.params, friction.model
        if self._constants is not None and all(map(operator.is_, self._constants[0], sources)):
            return self._constants[1]
        pid = control if isinstance(control, PIDControl) else None
        if pid is not None:
            self._layout = self._layout._replace(law=pid.law)
        needs_bodies = self._needs_matrix or friction.model.coulomb is not None
        bodies = scene_dynamics(pack.spec).bodies if needs_bodies else None

        def spread(array: Any) -> Any:
            return None if array is None else padded(np.broadcast_to(array, (pack.size, pack.dof)))

        k = pid and Coefficients(
            *(leaf if leaf is None or isinstance(leaf, tuple) else spread(leaf) for leaf in pid.coefficients)
        )
        limits = (control.params.effort_min, control.params.effort_max)
        constants = Constants(
            timestep=np.float64(pack.spec.timestep),
            k=k or None,
            limits=(None, None) if pid else (spread(limits[0]), spread(limits[1])),
            damping=None if pid is None else pid.damping,
            tree=None if bodies is None else bodies.tree,
            bodies=None if bodies is None else bodies.table(),
            friction=Friction(*map(spread, friction.model)),
            known=friction.known,
        )
        with own_settings(self._options.dtype):
            self._constants = sources, put(constants)
            self._zero = put(np.zeros((program_rows(pack.size), pack.dof)))
        return self._constants[1]


def compiled_tick(
    options: RunnerOptions,
    pack: Pack,
    control: Control,
    friction: JointFriction,
    actuators: JointActuators | None,
    compensated: tuple[bool, bool, bool],
) -> CompiledTick | None:
    """Return the sim steps of a tick as one program; None where that is not asked for, or cannot be."""
    if options.backend == "numpy" or not isinstance(control, PIDControl | EffortControl | CustomControl):
        return None
    if not isinstance(pack, CompiledPack) or obstacle(options, None if actuators is None else actuators.actuators):
        return None
    return CompiledTick(options, pack, control, friction, compensated)
