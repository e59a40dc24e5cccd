"""The closed loop over some packs of scenes: read, compensate, control, write, step.

The same code runs in a worker process and in the caller's. A group of envs runs all its substeps
before the next group, so that its working set stays in the cache; nothing depends on how envs are
grouped.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from itertools import chain
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from batchpid.errors import BatchPIDError, ControllerError, WorkerError
from batchpid.sim.loop.array_executors import ROWS
from batchpid.sim.loop.arrays import Arrays, join_rows
from batchpid.sim.loop.env_group import EnvGroup
from batchpid.sim.loop.env_parts import OwnController
from batchpid.sim.loop.group_control import native_obstacle
from batchpid.sim.loop.native_executor import NativeExecutor, run_ticks
from batchpid.sim.options.options import RunnerOptions


class Failure(NamedTuple):
    """Error of a loop during a request. The state of the loop after it is undefined.

    It does not depend on how envs are divided among workers: of several failures, the
    :func:`first` is reported.
    """

    step: int
    """Sim step since the start of the runner; the first one of the tick if it is not known."""
    env: int
    """First env of the group that failed."""
    error: Exception

    def portable(self, worker: str) -> Failure:
        """Return the failure with an error class of this project, which another process can raise,
        and the traceback. ``worker`` names its process.
        """
        error = self.error
        text = "".join(traceback.format_exception(error))
        if isinstance(error, ControllerError):
            error.add_note(text)
        elif not isinstance(error, BatchPIDError):
            error = WorkerError(f"{worker} raised:\n{text}")
        return self._replace(error=error)


def failed(error: Exception) -> Failure:
    """Return the failure of a request that has no sim steps."""
    return Failure(0, 0, error)


def first(failures: list[Failure]) -> Failure:
    """Return the failure at the earliest sim step, in the lowest env."""
    return min(failures, key=itemgetter(0, 1))


JOINED: dict[str, Callable[[list[Any]], Any]] = {
    "read": join_rows,
    "snapshot": join_rows,
    "poses": lambda results: [*chain.from_iterable(results)],
}
"""Functions of the results for parts of the envs, by the method of a request; others have no
result.
"""


def joined(method: str, results: list[Any]) -> Any:
    """Return the result of a request for all envs, from those for parts of them."""
    return JOINED[method](results) if method in JOINED else None


def part_of(arguments: tuple[Any, ...], envs: slice) -> tuple[Any, ...]:
    """Return the part of the arguments of a request for some envs: arrays (envs, ...) and objects
    with ``for_envs`` are divided, others are the same for all envs.
    """
    parts = []
    for value in arguments:
        if isinstance(value, np.ndarray):
            value = value[envs]
        elif hasattr(value, "for_envs"):
            value = value.for_envs(envs)
        parts.append(value)
    return tuple(parts)


class Loop:
    """Closed loop of some envs of a runner, with their scenes.

    Parameters
    ----------
    options
        Options of the runner.
    envs
        Rows of the runner's envs.
    arrays
        Input and output (ticks, envs, ...) of these envs, for the ticks of a :meth:`run`. Other
        requests write to the first tick.
    """

    def __init__(self, options: RunnerOptions, envs: slice, arrays: Arrays) -> None:
        self.arrays = arrays
        self._options = options
        self._given: tuple[bool, ...] = ()
        workspace: dict[object, object] = {}
        controller = None if isinstance(options.control, str) else OwnController(options)
        size = group_size(options)
        self.groups = list[EnvGroup]()
        # Each group has its own scenes; nothing else in the loop depends on the grouping.
        for start in range(envs.start, envs.stop, size):
            group = slice(start, min(start + size, envs.stop))
            rows = slice(group.start - envs.start, group.stop - envs.start)
            part = arrays.at((slice(None), rows))
            self.groups.append(EnvGroup(options, group, rows, controller, part, workspace))
        # Packs that share working memory cannot run in one native call.
        self._batches = [[group] for group in self.groups] if workspace else [self.groups]

    def execute(self, method: str, arguments: tuple[Any, ...]) -> Any:
        """Return the result of a request: of :meth:`run`, or of the method of each group for its
        part of the arguments; a Failure if it raised an error.
        """
        try:
            if method == "run":
                return self.run(*arguments)
            results = [
                getattr(group, method)(*part_of(arguments, group.rows)) for group in self.groups
            ]
            return joined(method, results)
        except Exception as error:
            return failed(error)

    def run(self, ticks: int, substeps: int, given: tuple[bool, ...]) -> Failure | None:
        """Run ``ticks`` of ``substeps`` sim steps under the commands in their arrays; return a
        Failure if a group failed. The other groups complete the run, so that the first failure does
        not depend on grouping.

        ``given`` says which arrays of the commands are given
        (:attr:`batchpid.stages.values.Command.given`); the others are set to 0.
        """
        if given != self._given:
            self._given = given
            # The caller writes only what is given, so zeros stay until that changes.
            for table, is_given in zip(self.arrays.command, given, strict=True):
                if not is_given:
                    table[...] = 0
        failures = list[Failure]()
        for groups in self._batches:
            executors = list[NativeExecutor]()
            for group in groups:
                executors += group.start(given[1])
            # First whole ticks of all groups in one native call, then the rest of each group.
            run_ticks(executors, ticks, substeps)
            for group in groups:
                try:
                    group.finish(ticks, substeps)
                except Exception as error:  # of a controller, or of the engine
                    failures.append(self._failure(error, group, substeps))
        return first(failures) if failures else None

    def _failure(self, error: Exception, group: EnvGroup, substeps: int) -> Failure:
        """Return the failure of a group in a run of ticks of ``substeps``."""
        steps = group.steps + group.tick * substeps
        step = steps + 1
        if isinstance(error, ControllerError):
            step = steps + error.step
            error = error.at(step, self._options.timestep)
        return Failure(step, group.pack.first_env, error)

    def close(self) -> None:
        """Free the scenes."""
        for group in self.groups:
            group.pack.close()
        self.groups = []


def group_size(options: RunnerOptions) -> int:
    """Return the number of envs of a group, which changes no result."""
    engine = options.load_engine()
    obstacle = engine.native_obstacle() or native_obstacle(options)
    # Calls of NumPy and JAX have an overhead, which more envs share.
    if obstacle or options.backend != "numpy":
        return max(engine.group_size, ROWS)
    return engine.group_size
