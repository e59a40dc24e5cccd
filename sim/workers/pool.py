"""Pool of workers, each with a slice of the envs. A lost worker is replaced, and its envs are replayed.

Every request that changes the loops is kept until the next checkpoint, a snapshot of all envs. A new worker gets the
last checkpoint and the requests since. A checkpoint is a barrier for the other workers too (:mod:`sim.loop.snapshot`),
so that the replayed envs are bit-identical. Each worker has a queue of requests: one can catch up while the others
continue, and an interrupted wait (Ctrl-C) can be resumed.
"""

from __future__ import annotations

import os
import select
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import batchpid as bp
from batchpid.errors import BatchPIDError, ClosedError, InUseError, WorkerError
from sim.loop.arrays import Arrays
from sim.options import RunnerOptions
from sim.workers.placement import pinned_cores, split_envs
from sim.workers.requests import Request, Start
from sim.workers.shared_memory import SharedArrays
from sim.workers.worker import LocalWorker, ProcessWorker, Worker, WorkerLost

MAX_LOSSES = 5
"""Losses of one worker during the same request after which the pool gives up."""
_POLL_INTERVAL = 0.1  # seconds between two checks of workers that do not answer
_MAX_STEPS = 8000
"""Sim steps times envs of one request to a worker, at most, unless a tick has more: a fifth of a second."""


class RecoveryWarning(UserWarning):
    """A worker was lost and replaced."""


@dataclass(eq=False)
class _Slot:
    """Worker, its env slice and its pending requests."""

    start: Start
    worker: Worker
    queue: deque[Request] = field(default_factory=deque)
    phase: Literal["idle", "transfer", "waiting"] = "waiting"
    """Phase of the first request. An interrupt during the transfer of a message leaves the worker unusable."""
    result: Any = None
    losses: int = 0
    cause: str = ""
    lost_at: float = 0.0


class WorkerPool:
    """Workers of a runner: processes, or with ``options.workers`` 0 the loop in this process.

    ``params`` are those that the loops start with.
    """

    def __init__(self, options: RunnerOptions, params: bp.PIDParams) -> None:
        self._options = options
        count = len(os.sched_getaffinity(0)) if options.workers is None else options.workers
        self._is_local, self._make_worker = not count, ProcessWorker if count else LocalWorker
        slices = split_envs(options.num_envs, count, options.scenes_per_system)
        self._cores = pinned_cores(len(slices))
        self._replay: list[Request] = []
        self._slots: list[_Slot] = []
        self._poller = select.poll()
        self._request: Request | None = None
        self._warning: str | None = None
        self._closing = False
        self._owner, self._user = os.getpid(), 0  # the process, and the thread in a call
        self.recoveries = 0
        """Number of lost workers that were replaced."""
        ticks = max(1, _MAX_STEPS // (options.substeps * max(envs.stop - envs.start for envs in slices)))
        self._shared = SharedArrays(Arrays.layout(ticks, options.num_envs, options.robot.dof))
        self.arrays = Arrays.from_fields(self._shared.arrays)
        """Input and output of a request (ticks, envs, ...)."""
        self.ticks = [self.arrays.at(tick) for tick in range(ticks)]
        """Input and output of each tick."""
        self.present = self.ticks[0]
        """The tick that holds the present observation."""
        try:
            for index, envs in enumerate(slices):
                start = Start(index, envs, options, params.for_envs(envs))
                self._slots.append(_Slot(start, self._make_worker(start, self._shared)))
                self._await_start(self._slots[-1])
            self._finish()
        except BaseException:
            self.close()
            raise

    @property
    def closed(self) -> bool:
        """True after :meth:`close`, or after a worker was lost for good."""
        return self._closing or not self._slots

    @property
    def workers(self) -> list[Worker]:
        """Workers in the order of their envs."""
        return [slot.worker for slot in self._slots]

    def run(self, request: Request) -> list[Any]:
        """Let every worker execute its part of ``request``; return their results.

        Raises
        ------
        BatchPIDError
            Raised by a loop before it changed anything.
        WorkerError
            A loop raised another error, or a worker was lost for good; the pool is closed.
        InUseError
            Another call is in progress, or the pool belongs to another process.
        ClosedError
            The pool was closed meanwhile.
        """
        return self._exclusive(lambda: self._run(request))

    def _run(self, request: Request) -> list[Any]:
        self._settle()
        self._request = request
        for slot in self._slots:
            slot.queue.append(request)
        replayed = request.is_replayed and self._options.recover
        if replayed:
            self._replay.append(request.copy())
        try:
            self._finish()
        except Exception as error:
            if not _left_unchanged(error):
                self.close()
            elif replayed:
                self._replay.pop()
            raise
        if self._warning is not None:
            message, self._warning = self._warning, None
            warnings.warn(message, RecoveryWarning, stacklevel=4)
        return [slot.result for slot in self._slots]

    def settle(self) -> None:
        """Finish a request whose wait was interrupted; raises as :meth:`run` does."""
        if self._user or os.getpid() != self._owner or any(slot.queue for slot in self._slots):
            self._exclusive(self._settle)

    def _settle(self) -> None:
        if any(slot.queue for slot in self._slots):
            try:
                self._finish()
            except Exception:
                self.close()
                raise

    def start_replay_from(self, request: Request) -> None:
        """Drop the requests kept so far: ``request`` brings a new worker to the present state."""
        if self._options.recover:
            self._replay = [request.copy()]

    def close(self) -> None:
        """End all workers: processes at once if they have a request, a loop in this process after the running call."""
        self._closing = True
        if self._user and self._is_local:
            return  # its scenes are still in use by the running call
        slots, self._slots = self._slots, []
        for slot in slots:
            slot.worker.close(0.0 if slot.queue else 5.0)
        self._shared.close()

    def _exclusive(self, call: Callable[[], Any]) -> Any:
        """Return ``call()``; raise InUseError if another call is in progress."""
        me, mine = threading.get_ident(), False
        try:
            if os.getpid() != self._owner:
                raise InUseError(
                    f"this Runner belongs to process {self._owner}, from which this one was forked; use it there, or "
                    "make one here"
                )
            if self._user:
                raise InUseError(
                    "this Runner is in a call that this one interrupted; let a signal handler set a flag, or close it"
                    if self._user == me
                    else "this Runner is in a call from another thread; take turns, or make one for each thread"
                )
            # There is no call between the check and here, so that neither a thread nor a signal can come in between.
            self._user, mine = me, True
            return call()
        finally:
            if mine:
                self._user = 0
                if self._closing:
                    self.close()

    # -- one request, until every worker has executed it -----------------------------------------------------------

    def _finish(self) -> None:
        """Serve the queues until all are empty; raise what the loops raised only then."""
        errors: list[Exception] = []
        next_check = time.monotonic() + _POLL_INTERVAL
        while busy := [slot for slot in self._slots if slot.queue]:
            for slot in busy:
                if slot.phase == "transfer":
                    self._replace(slot, WorkerLost(""))  # Ctrl-C: nothing to warn of
                if slot.phase == "idle":
                    self._attempt(slot, self._send, errors)
            answered = self._wait(busy)
            for slot in answered:
                self._attempt(slot, self._receive, errors)
            if time.monotonic() > next_check:
                for slot in busy:
                    if slot.phase == "waiting" and slot not in answered:
                        self._attempt(slot, self._check_alive, errors)
                next_check = time.monotonic() + _POLL_INTERVAL
        if self.closed:
            raise ClosedError("this Runner was closed during a call")
        if errors:
            raise next((error for error in errors if not _left_unchanged(error)), errors[0])
        tick = None if self._request is None else self._request.observed_tick
        if tick is not None:
            self.present = self.ticks[tick]

    def _attempt(self, slot: _Slot, act: Callable[[_Slot], None], errors: list[Exception]) -> None:
        try:
            act(slot)
        except WorkerLost as error:
            self._replace(slot, error)
        except Exception as error:
            slot.phase = "idle"
            slot.queue.popleft()
            errors.append(error)

    def _send(self, slot: _Slot) -> None:
        slot.phase = "transfer"
        slot.worker.send(slot.queue[0].for_envs(slot.start.envs))
        slot.phase = "waiting"

    def _receive(self, slot: _Slot) -> None:
        slot.phase = "transfer"
        slot.result = slot.worker.receive()
        slot.phase = "idle"
        slot.queue.popleft()
        if not slot.queue and slot.losses:
            self.recoveries += 1
            if slot.cause:
                self._warning = f"{slot.cause}; replaced and replayed in {time.monotonic() - slot.lost_at:.1f} s"
            slot.losses = 0

    def _check_alive(self, slot: _Slot) -> None:
        request, envs = slot.queue[0], slot.start.envs
        slot.worker.check_alive(request.idle_limit, self._options.timeout + request.limit(envs.stop - envs.start))

    def _wait(self, busy: list[_Slot]) -> list[_Slot]:
        """Wait briefly; return the busy slots whose worker has answered or died."""
        waiting = [slot for slot in busy if slot.phase == "waiting"]
        if self._is_local:
            return waiting
        readable = {descriptor for descriptor, _ in self._poller.poll(1e3 * _POLL_INTERVAL)}
        return [slot for slot in waiting if slot.worker.fileno() in readable]

    # -- lost workers ----------------------------------------------------------------------------------------------

    def _replace(self, slot: _Slot, error: WorkerLost) -> None:
        """Replace a lost worker, and queue the requests to replay."""
        if self.closed:
            raise ClosedError("this Runner was closed during a call") from error
        if not self._options.recover:
            raise WorkerLost(
                f"{str(error) or f'worker {slot.start.index} was interrupted'}; its envs are lost, because recovery is "
                "off: pass recover=True"
            ) from error
        slot.losses += 1
        if slot.losses >= MAX_LOSSES:
            raise WorkerLost(
                f"{error}; lost {MAX_LOSSES} times during the same request: run these envs with workers=0 to see why"
            ) from error
        if slot.losses == 1:
            slot.cause, slot.lost_at = str(error), time.monotonic()
        slot.worker.close(0.0)
        slot.worker = self._make_worker(slot.start, self._shared)
        self._await_start(slot)
        slot.queue.extend(self._replay)
        if self._request is not None and not self._request.is_replayed:
            slot.queue.append(self._request)

    def _await_start(self, slot: _Slot) -> None:
        """Wait for the loop of a new worker first."""
        slot.phase, slot.queue = "waiting", deque([slot.start])
        if self._cores:
            slot.worker.pin(self._cores[slot.start.index])
        self._poller = select.poll()
        for descriptor in (worker.fileno() for worker in self.workers):
            if descriptor is not None:
                self._poller.register(descriptor, select.POLLIN)


def _left_unchanged(error: Exception) -> bool:
    """Return True if a loop raised this before it changed anything."""
    return isinstance(error, BatchPIDError) and not isinstance(error, WorkerError)
