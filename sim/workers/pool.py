"""Pool of workers, each with a slice of the envs. A lost worker is replaced, and the new one
replays its requests.

Every request that changes the loops is kept until the next checkpoint, a snapshot of all envs. A
new worker gets the last checkpoint and all later requests, so the replayed envs are bit-identical.

A request that has begun must be completed. An exception other than WorkerLost, such as one from a
signal handler, leaves the pool in an invalid state, and its owner must close it.
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Bool
from batchpid.errors import ClosedError, SingleOwner
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.loop import Failure, first, joined
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.workers.node import NODE_STEPS, Cluster, NodeWorker
from batchpid.sim.workers.requests import BUILD, Request, SharedArrays, Start, split
from batchpid.sim.workers.worker import (
    LocalWorker,
    ProcessWorker,
    Worker,
    WorkerLost,
    pinned_cores,
)

MAX_LOSSES = 5
"""Number of losses of one worker during the same request after which the pool gives up."""
MOST_BYTES = 1 << 28
"""Memory for commands that are kept for a replay [B]."""
_MAX_STEPS = 8000
"""Sim steps times envs of one request to a worker: a fifth of a second."""
_LEAST_STEPS = 64
"""Sim steps of one request with more envs: at each request the scenes of all envs pass through the
cache.
"""
_CLOSED = "this Runner was closed during a call"


class RecoveryWarning(UserWarning):
    """A worker was lost and replaced."""


class Outcome(NamedTuple):
    """Outcome of a request in all workers."""

    request: Request
    result: Any
    """Result for all envs; None after a failure."""
    failure: Failure | None
    """First failure of a loop."""
    arrays: Arrays
    """Input and output of all ticks."""


class Replay:
    """Requests from which the replacement of a lost worker reaches the present state, bit by bit:
    those that changed the loops since a checkpoint; the first ones restore it.

    Parameters
    ----------
    most_ticks
        Ticks that are kept. With more since the last checkpoint a lost worker cannot be replaced.
    """

    def __init__(self, most_ticks: int) -> None:
        self._most_ticks = most_ticks
        self._waiting: Bool = np.zeros(0, bool)
        self.start_from(None)

    def start_from(self, request: Request | None) -> None:
        """Forget all requests; ``request`` brings a new worker to the present state, in which it is
        by itself with None.
        """
        self.requests: list[Request] = [BUILD]
        """The requests, in their order; none if there were too many."""
        if request is not None:
            self.requests.append(request)
        self._ticks = 0
        self._next: list[Request] = []

    def start_at_resets(self, request: Request, num_envs: int) -> None:
        """Start from ``request``, which restores the present state, once every env was reset.

        Until then the earlier requests stay: an engine may have state that ``request`` does not
        restore, and that a reset clears.
        """
        self._next = [request]
        self._waiting = np.ones(num_envs, bool)

    @property
    def waits(self) -> bool:
        """True while envs have to be reset before the last checkpoint is of use."""
        return bool(self._next)

    def append(self, request: Request) -> None:
        """Add a request that all loops have executed."""
        self._ticks += max(1, request.ticks)
        if self.requests:
            self.requests.append(request)
        if self._next:
            self._next.append(request)
            if request.method == "reset":
                self._waiting = self._waiting & ~request.arguments[0]
            if not self._waiting.any():
                self.requests = [BUILD, *self._next]
                self._ticks = sum(max(1, request.ticks) for request in self._next)
                self._next = []
        if self._ticks > self._most_ticks:
            self.requests = []
            self._next = []


class WorkerPool(SingleOwner):
    """Workers of a runner: processes, or with ``options.workers`` 0 the loop in this process.

    The workers start with :meth:`open`. With ``options.cluster`` they are nodes, each of which has
    a pool for some ``envs`` (default: all), whose requests have ``ticks`` at most.
    """

    def __init__(
        self,
        options: RunnerOptions,
        envs: slice | None = None,
        ticks: int | None = None,
    ) -> None:
        envs = slice(0, options.num_envs) if envs is None else envs
        num_envs = envs.stop - envs.start
        count = options.workers
        self.is_local = count == 0
        """True if the loop runs in this process."""
        self.closed = False
        """True if the running call must end, and no other may begin."""
        self.max_losses = MAX_LOSSES
        self.recoveries = 0
        """Number of lost workers that were replaced."""
        self.warnings: list[str] = []
        """Messages about replaced workers, for warnings."""
        if options.cluster is not None:
            cluster = Cluster(num_envs)
            slices = cluster.slices
            loops = min(num_envs, len(slices) * cluster.workers)
            most_steps = NODE_STEPS
        else:
            slices = split(num_envs, max(1, min(count or 0, num_envs)))
            loops = len(slices)
            most_steps = _MAX_STEPS
        steps = max(_LEAST_STEPS, most_steps * loops // num_envs)
        ticks = ticks or max(1, steps // options.substeps)
        self._shared = SharedArrays(Arrays.layout(options, ticks, num_envs))
        self.arrays = self._shared.arrays
        """Input and output of a request (ticks, envs, ...)."""
        # Views are made once.
        self._at = cache(self.arrays.at)
        self.present = self._at(0)
        """Tick with the present observation."""
        row = 3 * options.command.size + options.robot.dof
        self.replay = Replay(MOST_BYTES // (row * num_envs * np.dtype(float).itemsize))
        """Requests for the replacement of a lost worker."""
        self.workers: list[Worker] = []
        """Workers in the order of their envs."""
        cores = pinned_cores(len(slices))
        for index, part in enumerate(slices):
            start = Start(index, part, options, envs.start)
            if options.cluster is not None:
                self.workers.append(NodeWorker(start, self._shared, cluster, WorkerPool))
            elif self.is_local:
                self.workers.append(LocalWorker(start, self._shared))
            else:
                self.workers.append(
                    ProcessWorker(start, self._shared, cores[index] if cores else None)
                )

    def open(self) -> None:
        """Start the workers and wait until all are ready."""
        for worker in self.workers:
            worker.open()
        failure = self.run(BUILD).failure
        if failure is not None:
            raise failure.error

    def run(self, request: Request) -> Outcome:
        """Execute ``request`` on all workers.

        Raises
        ------
        WorkerError
            A lost worker cannot be replaced.
        ClosedError
            The pool was closed meanwhile.
        """
        if self.closed:
            raise ClosedError(_CLOSED)
        results = []
        try:
            request.write(self.arrays, slice(None))
            for worker in self.workers:
                worker.send(request)
            # One worker after another: to wake up for the first would take the core of one that
            # still runs.
            for worker in self.workers:
                try:
                    results.append(worker.receive())
                except WorkerLost as error:
                    results.append(self._replace(worker, request, error))
        except Exception as error:
            self._raise_if_closed(error)
            raise
        if self.closed:
            raise ClosedError(_CLOSED)
        failures = [result for result in results if isinstance(result, Failure)]
        if failures:
            return Outcome(request, None, first(failures), self.arrays)
        if request.changes_loop:
            self.replay.append(request)
        if request.ticks:
            self.present = self._at(request.ticks - 1)
        return Outcome(request, joined(request.method, results), None, self.arrays)

    def close(self) -> None:
        """End all workers at once. May be called again, as after an interrupt."""
        self.closed = True
        for worker in self.workers:
            worker.close()
        self.workers = []
        # Views would keep the memory and its descriptor.
        for name in ("arrays", "_at", "present"):
            vars(self).pop(name, None)
        self._shared.close()

    def _raise_if_closed(self, error: Exception) -> None:
        if self.closed:
            raise ClosedError(_CLOSED) from error

    def _replace(self, worker: Worker, request: Request, loss: WorkerLost) -> Any:
        """Replace a lost worker; return the result of the new one for ``request``."""
        if not self.replay.requests:
            problem = "its commands since the last checkpoint are too many to be replayed"
            remedy = "reset all envs, or take a runner.snapshot(), now and then"
            raise WorkerLost(f"{loss}; {problem}: {remedy}") from loss
        cause = str(loss)
        began = time.monotonic()
        for _ in range(1, self.max_losses):
            self._raise_if_closed(loss)
            try:
                worker.close()
                worker.open()
                for replayed in (*self.replay.requests, request):
                    replayed.write(self.arrays, worker.envs)
                    worker.send(replayed)
                    result = worker.receive()
                    if isinstance(result, Failure):  # of a ``build`` that works no more
                        return result
            except WorkerLost as error:
                loss = error
                continue
            self.recoveries += 1
            seconds = time.monotonic() - began
            self.warnings.append(f"{cause}; replaced and replayed in {seconds:.1f} s")
            return result
        remedy = "run these envs with workers=0 to see why"
        raise WorkerLost(
            f"{loss}; lost {self.max_losses} times during the same request: {remedy}"
        ) from loss
