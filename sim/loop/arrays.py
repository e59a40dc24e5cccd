"""Arrays between a loop and its caller, in shared memory where they are in different processes;
and snapshots: the state of all envs, physics and controller, as arrays by name.

A snapshot is a barrier. The engine has more state than positions and velocities: contact caches,
warm starts, and the order in which it solves contacts. All of these depend on the past, and can be
neither read nor written. So every continuation from a snapshot, in this process or in another,
starts in a new world in that state, and the results are bit-identical. The barrier itself changes
the last bits.

:meth:`Snapshot.check_rows` checks names, shapes and dtypes of the arrays against the runner's own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.errors import InvalidArgumentError
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.signals import Observation
from batchpid.stages import STAGES
from batchpid.stages.law import Own
from batchpid.stages.values import Command

Layout = dict[str, tuple[tuple[int, ...], Any]]
"""Name -> (shape, dtype)."""


class FaultArrays(NamedTuple):
    """Last fault of each env (envs,): sim step (-1: none), joint, and index into
    :data:`batchpid.sim.loop.faults.CAUSES`.

    Where the cause is an array of the command, ``joint`` is its entry.
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
    def layout(options: RunnerOptions, ticks: int, num_envs: int) -> Layout:
        """Return the layout of all fields, for :meth:`from_fields`."""
        row = (ticks, num_envs)
        table = (*row, options.robot.dof)
        setpoint = (*row, options.command.size)
        layout: Layout = {f"command.{name}": (setpoint, np.float64) for name in Command._fields}
        layout["command.feedforward"] = (table, np.float64)
        for name, quantity in options.observed.items():
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


_SAME_CONTENT = "take one with the same build=, and keep each env's number where it depends on it"


@dataclass(frozen=True, eq=False, repr=False)
class Snapshot:
    """State of all envs of a runner at one moment. ``pickle`` keeps it in a file."""

    about: Document
    """Options that a runner must share to restore it:
    :attr:`batchpid.sim.RunnerOptions.described`.
    """
    steps: int
    """Sim steps up to this moment."""
    params: bp.PIDParams
    rows: dict[str, Rows]
    """State of the envs, arrays (envs, ...) by name: :meth:`batchpid.sim.loop.env_group.EnvGroup.read`.

    Besides these there are ``motion``, the last joint setpoints and their rates (envs, 2, dof),
    where setpoints are for joints, and with a randomization ``episodes``, stream and episode of
    each env (envs, 2), from which everything is drawn again.
    """
    actuators: bp.Actuators | None = None

    def check_options(self, about: Document) -> None:
        """Raise InvalidArgumentError if a runner with options ``about`` cannot restore it."""
        others = [key for key, ours in about.items() if self.about.get(key) != ours]
        if others:
            problem = f"comes from a runner with another {' and '.join(others)}"
            raise InvalidArgumentError("snapshot", problem, remedy="take one with the same options")

    def check_rows(self, own: Mapping[str, Rows]) -> None:
        """Check names, shapes and dtypes of the arrays against the runner's ``own``: but for the
        states of batchpid's stages, which follow from the params and actuators.

        Raises
        ------
        InvalidArgumentError
            An array is missing, unknown, or of another shape or dtype, or an env has other content.
        """
        decided = {kind.name for kind in STAGES}
        if self.about["control"] not in ("pid", "drive", "effort"):
            decided.remove(Own.name)
        theirs, ours = (
            {
                name: f"{table.dtype.str} {table.shape}"
                for name, table in rows.items()
                if not (name.startswith("control/") and name.split("/")[1] in decided)
            }
            for rows in (self.rows, own)
        )
        for name in ours | theirs:
            kind, other = theirs.get(name), ours.get(name)
            _expect(kind == other, f"has {kind} for {name}, not {other}")
        # The engine's values of an env end where NaN begin.
        lengths = np.isnan(self.rows["engine"]) == np.isnan(own["engine"])
        _expect(lengths.all(), "holds other content than this runner's build makes", _SAME_CONTENT)

    def for_envs(self, envs: slice | Sequence[int] | Rows) -> Snapshot:
        """Return a snapshot of the envs with these numbers, in this order, and repeatedly where a
        number repeats.

        A runner of as many envs restores it, if its ``build`` makes the same content for each as
        for the original. An env continues bit by bit as the original would, with the noise of the
        original's sensors, until it is reset.

        Raises
        ------
        IndexError
            A number is not one of an env.
        """
        envs = np.arange(len(self.rows["effort"]))[envs]
        return replace(
            self,
            about=self.about | {"num_envs": len(envs)},
            params=self.params.for_envs(envs),
            rows={name: rows[envs] for name, rows in self.rows.items()},
            actuators=None if self.actuators is None else self.actuators.for_envs(envs),
        )

    def copy(self) -> Snapshot:
        """Return a snapshot with arrays of its own."""
        return self.for_envs(slice(None))


def join_rows(parts: Sequence[dict[str, Rows]]) -> dict[str, Rows]:
    """Return the state of the envs of all ``parts``. Where ``build`` adds other content to an env,
    the engine has fewer values for it, with NaN after them.
    """
    width = max(part["engine"].shape[1] for part in parts)
    joined = {}
    for name in parts[0]:
        tables = [part[name] for part in parts]
        if name == "engine":
            tables = [_widened(table, width) for table in tables]
        joined[name] = np.concatenate(tables)
    return joined


def _widened(table: Rows, width: int) -> Rows:
    """Return a table with NaN in further columns."""
    missing = width - table.shape[1]
    return np.pad(table, ((0, 0), (0, missing)), constant_values=np.nan)


def _expect(holds: Any, problem: str, remedy: str = "take one with the same options") -> None:
    """Raise InvalidArgumentError with a ``problem`` of a snapshot unless something ``holds``."""
    if not holds:
        raise InvalidArgumentError("snapshot", problem, remedy=remedy)
