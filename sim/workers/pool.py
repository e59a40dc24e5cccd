"""Pool of workers, each with a slice of the envs. A lost worker is replaced, and the new one replays its requests.

Every request that changes the loops is kept until the next checkpoint, a snapshot of all envs. A new worker gets the
last checkpoint and all later requests. At a checkpoint all workers rebuild their scenes
(:mod:`batchpid.sim.loop.snapshot`), so the replayed envs are bit-identical. Each worker has its own queue of requests,
so that one can catch up while the others continue.

An exception of a signal handler (Ctrl-C) can end a call at any moment. The state of the pool always shows the progress
of each worker, and a worker with a partly sent or received message is replaced, so that the call can be repeated.

Longer than 300 lines, to keep in one place everything that can happen to a worker during a request.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Any, Literal

import batchpid as bp
from batchpid.checks.single_owner import SingleOwner
from batchpid.errors import ClosedError
from batchpid.sim.loop.arrays import Arrays, Ticks
from batchpid.sim.loop.failure import Failure, order
from batchpid.sim.options import RunnerOptions
from batchpid.sim.processes.background import BACKGROUND
from batchpid.sim.workers.cluster import NODE_STEPS, Cluster
from batchpid.sim.workers.memory import check_memory
from batchpid.sim.workers.node import NodeInfo, Share
from batchpid.sim.workers.node_worker import NodeWorker
from batchpid.sim.workers.placement import pinned_cores, split_envs
from batchpid.sim.workers.requests import Request, Start
from batchpid.sim.workers.shared_memory import SharedArrays
from batchpid.sim.workers.worker import LocalWorker, ProcessWorker, Worker, WorkerLost

MAX_LOSSES = 5
"""Number of losses of one worker during the same request after which the pool gives up."""
_POLL_INTERVAL = 0.1  # seconds between two checks of workers that do not answer
_MAX_STEPS = 8000
"""Largest number of sim steps times envs of one request to a worker, except for one tick: a fifth of a second."""

_QUEUE, _RESULT, _FAILURE = map(attrgetter, ("queue", "result", "failure"))  # C functions, for the path of a tick


class RecoveryWarning(UserWarning):
    """A worker was lost and replaced."""


@dataclass
class _Slot:
    """Worker, its env slice and its pending requests."""

    start: Start
    worker: Worker
    queue: list[Request] = field(default_factory=list)
    phase: Literal["idle", "transfer", "waiting"] = "transfer"
    """Phase of the first request. An interrupt during a transfer leaves the worker unusable."""
    limit: float = field(init=False)
    """Seconds that the first request may take, known after the first check."""
    result: Any = None
    failure: Failure | None = None
    losses: int = 0
    cause: str = ""
    lost_at: float = field(init=False)
    descriptor: int | None = None
    """File descriptor of the worker's results."""
    poller: select.poll = field(init=False)
    """Poll object of ``descriptor``."""


class WorkerPool(SingleOwner):
    """Workers of a runner: processes, or with ``options.workers`` 0 the loop in this process.

    The loops start with ``params``, and the workers with :meth:`open`. With ``options.cluster`` the workers are nodes.
    Each node has its own pool, for a ``share`` of the envs.
    """

    def __init__(self, options: RunnerOptions, params: bp.PIDParams, share: Share | None = None) -> None:
        self._options, self._params = options, params
        self.messages: dict[type[Warning], str] = {}
        """Latest message of each category, for warnings."""
        self._first_env, num_envs, ticks = share or (0, options.num_envs, None)
        count = 1 if options.workers is None else options.workers
        self.is_local = not count
        """True if the loop runs in this process."""
        self._make_worker: Callable[[Start, SharedArrays], Worker] = ProcessWorker if count else LocalWorker
        self._slices = split_envs(num_envs, count)
        self._cores = pinned_cores(len(self._slices))
        widest, most_steps = max(envs.stop - envs.start for envs in self._slices), _MAX_STEPS
        if options.cluster is not None:  # the pools of its machines execute the requests
            cluster = Cluster(options, params, WorkerPool, self.messages)
            self._slices, self._make_worker, self._cores = cluster.slices, partial(NodeWorker, cluster), []
            widest, most_steps = cluster.widest, NODE_STEPS
        else:
            check_memory(options, num_envs, len(self._slices), self.is_local)
        self._replay: list[Request] = []
        self._slots: list[_Slot] = []
        self._request: Request | None = None
        self.closed = False
        """True if the running call must end, and no other may begin."""
        self.failure: Failure | None
        """First failure of a loop in the last request."""
        self.recoveries = 0
        """Number of lost workers that were replaced."""
        ticks = ticks or max(1, most_steps // (options.substeps * widest))
        layout = Arrays.layout(ticks, num_envs, options.robot.dof, options.command.size, options.observed)
        self._shared = BACKGROUND.call(lambda: SharedArrays(layout))
        self.arrays = Arrays.from_fields(self._shared.arrays)
        """Input and output of a request (ticks, envs, ...)."""
        self.ticks = Ticks(self.arrays)
        """Input and output of each tick."""
        self.present: Arrays
        """Tick with the present observation."""
        self.completed: list[Arrays]
        """Ticks that all envs completed in the last request with observations."""

    def open(self) -> None:
        """Start the workers and wait until all are ready."""
        for index, envs in enumerate(self._slices):
            start = Start(index, envs, self._options, self._params.for_envs(envs), self._first_env)
            self._slots.append(_Slot(start, self._make_worker(start, self._shared)))
            self._start(self._slots[-1])
        self._serve()
        if self.failure is not None:
            raise self.failure.error

    @property
    def workers(self) -> list[Worker]:
        """Workers in the order of their envs."""
        return [slot.worker for slot in self._slots]

    @property
    def nodes(self) -> tuple[NodeInfo, ...]:
        """Machines of a cluster, in the order of their envs."""
        infos = (worker.info for worker in self.workers if isinstance(worker, NodeWorker))
        return tuple(info for info in infos if info is not None)

    def begin(self, request: Request) -> None:
        """Send every worker its part of ``request``; :meth:`run` completes it.

        A loop in this process executes it at once. Raises WorkerError if a lost worker cannot be replaced.
        """
        self._serve(request, wait=False)

    def run(self, request: Request) -> list[Any]:
        """Execute ``request`` on all workers; return their results, unless there is a :attr:`failure`.

        If :meth:`begin` has sent the request, or an earlier call with it was interrupted, this call completes it.

        Raises
        ------
        WorkerError
            A lost worker cannot be replaced.
        ClosedError
            The pool was closed meanwhile.
        """
        self._serve(request)
        tick = request.observed_tick
        if self.failure is not None:
            self.completed = self.ticks.first(self.failure.ticks if request.counts_ticks else 0)
        else:
            if request.changes_loop and self._options.recover and not (self._replay and self._replay[-1] is request):
                self._replay.append(request)
            if tick is not None:
                self.completed = self.ticks.first(tick + 1)
                self.present = self.completed[tick]
        return list(map(_RESULT, self._slots))

    def start_replay_from(self, request: Request) -> None:
        """Drop the kept requests, because ``request`` brings a new worker to the present state."""
        if self._options.recover:
            self._replay = [request.copy()]

    def close(self) -> None:
        """End all workers, at once if they have a request. May be called again after an interrupt."""
        self.closed = True
        try:
            self._end_workers(patience=5.0)
        except BaseException:  # Ctrl-C
            self._end_workers(patience=0.0)
            raise

    def _end_workers(self, patience: float) -> None:
        for slot in list(self._slots):
            slot.worker.close(0.0 if slot.queue else patience)
        self._slots = []
        for name in ("arrays", "ticks", "present", "completed"):  # views that would keep the memory and its descriptor
            vars(self).pop(name, None)
        self._shared.close()

    def __del__(self) -> None:
        if hasattr(self, "_shared"):
            self.close()

    # -- one request, until every worker has executed it -----------------------------------------------------------

    def _serve(self, request: Request | None = None, wait: bool = True) -> None:
        """Queue ``request`` for every worker, unless that was done before, and serve the queues until all are empty.

        Without ``wait`` return when the first request of each queue is sent.
        """
        if request is not None and self._request is not request:
            for slot in self._slots:
                slot.queue, slot.failure = [request], None
            self._request = request  # last, so that an interrupted call can begin again: nothing is sent before
        self._next_check = time.monotonic() + _POLL_INTERVAL
        while not self.closed and (busy := list(filter(_QUEUE, self._slots))):
            for slot in busy:
                if slot.phase == "transfer":
                    self._replace(slot, None)
            try:
                for slot in busy:
                    if slot.phase == "idle":
                        self._send(slot)
                if not wait:
                    return
                for slot in self._wait(busy):
                    self._receive(slot)
            except WorkerLost as error:
                self._replace(slot, error)
            except Exception as error:
                if self.closed:
                    raise ClosedError("this Runner was closed during a call") from error
                raise  # a signal handler raised it
        if self.closed:
            raise ClosedError("this Runner was closed during a call")
        self.failure = min(filter(None, map(_FAILURE, self._slots)), key=order, default=None)

    def _send(self, slot: _Slot) -> None:
        slot.phase, slot.limit = "transfer", 0.0
        slot.worker.send(slot.queue[0])
        slot.phase = "waiting"

    def _receive(self, slot: _Slot) -> None:
        slot.phase = "transfer"
        slot.result = slot.worker.receive()
        if isinstance(slot.result, Failure):
            slot.failure, slot.result = slot.result, None
        slot.queue.pop(0)
        if not slot.queue and slot.losses:
            self.recoveries += 1
            if slot.cause:
                seconds = time.monotonic() - slot.lost_at
                self.messages[RecoveryWarning] = f"{slot.cause}; replaced and replayed in {seconds:.1f} s"
            slot.losses = 0
        slot.phase = "idle"

    def _wait(self, busy: list[_Slot]) -> list[_Slot]:
        """Wait until a worker has answered or died, or the pool is closed; return the slots of such workers.

        Workers without an answer are checked every 0.1 s. If one is lost, it is replaced, and the list may be empty.
        """
        if self.is_local:
            return busy
        answered = list[_Slot]()
        while not (answered or self.closed):
            left = 1e3 * _POLL_INTERVAL
            for slot in busy:
                if len(slot.queue) > 1:  # it is catching up: give it its next request at once
                    break
            else:
                # Wait for the workers in turn: waking up for the first would take the core of one that still runs.
                end = time.monotonic() + _POLL_INTERVAL
                for slot in busy:
                    if not slot.poller.poll(left):
                        break
                    left = 1e3 * max(0.0, end - time.monotonic())
                left = 0.0
            readable = dict(self._poller.poll(left))
            for slot in busy:
                if slot.descriptor in readable:
                    answered.append(slot)
            if time.monotonic() > self._next_check:
                self._next_check = time.monotonic() + _POLL_INTERVAL
                for slot in busy:
                    if slot.descriptor not in readable:
                        request, envs = slot.queue[0], slot.start.envs
                        slot.limit = slot.limit or self._options.timeout + request.limit(envs.stop - envs.start)
                        try:
                            slot.worker.check_alive(request.idle_limit, slot.limit)
                        except WorkerLost as error:
                            self._replace(slot, error)
                            return answered
        return answered

    # -- lost workers ----------------------------------------------------------------------------------------------

    def _replace(self, slot: _Slot, error: WorkerLost | None) -> None:
        """Replace a lost worker, or without ``error`` an interrupted one, and queue the requests to replay."""
        if self.closed:
            raise ClosedError("this Runner was closed during a call") from error
        if not self._options.recover:
            raise WorkerLost(
                f"{error or f'worker {slot.start.index} was interrupted'}; its envs are lost, because recovery is off: "
                "pass recover=True"
            ) from error
        if error is not None:
            slot.losses += 1
            if slot.losses >= MAX_LOSSES:
                raise WorkerLost(
                    f"{error}; lost {MAX_LOSSES} times during the same request: run these envs with workers=0 to see "
                    "why"
                ) from error
            if slot.losses == 1:
                slot.cause, slot.lost_at = str(error), time.monotonic()
        slot.phase = "transfer"
        slot.worker.close(0.0)
        slot.worker = slot.worker.successor()
        self._start(slot)

    def _start(self, slot: _Slot) -> None:
        """Start the worker of ``slot``, and queue the requests that bring it to the present state."""
        slot.worker.open()
        if self._cores:
            slot.worker.pin(self._cores[slot.start.index])
        slot.descriptor = slot.worker.fileno()
        slot.poller = _poller_of([slot])
        self._poller = _poller_of(self._slots)
        request, replay = self._request, self._replay
        again = [] if request is None or (replay and replay[-1] is request) else [request]
        slot.queue = [slot.start, *replay, *again]
        slot.failure, slot.limit = None, 0.0
        slot.phase = "waiting"


def _poller_of(slots: list[_Slot]) -> select.poll:
    """Return a poll object of the results of some workers."""
    poller = select.poll()
    for slot in slots:
        if slot.descriptor is not None:
            poller.register(slot.descriptor, select.POLLIN)
    return poller
