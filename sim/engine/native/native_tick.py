"""Sim steps of a tick in one native call: a program of the control step, mass matrices, and the engine; see tick.h."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.native.array_program import ArrayProgram
from batchpid.sim.engine import native
from batchpid.sim.engine.native.interface import Tick

_TYPES = {"tree": np.int32, "leader": np.int32, "age": np.int64}
"""Dtypes of arrays that are not float64."""


class NativeTick:
    """Sim steps of a pack under a program, on fixed arrays.

    Parameters
    ----------
    program
        Program of the control step for the pack's envs.
    inputs, outputs
        Arrays that it reads and writes, (envs, dof), or among its inputs (envs, ...) for matrices and histories and ()
        for a number.
    timestep
        [s]
    matrix_steps
        Sim steps for which a mass matrix is kept within a tick.
    whole
        Whether ``matrix`` is the whole mass matrix or its diagonal.
    control
        Address of a native controller (``Call`` in call.h), whose effort is one of the program's inputs.
    compensated
        Parts of the passive force: whether it cancels gravity, and Coriolis and centrifugal forces.
    measured_force, read_force
        Address of a model (:class:`batchpid.sim.engine.native_model.NativeModel`) by which ``passive`` is computed at
        the measured state before each control step, or at the reading after each sim step.
    refresh
        Address of the friction model (:class:`batchpid.sim.engine.native_model.NativeRefresh`).
    coupling_steps
        Sim steps for which the constraint efforts of coupled joints keep their mass matrix.
    sensors
        Program of the sensors, its inputs and its outputs. Its last inputs are the noise (:meth:`run`).
    late, left
        Whether the law takes its setpoint at the end of a sim step, and the number () to which the time from there to
        the end of the tick is written [s].
    forward
        Program that runs before the controller, its inputs and its outputs: of the feedforward that it takes.
    arrays
        Arrays by field of :class:`batchpid.sim.engine.native.interface.Tick`: reading ``qpos``, ``qvel`` and
        ``passive``, positions ``before`` the last sim step, the efforts ``qf``; and for a mass matrix ``matrix``,
        ``tree`` and ``bodies`` (:attr:`batchpid.task_space.RigidTree.tables`), ``armature`` and ``damping``
        (dof,), ``leader`` and ``multiplier`` of coupled joints (dof,), and ``pose`` and ``rate`` if sensors measure
        others than the reading; ``gain``, ``memory`` and ``age`` (envs,) of the friction model; ``target`` and
        ``target_rate`` of drives, if they move within a tick.
    """

    def __init__(
        self,
        program: ArrayProgram,
        inputs: Sequence[NDArray[Any]],
        outputs: Sequence[NDArray[Any]],
        *,
        timestep: float,
        matrix_steps: int = 1,
        whole: bool = False,
        control: int | None = None,
        compensated: tuple[bool, bool] = (False, False),
        measured_force: int | None = None,
        read_force: int | None = None,
        refresh: int | None = None,
        coupling_steps: int = 1,
        late: int = 0,
        sensors: tuple[ArrayProgram, Sequence[NDArray[Any]], Sequence[NDArray[Any]]] | None = None,
        forward: tuple[ArrayProgram, Sequence[NDArray[Any]], Sequence[NDArray[Any]]] | None = None,
        **arrays: NDArray[Any] | None,
    ) -> None:
        arrays = {"pose": arrays["qpos"], "rate": arrays["qvel"], **arrays}
        given = {name: array for name, array in arrays.items() if array is not None}
        for name, array in given.items():
            wanted = np.dtype(_TYPES.get(name, np.float64))
            if array.dtype != wanted or not array.flags.c_contiguous:
                raise ValueError(f"{name} is not a contiguous array of {wanted}")
        self._native = native.extension("_gateway")
        self._program = self._bind(program, inputs, outputs)
        self._others = [None if each is None else self._bind(*each) for each in (sensors, forward)]
        addresses = {name: array.ctypes.data for name, array in given.items()}
        calls = {"control": control, "refresh": refresh, "measured_force": measured_force, "read_force": read_force}
        steps = {"matrix_steps": matrix_steps, "coupling_steps": coupling_steps, "dof": program.shape[1], "late": late}
        parts = dict(zip(("gravity", "coriolis"), compensated, strict=True))
        self._tick = Tick(timestep=timestep, whole=whole, **steps, **parts, **calls, **addresses)
        self._address = ctypes.addressof(self._tick)
        self._kept = inputs, outputs, given, sensors, forward

    def _bind(self, program: ArrayProgram, inputs: Sequence[NDArray[Any]], outputs: Sequence[NDArray[Any]]) -> Any:
        """Return a program with its arrays."""
        pairs = tuple([(array, 0 if array.ndim == 2 else array[0].size if array.ndim else -1) for array in inputs])
        return self._native.bind(program.arguments, pairs, tuple(outputs))

    def run(self, group: int, begin: int, until: int, end: int, *noise: NDArray[np.float64]) -> tuple[int, int]:
        """Run sim steps from ``begin`` to ``until`` of a tick of ``end``; return the steps done, and the last status.

        ``group`` is the address of the native group: :meth:`batchpid.sim.engine.protocol.CompiledStep.prepare`.
        ``noise`` are the last inputs of the sensors' program in these steps (steps or more, envs, dof), contiguous.
        """
        for place, block in enumerate(noise):
            self._tick.noise[place] = block.ctypes.data
        return self._native.tick(self._program, self._address, group, begin, until, end, *self._others)

    def run_ticks(self, group: int, transfers: Any, first: int, until: int, steps: int) -> tuple[int, int, int]:
        """Run ticks of ``steps`` sim steps from ``first`` to ``until``, or until something needs attention.

        ``transfers`` is a ctypes array of :class:`batchpid.sim.engine.native.interface.Transfer`. Return the number of
        the tick that is not complete, or ``until``, its sim steps that are done, and the last status. The programs of
        sensors are not run.
        """
        at, count = ctypes.addressof(transfers), len(transfers)
        return self._native.ticks(self._program, self._address, group, at, count, first, until, steps)
