"""Node of a cluster: a pool of workers in a process that Ray starts on a machine, and the caller's end of it."""

from __future__ import annotations

import io
import os
import pickle
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple, Self

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import standard_streams_occupied
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.failure import Failure, failure_of
from batchpid.sim.processes.background import BACKGROUND, Job
from batchpid.sim.workers.cluster import Cluster, NodeInfo
from batchpid.sim.workers.exchange import SharedArrays
from batchpid.sim.workers.requests import ReadDigest, Request, Run, Start
from batchpid.sim.workers.worker import Worker, WorkerLost, pickled

START_LIMIT, SILENCE_LIMIT = 60.0, 20.0
"""Seconds after which a node is lost that has not started, or whose process does not answer a call to nothing."""
_BEAT_INTERVAL = 1.0  # seconds between two such calls


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


class NodeWorker(Worker):
    """Caller's end of a node. Ray is called in the background thread, where no signal interrupts it."""

    def __init__(self, cluster: Cluster, start: Start, shared: SharedArrays, message: bytes | None = None) -> None:
        self._cluster, self._index, self._envs = cluster, start.index, start.envs
        self._start, self._shared = start, shared
        self._arrays = Arrays.from_fields(shared.arrays)
        ticks = len(self._arrays.observation.ok)
        whole = cluster.pool_type, start, ticks, cluster.canonical
        self._message = pickled(whole, start.options) if message is None else message
        self._bell = _Bell()
        self._actor: Any = None
        self._call: Future[Answer] | None = None
        self._beat: Future[None] | None = None
        self._sent_at = self._heard_at = 0.0
        self._is_replacement = self._has_beaten = False
        self._ticks = 0  # of the current run
        self.info: NodeInfo | None = None
        """Known when the node has started."""

    def open(self) -> None:
        self._machine, reserved = self._cluster.place(self._index)
        self._is_replacement = not reserved
        BACKGROUND.call(lambda: self._open(reserved))

    def _open(self, reserved: int) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        machine, options = self._machine, self._cluster.options
        actor_type = self._cluster.ray.remote(Node).options(
            num_cpus=reserved,
            max_concurrency=2,  # one for the beats
            scheduling_strategy=NodeAffinitySchedulingStrategy(machine.node_id, soft=False),
            runtime_env=options.runtime_env,
        )
        self._actor = actor_type.remote()
        self._begin(self._actor.start.remote(self._message, machine.workers, machine.address))

    def fileno(self) -> int:
        return self._bell.fileno()

    def send(self, request: Request) -> None:
        self._ticks = request.ticks if isinstance(request, Run) else 0
        part = request.for_envs(self._envs)
        BACKGROUND.call(lambda: self._begin(self._actor.execute.remote(part)))

    def _begin(self, reference: Any) -> None:
        self._sent_at = self._heard_at = time.monotonic()
        self._beat, self._call, bell = None, reference.future(), self._bell
        self._call.add_done_callback(lambda _: bell.ring())

    def receive(self) -> Any:
        assert self._call is not None
        self._bell.read(8)
        seconds = time.monotonic() - self._sent_at
        try:
            answer = self._call.result()
        except self._cluster.ray.exceptions.RayError as error:
            raise self._lost(_cause(error)) from error
        result, failure, arrays = answer
        self._call = None
        if failure is not None and isinstance(failure.error, WorkerLost):
            raise self._lost(f"lost a worker: {failure.error}")
        if arrays is not None:
            tick = len(arrays.observation.ok)
            for ours, theirs in zip(self._arrays[1:], arrays[1:], strict=True):
                tables: Any = zip(ours, theirs, strict=True)
                for table, rows in tables:
                    if table is not None:
                        table[:tick, self._envs] = rows
        if failure is not None:
            return failure.of_worker(self._name)
        if self.info is None:
            return self._join(result)
        if self._ticks and self._index == 0:
            self._cluster.note_time(seconds, result)
        return result

    def _join(self, info: NodeInfo) -> None:
        try:
            self._cluster.admit(info, self._machine)
        except InvalidArgumentError as error:
            if self._is_replacement:
                raise self._lost(str(error)) from error  # another machine may do
            raise
        self.info = info

    def check_alive(self, idle_limit: float, limit: float) -> None:
        now = time.monotonic()
        if self._beat is not None and self._beat.done() and self._beat.exception() is None:
            self._beat, self._heard_at, self._has_beaten = None, now, True
        silence = now - self._heard_at
        if self._beat is None and silence > _BEAT_INTERVAL:
            self._beat = BACKGROUND.call(lambda: self._actor.beat.remote().future())
        if silence > (SILENCE_LIMIT if self._has_beaten else START_LIMIT):
            asleep = f"has not answered for {silence:.0f} s"
            raise self._lost(asleep if self._has_beaten else "has not started; are its CPUs taken?")
        if now - self._sent_at > limit:
            raise self._lost(f"is stuck: no answer within {limit:.0f} s; raise timeout= if that was too short")

    def close(self, patience: float) -> None:
        if not sys.is_finalizing():
            BACKGROUND.put(Job(self._kill))  # after the call that opened it, which may have been interrupted

    def successor(self) -> Self:
        return type(self)(self._cluster, self._start, self._shared, self._message)

    def _kill(self) -> None:
        actor, self._actor = self._actor, None
        if actor is not None and self._cluster.ray.is_initialized():
            self._cluster.ray.kill(actor)

    @property
    def _name(self) -> str:
        return f"node {self._index} ({self._machine.address}, envs {self._envs.start} to {self._envs.stop - 1})"

    def _lost(self, cause: str) -> WorkerLost:
        if self.info is None:
            self._cluster.note_failure(self._machine)
        return WorkerLost(f"{self._name} {cause}")


class _Bell(io.FileIO):
    """Event descriptor, readable after :meth:`ring`; closed with its last reference."""

    def __init__(self) -> None:
        with standard_streams_occupied():
            super().__init__(os.eventfd(0, os.EFD_CLOEXEC), "r+")

    def ring(self) -> None:
        """Make the descriptor readable; called by a thread of Ray."""
        os.eventfd_write(self.fileno(), 1)

    def __del__(self) -> None:
        self.close()  # without the ResourceWarning of its base


def _cause(error: Exception) -> str:
    """Return what Ray says about a lost actor, in one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    telling = ("The actor died because", "ModuleNotFoundError", "ImportError")
    known = [line for line in lines if line.startswith(telling)]
    return f"died ({type(error).__name__}: {(known or lines or [''])[0]})"
