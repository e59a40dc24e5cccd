"""Arrays between a loop and its caller, in shared memory where they are in different processes."""

from __future__ import annotations

from collections.abc import Mapping
from operator import itemgetter
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
        return Command(*[None if rows is None else function(rows) for rows in self])


class FaultArrays(NamedTuple):
    """Last fault of each env (envs,): sim step (-1: none), joint, and index into :data:`sim.loop.faults.CAUSES`.

    Without collisions, ``missed_contact`` is the sim step of its first missed contact (0: none).
    """

    step: NDArray[np.int64]
    joint: NDArray[np.int64]
    cause: NDArray[np.int64]
    missed_contact: NDArray[np.int64]


class Arrays(NamedTuple):
    """Input and output of a loop, with leading axes (envs,) for one tick or (ticks, envs) for several.

    Each run tells which commands it uses; the others are ignored.
    """

    command: Command
    observation: Observation
    fault: FaultArrays

    @staticmethod
    def layout(ticks: int, num_envs: int, dof: int) -> Layout:
        """Return the layout of all fields, for :meth:`from_fields`."""
        row, table = (ticks, num_envs), (ticks, num_envs, dof)
        layout: Layout = {f"command.{name}": (table, np.float64) for name in Command._fields}
        for name, quantity in OBSERVED.items():
            layout[f"observation.{name}"] = (table if quantity.per_joint else row, quantity.dtype)
        return layout | {f"fault.{name}": (row, np.int64) for name in FaultArrays._fields}

    @staticmethod
    def from_fields(fields: Mapping[str, NDArray[Any]]) -> Arrays:
        """Return the arrays of ``fields``, named as in :meth:`layout`."""

        def group(kind: Any, prefix: str) -> Any:
            return kind(*(fields[f"{prefix}.{name}"] for name in kind._fields))

        return Arrays(group(Command, "command"), group(Observation, "observation"), group(FaultArrays, "fault"))

    def at(self, index: Any) -> Arrays:
        """Return views at an index of the leading axes, such as a tick or a slice of envs."""
        part = itemgetter(index)
        command, observation, fault = (map(part, group) for group in self)
        return Arrays(Command._make(command), Observation._make(observation), FaultArrays._make(fault))


class Ticks:
    """Views of :class:`Arrays` (ticks, envs, ...) at each tick, made when first used."""

    def __init__(self, arrays: Arrays) -> None:
        self._arrays, self._views = arrays, list[Arrays]()

    def __len__(self) -> int:
        return len(self._arrays.observation.ok)

    def __getitem__(self, tick: int) -> Arrays:
        """Return the views at a tick, 0 or more."""
        views = self._views
        return views[tick] if tick < len(views) else self.first(tick + 1)[tick]

    def first(self, count: int) -> list[Arrays]:
        """Return the views at the first ``count`` ticks."""
        views = self._views
        while len(views) < count:
            views.append(self._arrays.at(len(views)))
        return views[:count]
