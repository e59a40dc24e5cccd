"""Caller's end of a node of a cluster."""

from __future__ import annotations

import io
import os
import sys
import time
from concurrent.futures import Future
from typing import Any, Self

from batchpid.errors import InvalidArgumentError
from batchpid.io.files import standard_streams_occupied
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.processes.background import BACKGROUND, Job
from batchpid.sim.workers.cluster import Cluster
from batchpid.sim.workers.exchange import SharedArrays
from batchpid.sim.workers.node import Answer, Node, NodeInfo
from batchpid.sim.workers.requests import Request, Run, Start
from batchpid.sim.workers.worker import Worker, WorkerLost, pickled

START_LIMIT, SILENCE_LIMIT = 60.0, 20.0
"""Seconds after which a node is lost that has not started, or whose process does not answer a call to nothing."""
_BEAT_INTERVAL = 1.0  # seconds between two such calls


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
