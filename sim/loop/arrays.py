"""Arrays between a loop and its caller, in shared memory where they are in different processes."""

from __future__ import annotations

from collections.abc import Mapping
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Rows
from batchpid.sim.signals.quantities import Observation, Quantity
from batchpid.stages.values import Command

Layout = dict[str, tuple[tuple[int, ...], Any]]
"""Name -> (shape, dtype)."""


class FaultArrays(NamedTuple):
    """Last fault of each env (envs,): sim step (-1: none), joint, and index into
    :data:`batchpid.sim.loop.faults.CAUSES`.

    Where the cause is one of :data:`batchpid.sim.loop.faults.COMMAND_CAUSES`, ``joint`` is the
    entry of the command.
    """

    step: NDArray[np.int64]
    joint: NDArray[np.int64]
    cause: NDArray[np.int64]


class Arrays(NamedTuple):
    """Input and output of a loop, with leading axes (envs,) for one tick or (ticks, envs) for
    several.
    """

    command: Command
    observation: Observation
    fault: FaultArrays

    @staticmethod
    def layout(
        ticks: int,
        num_envs: int,
        dof: int,
        command_size: int,
        observed: Mapping[str, Quantity],
    ) -> Layout:
        """Return the layout of all fields, for :meth:`from_fields`; a setpoint has ``command_size``
        numbers.
        """
        row = (ticks, num_envs)
        table = (ticks, num_envs, dof)
        setpoint = (*row, command_size)
        sizes = Command(setpoint, setpoint, setpoint, table)
        layout: Layout = {
            f"command.{name}": (shape, np.float64) for name, shape in sizes._asdict().items()
        }
        for name, quantity in observed.items():
            layout[f"observation.{name}"] = (quantity.shape(table), quantity.dtype)
        return layout | {f"fault.{name}": (row, np.int64) for name in FaultArrays._fields}

    @staticmethod
    def from_fields(fields: Mapping[str, Rows]) -> Arrays:
        """Return the arrays of ``fields``, named as in :meth:`layout`."""

        def group(kind: Any, prefix: str) -> Any:
            return kind(*[fields.get(f"{prefix}.{name}") for name in kind._fields])

        return Arrays(
            group(Command, "command"),
            group(Observation, "observation"),
            group(FaultArrays, "fault"),
        )

    def at(self, index: object) -> Arrays:
        """Return views at an index of the leading axes, such as a tick or a slice of envs."""
        part = itemgetter(index)
        return Arrays(
            self.command.map(part),
            self.observation.map(part),
            FaultArrays._make(map(part, self.fault)),
        )
