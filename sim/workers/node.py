"""Node of a cluster: a pool of workers on one machine, in a process that Ray starts there."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import batchpid as bp
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.failure import Failure, failure_of
from batchpid.sim.workers.requests import ReadDigest, Request, Start
from batchpid.sim.workers.worker import WorkerLost


class NodeInfo(NamedTuple):
    """Machine of a cluster, and the processes that run some of a runner's envs there."""

    address: str
    """Address of the machine."""
    envs: slice
    """Envs of the runner."""
    pid: int
    """Process that holds the pool of workers."""
    pids: tuple[int, ...]
    """Worker processes."""
    processor: str
    """Model of the processor."""
    digest: str
    """Digest of the canonical episode (:func:`batchpid.sim.workers.requests.canonical_digest`)."""


class Answer(NamedTuple):
    """Answer of a node to a request."""

    result: Any
    """Result of the request."""
    failure: Failure | None = None
    """Failure of the pool, in place of the result."""
    arrays: Arrays | None = None
    """Output (ticks, envs, ...) of the ticks that were completed, if the request changes the observation."""


class Node:
    """Pool of the envs of one machine. Ray makes it an actor, which is called by one thread at a time, and beats."""

    def __init__(self) -> None:
        self._pool: Any = None

    def start(self, message: bytes, workers: int, address: str) -> Answer:
        """Start the pool; return a :class:`NodeInfo`.

        ``message`` is pickled: the type of the pool, the :class:`Start` of its envs, the most ticks of a request, and
        the params of the canonical episode.
        """
        return _answer(lambda: Answer(self._start(pickle.loads(message), workers, address)))

    def _start(self, message: tuple[Any, Start, int, bp.PIDParams], workers: int, address: str) -> NodeInfo:
        pool_type, start, ticks, canonical = message
        # The caller replaces a node that has lost a worker: it keeps the requests to replay.
        options = start.options.with_values(workers=workers, cluster=None, recover=False)
        self._pool = pool_type(options, start.params, start.envs, ticks)
        self._pool.open()
        digest = self._run(ReadDigest(canonical)).result
        pids = tuple(worker.pid for worker in self._pool.workers)
        return NodeInfo(address, start.envs, os.getpid(), pids, _processor(), digest)

    def execute(self, request: Request) -> Answer:
        """Execute a request, which has the part of this node's envs."""
        return _answer(lambda: self._run(request))

    def beat(self) -> None:
        """Answer, also during a request."""

    def _run(self, request: Request) -> Answer:
        outcome = self._pool.run(request)
        if outcome.failure is not None:
            return Answer(None, outcome.failure.portable(), self._pool.arrays.at(slice(outcome.num_ticks)))
        arrays = self._pool.arrays.at(slice(outcome.num_ticks)) if outcome.num_ticks else None
        return Answer(request.join(outcome.results), None, arrays)


def _answer(act: Callable[[], Answer]) -> Answer:
    try:
        return act()
    except WorkerLost as error:  # without the advice to turn recovery on
        return Answer(None, Failure(0, 0, 0, WorkerLost(str(error.__cause__ or error))))
    except Exception as error:
        return Answer(None, failure_of(error).portable())


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
