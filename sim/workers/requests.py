"""Requests to workers. Each is for all envs of a pool, and makes the part for the envs of one worker."""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from copy import deepcopy
from dataclasses import dataclass, field, replace
from itertools import repeat
from operator import is_not, itemgetter
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Rows
from batchpid.sim.loop.arrays import Arrays, Command
from batchpid.sim.loop.loop import Loop
from batchpid.sim.loop.snapshot import EnvStates, Snapshot
from batchpid.sim.options import RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws


class Request(ABC):
    """Base of all requests, which are frozen dataclasses."""

    changes_loop = True
    """True if the replacement of a lost worker repeats the request, and an error in it closes the pool."""
    ticks = 0
    """Ticks of the arrays that hold observations afterwards; 0: the observation does not change."""
    substeps = 10
    """Sim steps of each tick, or those that take about as long as the request."""
    patience = 0.0
    """Further time that the request may take [s]."""
    counts_ticks = False
    """True if the ticks that every env completed before an error are kept."""

    def for_envs(self, envs: slice) -> Self:
        """Return the part of some envs, of fields that are arrays (envs, ...) or have such a method."""

        def part(value: Any) -> Any:
            if value is None:
                return None
            return value.for_envs(envs) if hasattr(value, "for_envs") else value[envs]

        return type(self)(*map(part, vars(self).values()))

    def copy(self) -> Self:
        """Return a copy that later writes to the caller's arrays do not change."""
        return deepcopy(self)

    def write(self, arrays: Arrays, envs: slice) -> None:  # noqa: B027  (most requests travel in the message)
        """Write the rows of some envs to the shared arrays (ticks, envs, ...)."""

    def encode(self, envs: slice) -> bytes:
        """Return the message for a worker, pickled: the part of its envs."""
        return pickle.dumps(self.for_envs(envs))

    @abstractmethod
    def apply(self, loop: Loop) -> Any:
        """Execute it and return its result."""

    def join(self, results: list[Any]) -> Any:
        """Return the result for all envs from the results of their parts."""
        return None


@dataclass(frozen=True)
class Start:
    """All that the loop of one worker is built from."""

    index: int
    """Of the worker."""
    envs: slice
    """Rows in the arrays of the pool."""
    options: RunnerOptions
    params: bp.PIDParams
    """Of these envs."""
    first_env: int = 0
    """Number of the pool's first env within the runner; each node of a cluster has a pool for some of the envs."""

    def build(self, arrays: Arrays) -> Loop:
        """Return the loop, with the shared arrays (ticks, envs, ...) of the pool's envs."""
        envs = slice(self.first_env + self.envs.start, self.first_env + self.envs.stop)
        return Loop(self.options, self.params, envs, arrays.at((slice(None), self.envs)))


@dataclass(frozen=True)
class Build(Request):
    """Build the loop; each worker has the :class:`Start` of its loop."""

    patience = 60.0  # mostly imports, from a disk that may be slow

    def apply(self, loop: Loop) -> None:
        pass


@dataclass(frozen=True)
class Reset(Request):
    """Place the envs of ``mask`` (envs,) at ``qpos``, ``qvel`` (envs, dof), floating bases at ``base`` (envs, 13)."""

    mask: NDArray[np.bool_]
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]
    draws: Draws = NOTHING
    base: NDArray[np.float64] | None = None
    ticks = 1

    def apply(self, loop: Loop) -> None:
        loop.reset(self.mask, self.qpos, self.qvel, self.draws, self.base)


@dataclass(frozen=True)
class Run(Request):
    """Run ``ticks`` of ``substeps`` sim steps under ``command`` (ticks, envs, dof), which travels in the arrays."""

    ticks: int = field()
    substeps: int = field()
    command: Command = Command(None)  # noqa: RUF009  (immutable)
    counts_ticks = True

    def for_envs(self, envs: slice) -> Self:
        return replace(self, command=self.command.map(itemgetter((slice(None), envs))))

    def write(self, arrays: Arrays, envs: slice) -> None:
        for table, rows in zip(arrays.command, self.command, strict=True):
            if rows is not None:
                table[: self.ticks, envs] = rows[:, envs]

    def encode(self, envs: slice) -> bytes:
        given = tuple(map(is_not, self.command, repeat(None)))  # Command.given, without one more call in a tick
        return pickle.dumps((self.ticks, self.substeps, given))

    def apply(self, loop: Loop) -> float:
        return loop.run(self.ticks, self.substeps, self.command.given)

    def join(self, results: list[float]) -> float:
        return max(results)


@dataclass(frozen=True)
class SetParams(Request):
    """Change gains, limits and times in flight."""

    params: bp.PIDParams

    def apply(self, loop: Loop) -> None:
        loop.set_params(self.params)


@dataclass(frozen=True)
class SetActuators(Request):
    """Change the actuators in flight; None removes them."""

    actuators: bp.Actuators | None

    def for_envs(self, envs: slice) -> Self:
        return type(self)(None if self.actuators is None else self.actuators.for_envs(envs))

    def apply(self, loop: Loop) -> None:
        loop.set_actuators(self.actuators)


@dataclass(frozen=True)
class TakeSnapshot(Request):
    """Read the state of every env, and go on as if restored from it."""

    def apply(self, loop: Loop) -> EnvStates:
        return loop.snapshot()

    def join(self, results: list[EnvStates]) -> EnvStates:
        return EnvStates.join(results)


@dataclass(frozen=True)
class Restore(Request):
    """Put every env into its state in ``snapshot``, with its params and ``draws``."""

    snapshot: Snapshot
    draws: Draws = NOTHING
    ticks = 1

    def apply(self, loop: Loop) -> None:
        loop.restore(self.snapshot, self.draws)


@dataclass(frozen=True)
class ReadStateSizes(Request):
    """Read the number of values in the engine's state of each env."""

    changes_loop = False

    def apply(self, loop: Loop) -> list[int]:
        return loop.state_sizes()

    def join(self, results: list[list[int]]) -> list[int]:
        return [size for sizes in results for size in sizes]


@dataclass(frozen=True)
class ReadPoses(Request):
    """Read the poses of the entities that ``build`` returned, or of the bodies ``names`` of a file."""

    names: tuple[str, ...] | None = None
    changes_loop = False

    def for_envs(self, envs: slice) -> Self:
        return self

    def apply(self, loop: Loop) -> list[Rows]:
        return loop.poses(self.names)

    def join(self, results: list[list[Rows]]) -> list[Rows]:
        return [rows for poses in results for rows in poses]
