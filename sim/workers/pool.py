"""Pool of workers, each with a slice of the envs. A lost worker is replaced, and the new one replays its requests.

Every request that changes the loops is kept until the next checkpoint, a snapshot of all envs. A new worker gets the
last checkpoint and all later requests. At a checkpoint all workers rebuild their scenes
(:mod:`batchpid.sim.loop.snapshot`), so the replayed envs are bit-identical. Each worker has its own queue of requests,
so that one can catch up while the others continue.

A request that has begun must be completed. An exception other than WorkerLost, such as one from a signal handler,
leaves the pool in an invalid state, and its owner must close it.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import batchpid as bp
from batchpid.checks.single_owner import SingleOwner
from batchpid.errors import ClosedError
from batchpid.sim.loop.arrays import Arrays, Ticks
from batchpid.sim.loop.failure import Failure, order
from batchpid.sim.options import RunnerOptions
from batchpid.sim.workers.cluster import NODE_STEPS, Cluster, NodeInfo
from batchpid.sim.workers.exchange import SharedArrays
from batchpid.sim.workers.node import NodeWorker
from batchpid.sim.workers.placement import check_memory, pinned_cores, split_envs
from batchpid.sim.workers.requests import Request, Start
from batchpid.sim.workers.worker import LocalWorker, ProcessWorker, Worker, WorkerLost

MAX_LOSSES = 5
"""Number of losses of one worker during the same request after which the pool gives up."""
_POLL_INTERVAL = 0.1  # seconds between two checks of workers that do not answer
_MAX_STEPS = 8000
"""Largest number of sim steps times envs of one request to a worker, except for one tick: a fifth of a second."""

_CLOSED = "this Runner was closed during a call"
_ALL = slice(None)
_QUEUE, _RESULT, _FAILURE = map(attrgetter, ("queue", "result", "failure"))  # C functions, for the path of a tick


class RecoveryWarning(UserWarning):
    """A worker was lost and replaced."""


class Outcome(NamedTuple):
    """Outcome of a request in all workers."""

    results: list[Any]
    """Result of each worker; None of one that failed."""
    failure: Failure | None
    """First failure of a loop."""
    num_ticks: int
    """Ticks with observations that all envs completed."""
    ticks: Ticks
    """Input and output of the ticks."""

    @property
    def completed(self) -> list[Arrays]:
        """Ticks that all envs completed."""
        return self.ticks.first(self.num_ticks)

    @property
    def present(self) -> Arrays:
        """The last of them."""
        return self.ticks[self.num_ticks - 1]


@dataclass
class _Slot:
    """Worker, its env slice and its pending requests, of which it has been sent the first."""

    start: Start
    worker: Worker
    queue: list[Request] = field(default_factory=list)
    limit: float = 0.0
    """Seconds that the first request may take; 0 until the first check."""
    result: Any = None
    failure: Failure | None = None
    losses: int = 0
    cause: str = ""
    lost_at: float = 0.0
    descriptor: int | None = None
    """File descriptor of the worker's results."""
    poller: select.poll = field(init=False)
    """Poll object of ``descriptor``."""


class WorkerPool(SingleOwner):
    """Workers of a runner: processes, or with ``options.workers`` 0 the loop in this process.

    The loops start with ``params``, and the workers with :meth:`open`. With ``options.cluster`` the workers are nodes.
    Each node has its own pool, of the ``envs`` (default: all) and with requests of ``ticks`` at most.
    """

    def __init__(
        self, options: RunnerOptions, params: bp.PIDParams, envs: slice | None = None, ticks: int | None = None
    ) -> None:
        self._options, self._params = options, params
        self.messages: dict[type[Warning], str] = {}
        """Latest message of each category, for warnings."""
        envs = slice(0, options.num_envs) if envs is None else envs
        self._first_env, num_envs = envs.start, envs.stop - envs.start
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
        self.recoveries = 0
        """Number of lost workers that were replaced."""
        ticks = ticks or max(1, most_steps // (options.substeps * widest))
        layout = Arrays.layout(ticks, num_envs, options.robot.dof, options.command.size, options.observed)
        self._shared = SharedArrays(layout)
        self.arrays = Arrays.from_fields(self._shared.arrays)
        """Input and output of a request (ticks, envs, ...)."""
        self.ticks = Ticks(self.arrays)
        """Input and output of each tick."""
        self.present = self.ticks[0]
        """Tick with the present observation."""

    def open(self) -> None:
        """Start the workers and wait until all are ready."""
        for index, envs in enumerate(self._slices):
            start = Start(index, envs, self._options, self._params.for_envs(envs), self._first_env)
            self._slots.append(_Slot(start, self._make_worker(start, self._shared)))
            self._start(self._slots[-1])
        failure = self.finish().failure
        if failure is not None:
            raise failure.error

    @property
    def workers(self) -> list[Worker]:
        """Workers in the order of their envs."""
        return [slot.worker for slot in self._slots]

    @property
    def nodes(self) -> tuple[NodeInfo, ...]:
        """Machines of a cluster, in the order of their envs."""
        infos = (worker.info for worker in self.workers if isinstance(worker, NodeWorker))
        return tuple(info for info in infos if info is not None)

    def run(self, request: Request) -> Outcome:
        """Execute ``request`` on all workers.

        Raises
        ------
        WorkerError
            A lost worker cannot be replaced.
        ClosedError
            The pool was closed meanwhile.
        """
        self.begin(request)
        return self.finish()

    def begin(self, request: Request) -> None:
        """Send every worker its part of ``request``; :meth:`finish` waits for the end. Raises as :meth:`run`.

        A loop in this process executes it at once.
        """
        if self.closed:
            raise ClosedError(_CLOSED)
        self._request = request
        for slot in self._slots:
            slot.queue, slot.failure, slot.limit = [request], None, 0.0
        request.write(self.arrays, _ALL)
        for slot in self._slots:
            try:
                slot.worker.send(request)
            except WorkerLost as error:
                self._replace(slot, error)

    def finish(self) -> Outcome:
        """Wait until every worker has executed its queue, and return the outcome. Raises as :meth:`run`."""
        self._next_check = time.monotonic() + _POLL_INTERVAL
        while not self.closed and (busy := list(filter(_QUEUE, self._slots))):
            try:
                for slot in self._wait(busy):
                    slot.result = slot.worker.receive()
                    del slot.queue[0]
                    if slot.queue or slot.losses or isinstance(slot.result, Failure):
                        self._go_on(slot)
            except WorkerLost as error:
                self._replace(slot, error)
            except Exception as error:
                if self.closed:
                    raise ClosedError(_CLOSED) from error
                raise  # a signal handler raised it
        if self.closed:
            raise ClosedError(_CLOSED)
        request, slots, count = self._request, self._slots, 0
        failure = min(filter(None, map(_FAILURE, slots)), key=order, default=None)
        if request is not None and failure is None:
            count = request.ticks
            if request.changes_loop and self._options.recover:
                self._replay.append(request)
        elif request is not None and failure is not None and request.counts_ticks:
            count = failure.ticks
        if count:
            made = self.ticks.made
            self.present = made[count - 1] if count <= len(made) else self.ticks[count - 1]
        self._request = None
        return Outcome(list(map(_RESULT, slots)), failure, count, self.ticks)

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
        for name in ("arrays", "ticks", "present"):  # views that would keep the memory and its descriptor
            vars(self).pop(name, None)
        self._shared.close()

    def __del__(self) -> None:
        if hasattr(self, "_shared"):
            self.close()

    # -- one request, until every worker has executed it -----------------------------------------------------------

    def _go_on(self, slot: _Slot) -> None:
        """Note the end of a request that failed, or of a replay; send the next request of the worker's queue."""
        if isinstance(slot.result, Failure):
            slot.failure, slot.result = slot.result, None
        if slot.queue:
            slot.limit = 0.0
            slot.queue[0].write(self.arrays, slot.start.envs)
            slot.worker.send(slot.queue[0])
        elif slot.losses:
            self.recoveries += 1
            seconds = time.monotonic() - slot.lost_at
            self.messages[RecoveryWarning] = f"{slot.cause}; replaced and replayed in {seconds:.1f} s"
            slot.losses = 0

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

    def _replace(self, slot: _Slot, error: WorkerLost) -> None:
        """Replace a lost worker, and queue the requests to replay."""
        if self.closed:
            raise ClosedError(_CLOSED) from error
        if not self._options.recover:
            problem = "its envs are lost, because recovery is off: pass recover=True"
            raise WorkerLost(f"{error}; {problem}") from error
        slot.losses += 1
        if slot.losses >= MAX_LOSSES:
            remedy = "run these envs with workers=0 to see why"
            raise WorkerLost(f"{error}; lost {MAX_LOSSES} times during the same request: {remedy}") from error
        if slot.losses == 1:
            slot.cause, slot.lost_at = str(error), time.monotonic()
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
        slot.queue = [slot.start, *self._replay]
        if self._request is not None:
            slot.queue.append(self._request)
        slot.failure, slot.limit = None, 0.0


def _poller_of(slots: list[_Slot]) -> select.poll:
    """Return a poll object of the results of some workers."""
    poller = select.poll()
    for slot in slots:
        if slot.descriptor is not None:
            poller.register(slot.descriptor, select.POLLIN)
    return poller
