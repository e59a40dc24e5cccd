"""Ticks of a group of envs in one native call, as long as no event needs Python."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.sim.engine.native.interface import TRANSFERS, Transfer
from batchpid.sim.engine.protocol import CompiledStep
from batchpid.sim.loop.arrays import Arrays, FaultArrays
from batchpid.sim.loop.tick_program import TickProgram


class Shown(NamedTuple):
    """Arrays of a group's observation besides positions and velocities, the same arrays in every tick.

    Effort, saturated and guarded joints of the last tick (envs, dof), and the last fault of each env (envs,).
    """

    effort: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    guarded: NDArray[np.bool_]
    fault: FaultArrays


class QuietTicks:
    """Ticks of ``program`` with commands and observations in ``arrays`` (ticks, envs, ...), and in ``shown``.

    Possible under control "pid" or "effort", without sensors, while no env is suspended.
    """

    def __init__(self, program: TickProgram, arrays: Arrays, shown: Shown) -> None:
        outputs, seen, self.program = program.outputs, arrays.observation, program
        self._kept = list[NDArray[Any]]()
        transfers = list[Transfer]()

        def add(kind: str, table: NDArray[Any], row: NDArray[Any], stride: int | None = None) -> None:
            dtype = {"read": np.float64, "write_floats": np.float32}.get(kind, row.dtype)
            is_fit = table.dtype == dtype and row.flags.c_contiguous and table[0].flags.c_contiguous
            if not is_fit or table.shape[1:] != row.shape:
                raise ValueError(f"a table {table.shape} of {table.dtype} does not fit rows {row.shape} of {row.dtype}")
            addresses, size = (table.ctypes.data, row.ctypes.data), row.nbytes if kind == "write_bytes" else row.size
            stride = table.strides[0] if stride is None else stride
            transfers.append(Transfer(*addresses, stride, size, TRANSFERS.index(kind)))
            self._kept.extend((table, row))

        for table, row in zip(arrays.command, program.command, strict=True):
            if row is not None:
                add("read", table, row)
        for table, row in ((seen.qpos, program.reading.qpos), (seen.qvel, program.reading.qvel)):
            add("write_floats", table, row)
        add("write_floats", seen.effort, outputs.motor)
        add("write_floats", shown.effort[None], outputs.motor, 0)
        none = np.zeros(shown.saturated.shape, bool)
        for table, kept, output in (
            (seen.saturated, shown.saturated, outputs.saturated),
            (seen.guarded, shown.guarded, outputs.guarded),
        ):
            row = none if output is None else output
            add("write_bytes", table, row)
            add("write_bytes", kept[None], row, 0)
        add("write_bytes", seen.ok, np.ones(len(none), bool))
        for table, row in zip(arrays.fault, shown.fault, strict=True):
            add("write_bytes", table, row)
        self._transfers = (Transfer * len(transfers))(*transfers)

    def run(self, step: CompiledStep, first: int, until: int, steps: int) -> tuple[int, int, int]:
        """Run ticks of ``steps`` sim steps from ``first`` to ``until``; return the fields of a :class:`Stopped`."""
        return self.program.run_ticks(step, self._transfers, first, until, steps)
