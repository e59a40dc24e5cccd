"""The arrays between a loop and its caller, in shared memory where they are in different processes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.observation import OBSERVED, Observation

Layout = dict[str, tuple[tuple[int, ...], Any]]
"""Name -> (shape, dtype)."""


class Command(NamedTuple):
    """Command of one tick, (envs, dof), or of several, (ticks, envs, dof); None where nothing is given."""

    setpoint: Any
    """[rad or m]; under control "effort" the joint effort [N m or N]."""
    setpoint_rate: Any = None
    """[rad/s or m/s]"""
    feedforward: Any = None
    """Effort added before saturation [N m or N]."""

    def map(self, function: Any) -> Command:
        """Return a command with ``function`` applied to each array that is given."""
        return Command._make(None if rows is None else function(rows) for rows in self)


class FaultArrays(NamedTuple):
    """Last fault of each env (envs,): sim step (-1: none), joint, and index into :data:`sim.loop.faults.CAUSES`."""

    step: NDArray[np.int64]
    joint: NDArray[np.int64]
    cause: NDArray[np.int64]


class Arrays(NamedTuple):
    """Input and output of one tick of a loop, one row per env. Rate and feedforward count only when a tick says so."""

    command: Command
    observation: Observation
    fault: FaultArrays

    @staticmethod
    def layout(ticks: int, num_envs: int, dof: int) -> Layout:
        """Return name -> (shape, dtype) of every field, for so many ticks: see :meth:`of_ticks`."""
        row, table = (ticks, num_envs), (ticks, num_envs, dof)
        layout: Layout = {f"command.{name}": (table, np.float64) for name in Command._fields}
        for name, quantity in OBSERVED.items():
            layout[f"observation.{name}"] = (table if quantity.per_joint else row, quantity.dtype)
        return layout | {f"fault.{name}": (row, np.int64) for name in FaultArrays._fields}

    @staticmethod
    def of_ticks(fields: dict[str, NDArray[Any]], envs: slice) -> list[Arrays]:
        """Return views of ``envs``, for each of the ticks in ``fields``, which are as :meth:`layout` says."""
        kinds: dict[str, Any] = {"command": Command, "observation": Observation, "fault": FaultArrays}

        def views(tick: int) -> Arrays:
            return Arrays(
                **{
                    group: kind(**{name: fields[f"{group}.{name}"][tick, envs] for name in kind._fields})
                    for group, kind in kinds.items()
                }
            )

        return [views(tick) for tick in range(len(fields["observation.ok"]))]

    def for_envs(self, envs: slice) -> Arrays:
        """Return views of some envs."""
        command, observation, fault = self
        return Arrays(
            command.map(lambda rows: rows[envs]),
            observation.for_envs(envs),
            FaultArrays._make(rows[envs] for rows in fault),
        )
