"""Requests to workers (:mod:`batchpid.sim.runner.operations`), the start of a loop, and the division
of envs among workers.
"""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import batchpid as bp
from batchpid.arrays.array_types import Bool
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.loop import Loop
from batchpid.sim.options.options import RunnerOptions


class Request(ABC):
    """Base of all requests, which are frozen dataclasses for all envs of a pool."""

    changes_loop = True
    """True if the replacement of a lost worker repeats the request, and an error in it closes the
    pool.
    """
    ticks = 0
    """Ticks of the arrays that hold observations afterwards; 0: the observation does not change."""
    substeps = 10
    """Sim steps of each tick, or the number of sim steps that take as long as the request."""
    patience = 0.0
    """Further time that the request may take [s]."""
    counts_ticks = False
    """True if the ticks that every env completed before an error are kept."""

    @property
    def placed(self) -> Bool | None:
        """Envs that the request resets (envs,)."""
        return None

    def for_envs(self, envs: slice) -> Self:
        """Return the request for some envs: fields are arrays (envs, ...), None, or have this
        method.
        """

        def part(value: Any) -> Any:
            if value is None:
                return None
            if hasattr(value, "for_envs"):
                return value.for_envs(envs)
            return value[envs]

        return type(self)(*map(part, vars(self).values()))

    def write(self, arrays: Arrays, envs: slice) -> None:  # noqa: B027
        """Write the rows of some envs to the shared arrays (ticks, envs, ...)."""

    def encode(self, envs: slice) -> bytes:
        """Return the message for a worker, pickled: the part of its envs."""
        return pickle.dumps(self.for_envs(envs))

    @abstractmethod
    def apply(self, loop: Loop) -> object:
        """Execute it and return its result."""

    def join(self, results: list[Any]) -> Any:
        """Return the result for all envs from the results of their parts."""
        return None


@dataclass(frozen=True)
class Start:
    """Inputs from which a worker builds its loop."""

    index: int
    """Number of the worker."""
    envs: slice
    """Rows in the arrays of the pool."""
    options: RunnerOptions
    params: bp.PIDParams
    """Params of these envs."""
    first_env: int = 0
    """Number of the pool's first env within the runner; each node of a cluster has a pool for some
    of the envs.
    """

    def build(self, arrays: Arrays) -> Loop:
        """Return the loop, with the shared arrays (ticks, envs, ...) of the pool's envs."""
        envs = slice(self.first_env + self.envs.start, self.first_env + self.envs.stop)
        return Loop(self.options, self.params, envs, arrays.at((slice(None), self.envs)))


@dataclass(frozen=True)
class Build(Request):
    """Build the loop; each worker has the :class:`Start` of its loop."""

    # Every replay begins with its own.
    changes_loop = False
    patience = 60.0
    """Mostly for imports, from a disk that may be slow."""

    def apply(self, loop: Loop) -> None:
        pass


def split(num_envs: int, parts: int) -> list[slice]:
    """Return contiguous slices of envs, as equal as they can be."""
    cuts = [num_envs * part // parts for part in range(parts + 1)]
    return [slice(low, high) for low, high in pairwise(cuts)]
