"""The runner's workers: each has a slice of the envs; one that is lost is replaced and brought back by replay.

Every command that changes a worker is kept until the next checkpoint, a snapshot of all envs. A new worker is given the
last checkpoint and the commands since; since a checkpoint is a barrier for the workers that live, too (see
:mod:`sim.loop.snapshot`), it arrives at the same bytes. The commands of a worker stand in a queue, so that one worker
can catch up while the others go on, and an interrupted wait (Ctrl-C) can be taken up again.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from batchpid.errors import BatchPIDError, ClosedError, InUseError, WorkerError
from sim.loop.arrays import Arrays
from sim.loop.loop import LoopSpec
from sim.workers.requests import Request, Run, Start, Worker
from sim.workers.shared_memory import SharedArrays
from sim.workers.worker import LocalWorker, ProcessWorker, WorkerLost

_LOOK = 0.1  # seconds between two looks at workers that do not answer
_LIVES = 5  # times that a worker may be lost before it has finished the command in hand


class RecoveryWarning(UserWarning):
    """A worker was lost and brought back."""


@dataclass(eq=False)
class _Slot:
    """The place of one worker: its envs, what it has to do, and how far it is with the first of that."""

    spec: LoopSpec
    index: int
    envs: slice
    worker: Worker
    queue: deque[Request] = field(default_factory=deque)
    phase: str = "idle"  # "idle", "busy", or "torn": interrupted amid a message
    result: Any = None
    losses: int = 0
    cause: str = ""
    lost: float = 0.0


class WorkerPool:
    """Workers for ``num_envs`` envs: ``count`` processes, or with 0 the loop in this process.

    Parameters
    ----------
    spec
        For a slice of envs, the spec of their loop.
    ticks
        How many ticks one command may run.
    recover
        Whether lost workers are brought back. Otherwise the loss is raised, and the pool is closed.
    timeout
        Seconds, beside what a command should take at the very most, before a worker counts as stuck.
    """

    def __init__(
        self,
        spec: Callable[[slice], LoopSpec],
        num_envs: int,
        count: int,
        pack_size: int,
        *,
        ticks: int = 1,
        recover: bool,
        timeout: float,
    ) -> None:
        self._kind = ProcessWorker if count else LocalWorker
        self._recover, self._timeout = recover, timeout
        self._journal: list[Request] = []
        self._slots: list[_Slot] = []
        self._poller = select.poll()
        self._kept = True  # whether the command in hand is in the journal
        self._warning: str | None = None
        self._closing = False
        self._owner, self._user = os.getpid(), 0  # the process, and the thread amid a call
        self.recoveries = 0
        """How many lost workers were replaced."""
        dof = len(spec(slice(0, num_envs)).scene.joints)
        self._shared = SharedArrays(Arrays.layout(ticks, num_envs, dof))
        self.ticks = Arrays.of_ticks(self._shared.arrays, slice(0, num_envs))
        """What goes in and out, over all envs, for each tick of a command; each worker has its rows of it."""
        slices = _share(num_envs, count, pack_size)
        self._cores = cores_of_their_own(len(slices))
        try:
            for index, envs in enumerate(slices):
                slot = _Slot(spec(envs), index, envs, self._kind(spec(envs), index, self._shared))
                self._slots.append(slot)
                self._start_slot(slot)
            self._finish()
        except BaseException:
            self.close()
            raise

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called, or a worker was lost for good."""
        return self._closing or not self._slots

    @property
    def workers(self) -> list[Worker]:
        """The workers, in the order of their envs."""
        return [slot.worker for slot in self._slots]

    def run(self, command: Request, *, keep: bool = True) -> list[Any]:
        """Let every worker run ``command``; return their results.

        ``keep`` it for replay unless it changes nothing.

        Raises
        ------
        BatchPIDError
            What a loop raised on purpose; nothing was changed.
        WorkerError
            A loop raised something else, or a worker was lost for good; the pool is closed.
        InUseError
            It is amid another command, or belongs to another process.
        ClosedError
            It was closed meanwhile.
        """
        return self._exclusive(lambda: self._run(command, keep))

    def _run(self, command: Request, keep: bool) -> list[Any]:
        self._settle()
        for slot in self._slots:
            slot.queue.append(command)
        self._kept = keep
        if keep and self._recover:
            self._journal.append(command.kept() if isinstance(command, Run) else command)
        try:
            self._finish()
        except Exception as error:
            if _on_purpose(error) and keep and self._recover:
                self._journal.pop()
            if not _on_purpose(error):
                self.close()
            raise
        if self._warning is not None:
            message, self._warning = self._warning, None
            warnings.warn(message, RecoveryWarning, stacklevel=4)
        return [slot.result for slot in self._slots]

    def settle(self) -> None:
        """Finish what a wait that was interrupted left unfinished; raises as :meth:`run` does."""
        if self._user or os.getpid() != self._owner or any(slot.queue for slot in self._slots):
            self._exclusive(self._settle)

    def _settle(self) -> None:
        if any(slot.queue for slot in self._slots):
            try:
                self._finish()
            except Exception:
                self.close()
                raise

    def start_from(self, command: Request) -> None:
        """Forget the commands so far: ``command`` takes a new worker to where the workers are now."""
        if self._recover:
            self._journal = [command]

    def close(self) -> None:
        """End all workers; those amid a command at once, unless it is in this process: then after it."""
        self._closing = True
        if self._user and self._kind is LocalWorker:
            return  # its scenes cannot be freed under its feet
        slots, self._slots = self._slots, []
        for slot in slots:
            self._dismiss(slot, patience=0.0 if slot.queue else 5.0)
        self._shared.close()

    def _exclusive(self, act: Callable[[], Any]) -> Any:
        """Return ``act()``, unless the pool is at work for someone else."""
        me, mine = threading.get_ident(), False
        try:
            if os.getpid() != self._owner:
                raise InUseError(
                    f"this Runner belongs to process {self._owner}, from which this one was forked; use it there, or "
                    "make one here"
                )
            if self._user:
                raise InUseError(
                    "this Runner is amid a call that this one interrupted; let a signal handler set a flag, or close it"
                    if self._user == me
                    else "this Runner is amid a call from another thread; take turns, or make one for each thread"
                )
            # No call from the look to here, so that neither a thread nor a signal gets in between.
            self._user, mine = me, True
            return act()
        finally:
            if mine:
                self._user = 0
                if self._closing:
                    self.close()

    # -- one command, until every worker has done it ---------------------------------------------------------------

    def _finish(self) -> None:
        """Serve the queues until all are empty; only then raise what the loops raised."""
        errors: list[Exception] = []
        look = time.monotonic() + _LOOK
        while busy := [slot for slot in self._slots if slot.queue]:
            for slot in busy:
                if slot.phase == "torn":
                    self._lose(slot, WorkerLost(""))  # by Ctrl-C: nothing to warn of
                if slot.phase == "idle":
                    self._attempt(slot, self._send, errors)
            answered = self._answered(busy)
            for slot in answered:
                self._attempt(slot, self._receive, errors)
            if time.monotonic() > look:
                for slot in busy:
                    if slot.phase == "busy" and slot not in answered:
                        self._attempt(slot, self._look, errors)
                look = time.monotonic() + _LOOK
        if self.closed:
            raise ClosedError("this Runner was closed amid a call")
        if errors:
            raise next((error for error in errors if not _on_purpose(error)), errors[0])

    def _attempt(self, slot: _Slot, act: Callable[[_Slot], None], errors: list[Exception]) -> None:
        try:
            act(slot)
        except WorkerLost as error:
            self._lose(slot, error)
        except Exception as error:
            slot.phase = "idle"
            slot.queue.popleft()
            errors.append(error)

    def _send(self, slot: _Slot) -> None:
        slot.phase = "torn"
        slot.queue[0].send(slot.worker, slot.envs)
        slot.phase = "busy"

    def _receive(self, slot: _Slot) -> None:
        slot.phase = "torn"
        slot.result = slot.worker.receive()
        slot.phase = "idle"
        slot.queue.popleft()
        if not slot.queue and slot.losses:
            self.recoveries += 1
            if slot.cause:
                self._warning = f"{slot.cause}; brought back in {time.monotonic() - slot.lost:.1f} s by replay"
            slot.losses = 0

    def _look(self, slot: _Slot) -> None:
        command, envs = slot.queue[0], slot.envs.stop - slot.envs.start
        assert isinstance(slot.worker, ProcessWorker)
        slot.worker.check_alive(command.idle_limit, self._timeout + command.limit(envs))

    def _answered(self, busy: list[_Slot]) -> list[_Slot]:
        """Wait a little; return those of the busy slots whose worker has answered, or died."""
        waiting = [slot for slot in busy if slot.phase == "busy"]
        if self._kind is LocalWorker:
            return waiting
        readable = {descriptor for descriptor, _ in self._poller.poll(1e3 * _LOOK)}
        return [slot for slot in waiting if slot.worker.fileno() in readable]  # type: ignore[union-attr]

    # -- lost workers ----------------------------------------------------------------------------------------------

    def _lose(self, slot: _Slot, error: WorkerLost) -> None:
        """Put a new worker in the place of one that is lost, with all it has to do to catch up."""
        if self.closed:
            raise ClosedError("this Runner was closed amid a call") from error
        if not self._recover:
            raise WorkerLost(
                f"{str(error) or f'worker {slot.index} was interrupted'}; its envs are lost, because recovery is off: "
                "pass recover=True"
            ) from error
        slot.losses += 1
        if slot.losses >= _LIVES:
            raise WorkerLost(
                f"{error}; lost {_LIVES} times amid the same command, so that a further try is no use: run these "
                "envs with workers=0 to see why"
            ) from error
        if slot.losses == 1:
            slot.cause, slot.lost = str(error), time.monotonic()
        current = slot.queue[-1]
        self._dismiss(slot, patience=0.0)
        slot.worker = self._kind(slot.spec, slot.index, self._shared)
        self._start_slot(slot)
        if not isinstance(current, Start):
            slot.queue.extend(self._journal)
            if not self._kept:
                slot.queue.append(current)

    def _start_slot(self, slot: _Slot) -> None:
        slot.phase = "idle"
        slot.queue.clear()
        if isinstance(slot.worker, ProcessWorker):
            self._poller.register(slot.worker.fileno(), select.POLLIN)
            if self._cores:
                slot.worker.keep_to(self._cores[slot.index])
            slot.queue.append(Start())

    def _dismiss(self, slot: _Slot, patience: float) -> None:
        if isinstance(slot.worker, ProcessWorker):
            with contextlib.suppress(KeyError, ValueError):  # closed already, when there could be no other after it
                self._poller.unregister(slot.worker.fileno())
        slot.worker.close(patience)


def _on_purpose(error: Exception) -> bool:
    """Whether a loop raised this on purpose, before it changed anything."""
    return isinstance(error, BatchPIDError) and not isinstance(error, WorkerError)


def packing(num_envs: int, pack_size: int) -> int:
    """Scenes to a PhysX system: ``pack_size``, or less where that leaves fewer than 8 packs for the workers to share.

    It does not ask for the number of workers, and packs are never cut in two, so that results could not depend on that
    number even where :mod:`sim.engine.contact_prediction` foresees too little.
    """
    return min(pack_size, max(1, num_envs // 8))


def cores_of_their_own(workers: int) -> list[int]:
    """One core for each worker, where there are as many workers as cores; else none.

    A kernel may wake two workers on the core of the parent that woke them, and leave the other core idle for
    milliseconds. Fewer workers than cores are not tied, lest those of several programs end up on the same cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    return cores if workers == len(cores) else []


def _share(num_envs: int, workers: int, pack_size: int) -> list[slice]:
    """Contiguous slices of envs, one for each worker, cut between packs."""
    packs = -(-num_envs // pack_size)
    count = max(1, min(workers, packs))
    cuts = [min(num_envs, pack_size * (packs * k // count)) for k in range(count + 1)]
    return [slice(low, high) for low, high in pairwise(cuts)]
