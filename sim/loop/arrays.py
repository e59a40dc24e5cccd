"""The arrays between a loop and its caller, in shared memory where they are in different processes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Layout = dict[str, tuple[tuple[int, ...], Any]]
"""Name -> (shape, dtype)."""


class Arrays(NamedTuple):
    """What goes in and out of a loop, one row per env: (envs, dof), ``ok`` (envs,).

    ``setpoint`` [rad or m] is the effort [N m or N] under control "effort"; ``setpoint_rate`` and ``feedforward``
    count only when a tick says so. ``effort`` and ``saturated`` are those of the last substep. ``fault_step`` is the
    sim step in which the env failed (-1: it did not), ``fault_joint`` where, ``fault_cause`` an index into
    :data:`sim.loop.faults.CAUSES`.
    """

    setpoint: NDArray[np.float64]
    setpoint_rate: NDArray[np.float64]
    feedforward: NDArray[np.float64]
    qpos: NDArray[np.float32]
    qvel: NDArray[np.float32]
    effort: NDArray[np.float32]
    saturated: NDArray[np.bool_]
    ok: NDArray[np.bool_]
    fault_step: NDArray[np.int64]
    fault_joint: NDArray[np.int64]
    fault_cause: NDArray[np.int64]

    @staticmethod
    def layout(ticks: int, num_envs: int, dof: int) -> Layout:
        """Name -> (shape, dtype) of every field, for so many ticks: see :meth:`of_ticks`."""
        row, table = (ticks, num_envs), (ticks, num_envs, dof)
        doubles = ("setpoint", "setpoint_rate", "feedforward")
        return (
            {name: (table, np.float64) for name in doubles}
            | {name: (table, np.float32) for name in ("qpos", "qvel", "effort")}
            | {"saturated": (table, np.bool_), "ok": (row, np.bool_)}
            | {name: (row, np.int64) for name in ("fault_step", "fault_joint", "fault_cause")}
        )

    @staticmethod
    def of_ticks(fields: dict[str, NDArray[Any]], envs: slice) -> list[Arrays]:
        """Views of ``envs``, for each of the ticks in ``fields``, which are as :meth:`layout` says."""
        ticks = range(len(fields["ok"]))
        return [Arrays(**{name: field[tick, envs] for name, field in fields.items()}) for tick in ticks]

    def rows(self, envs: slice) -> Arrays:
        """Views of some envs."""
        return Arrays._make(field[envs] for field in self)
