"""Workers as the pool sees them: a loop in this process, or the parent's end of a worker process.

A worker process is a fork of a fresh Python (:mod:`batchpid.sim.processes.fork_server`), not of the caller, and does
not import the caller's ``__main__``: it works from notebooks and from scripts without a main guard. It shares with the
caller one socket and one block of memory, both by file descriptor. When the worker dies, the caller sees the socket
close; when the caller dies, the kernel kills the worker.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from dataclasses import fields
from pathlib import Path
from typing import Any, Self

import cloudpickle

from batchpid.checks.single_owner import SingleOwner
from batchpid.errors import InvalidArgumentError, WorkerError
from batchpid.io.files import read_bytes, standard_streams_occupied
from batchpid.sim.engine import native
from batchpid.sim.engine.protocol import MODULES
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.failure import Failure, failure_of
from batchpid.sim.loop.loop import Loop
from batchpid.sim.options import RunnerOptions
from batchpid.sim.processes.background import BACKGROUND
from batchpid.sim.processes.fork_server import Child, fork
from batchpid.sim.workers.exchange import Channel, MemoryFile, SharedArrays
from batchpid.sim.workers.requests import Request, Start
from batchpid.sim.workers.serve import ANSWER, ANSWER_TAG

_TRANSFER_LIMITS = (10.0, 60.0)
"""Seconds asleep, and at work, while the rest of a message is on its way: a new process imports a lot first."""
_STOP_LIMIT = 0.7  # seconds: Ctrl-Z and fg stop and continue parent and workers together
_STATE, _CPU = 0, slice(11, 13)  # fields of /proc/PID/stat after the name: the state, user and system time
_RUNNABLE, _IDLE, _STOPPED = "R", "ST", "T"  # S: asleep; others: D waits for the disk, t is held by a debugger
_CLOCK = os.sysconf("SC_CLK_TCK")


class WorkerLost(WorkerError):
    """A worker died or is stuck; the message names it, its envs and the cause."""


class Worker(SingleOwner, ABC):
    """Loop of some envs: :meth:`send` a request, then :meth:`receive` its result.

    The first result, None, comes without a request, when the loop is built.
    """

    pid: int | None = None
    """Process id; None: this process."""

    @abstractmethod
    def open(self) -> None:
        """Start the process, or build the loop here. After an interrupt the worker can only be closed."""

    @abstractmethod
    def send(self, request: Request) -> None:
        """Start the part of a request for the envs of this worker, whose rows are in the arrays."""

    @abstractmethod
    def receive(self) -> Any:
        """Wait for the result of the last request and return it; a Failure if the loop raised.

        Raises
        ------
        WorkerLost
            The worker died.
        """

    @abstractmethod
    def close(self, patience: float) -> None:
        """Free the scenes, and end the process; one that has not ended after ``patience`` seconds is killed.

        May be called again, after an interrupt too.
        """

    @abstractmethod
    def successor(self) -> Self:
        """Return a replacement of this worker, which is not open yet and reuses the pickled start message."""

    def fileno(self) -> int | None:
        """Return the file descriptor that becomes readable with the result; None: it is there when ``send`` returns."""
        return None

    def check_alive(self, idle_limit: float, limit: float) -> None:
        """Check a worker that has not answered yet.

        Raises
        ------
        WorkerLost
            It is stopped, or asleep for ``idle_limit`` seconds, or at work on one request for ``limit`` seconds, not
            counting the time for which it waited for a core.
        """

    def pin(self, core: int) -> None:
        """Run on one core only."""


class LocalWorker(Worker):
    """Loop in this process."""

    def __init__(self, start: Start, shared: SharedArrays) -> None:
        self._start, self._shared, self._arrays = start, shared, Arrays.from_fields(shared.arrays)
        self._loop: Loop | None = None
        self._result: Any = None

    def open(self) -> None:
        self._loop = self._start.build(self._arrays)

    def send(self, request: Request) -> None:
        assert self._loop is not None
        try:
            self._result = request.apply(self._loop)
        except Exception as error:
            self._result = failure_of(error)

    def receive(self) -> Any:
        return self._result

    def close(self, patience: float) -> None:
        if self._loop is not None:
            self._loop.close()

    def successor(self) -> Self:
        return type(self)(self._start, self._shared)


class ProcessWorker(Worker):
    """Parent's end of a worker process."""

    pid: int | None = None

    def __init__(self, start: Start, shared: SharedArrays, message: bytes | None = None) -> None:
        self._start, self._shared = start, shared
        self._message = pickled((start, shared.layout), start.options) if message is None else message
        self._name = f"worker {start.index} (envs {start.numbers.start} to {start.numbers.stop - 1})"
        self._owner, self._memory = os.getpid(), shared.fd
        self._envs = start.envs
        self._is_unchecked = False  # since the last request was sent
        self._is_opening = False
        self._process: Child | None = None

    def open(self) -> None:
        self._is_opening = True
        try:
            BACKGROUND.call(self._open)
        except OSError as error:
            raise WorkerError(
                f"{self._name} cannot be started: {error}; pass a smaller workers=, 0 for none"
            ) from error
        self._is_opening = False
        with contextlib.suppress(OSError):  # it died: the first receive reports that
            self._channel.send(self._message)

    def _open(self) -> None:
        with contextlib.ExitStack() as undo:
            self._trace = undo.enter_context(MemoryFile("batchpid-trace"))
            with standard_streams_occupied():
                ours, theirs = socket.socketpair()
            undo.enter_context(ours)
            with theirs:
                process = fork(
                    "batchpid.sim.workers.serve:main",
                    (theirs.fileno(), self._memory, self._trace.fileno()),
                    imports=("batchpid.sim.workers.serve", MODULES[self._start.options.engine]),
                    environment={native.SWITCH: "0"} if native.obstacle() else None,  # one warning for all
                )
            undo.pop_all()
        self._name = self._name.replace("(", f"(pid {process.pid}, ")
        self._liveness = Liveness(Path(f"/proc/{process.pid}/stat"))
        self._connection = ours
        self._channel = Channel(ours, lambda: self.check_alive(*_TRANSFER_LIMITS))
        self._process, self.pid = process, process.pid

    def fileno(self) -> int:
        return self._channel.fileno()

    def send(self, request: Request) -> None:
        self._is_unchecked = True
        try:
            self._channel.send(request.encode(self._envs))
        except OSError as error:
            raise self._death() from error

    def receive(self) -> Any:
        try:
            try:
                answer = self._connection.recv(ANSWER.size)
            except BlockingIOError:
                answer = b""
            if len(answer) == ANSWER.size and answer[ANSWER_TAG] == b"D":  # nearly always
                return ANSWER.unpack(answer)[2]
            result = pickle.loads(self._channel.receive(answer))
        except (EOFError, OSError) as error:
            raise self._death() from error
        return result.of_worker(self._name) if isinstance(result, Failure) else result

    def check_alive(self, idle_limit: float, limit: float) -> None:
        liveness = self._liveness
        liveness.sample(time.monotonic(), self._is_unchecked)
        self._is_unchecked = False
        if liveness.idle > (_STOP_LIMIT if liveness.stopped else idle_limit):
            state = "stopped" if liveness.stopped else "asleep"
            raise self._lost(f"is stuck: {state} for {liveness.idle:.1f} s during a request")
        if liveness.busy > limit:
            raise self._lost(f"is stuck: no answer within {limit:.0f} s; raise timeout= if that was too short")

    def close(self, patience: float) -> None:
        if self._is_opening and not sys.is_finalizing():  # a second Ctrl-C ended the call that opened it
            BACKGROUND.call(lambda: None)
        if self._process is None:
            return
        self._channel.close()
        if os.getpid() == self._owner:  # a fork of the parent must not end the parent's workers
            try:
                self._process.wait(patience) if patience else self._process.kill()
            except subprocess.TimeoutExpired:
                self._process.kill()
            self._process.wait()
        self._trace.close()

    def successor(self) -> Self:
        return type(self)(self._start, self._shared, self._message)

    def pin(self, core: int) -> None:
        with contextlib.suppress(OSError):  # it died, or the core was taken away
            os.sched_setaffinity(self.pid or 0, {core})

    def _death(self) -> WorkerLost:
        assert self._process is not None
        try:
            code = self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            return self._lost("closed its connection")
        return self._lost(f"died ({_signal_name(-code)})" if code < 0 else f"died (exit code {code})")

    def _lost(self, cause: str) -> WorkerLost:
        assert self._process is not None
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGUSR1)  # it writes its stack, unless it is stopped
            time.sleep(0.05)
        text = os.pread(self._trace.fileno(), 4000, 0).decode(errors="replace")
        trace = text.partition("\nExtension modules:")[0].strip()  # a long list, of no use here
        return WorkerLost(f"{self._name} {cause}" + (f"; its last stack:\n{trace}\n" if trace else ""))


class Liveness:
    """Idle and busy time of one process while it has a request, from samples of its ``stat`` file in /proc.

    A process that waits for a core on a crowded machine is neither idle nor busy. A gap between two samples counts as
    ``max_gap`` seconds at most: the sampling process may have been stopped as well.
    """

    def __init__(self, stat: Path, max_gap: float = 0.2) -> None:
        self._stat, self._max_gap = str(stat), max_gap
        self.idle = 0.0
        """Seconds for which it has been asleep or stopped in every sample, without processor time between them."""
        self.busy = 0.0
        """Seconds since the first sample, without those in which it waited for a core."""
        self.stopped = False
        """Stopped, as by SIGSTOP."""
        self._last: tuple[float, float] | None = None

    def sample(self, now: float, is_first: bool = False) -> None:
        """Update the times at time ``now`` [s]; the first sample of a request resets them."""
        if is_first:
            self.idle, self.busy, self._last = 0.0, 0.0, None
        try:
            fields = read_bytes(self._stat).rpartition(b")")[2].decode().split()
        except OSError:
            return  # it has ended; its socket reports that
        state, cpu = fields[_STATE], sum(map(int, fields[_CPU])) / _CLOCK
        self.stopped = state == _STOPPED
        if self._last is not None:
            passed, ran = min(now - self._last[0], self._max_gap), cpu - self._last[1]
            self.idle = self.idle + passed if state in _IDLE and not ran else 0.0
            self.busy += ran if state == _RUNNABLE else max(ran, passed)
        self._last = now, cpu


def pickled(message: Any, options: RunnerOptions) -> bytes:
    """Return the start message of a worker as bytes, with functions and classes that the worker cannot import.

    Raises
    ------
    InvalidArgumentError
        One of ``options`` cannot be pickled.
    """
    try:
        return cloudpickle.dumps(message)
    except Exception as error:
        raise InvalidArgumentError(
            next((each.name for each in fields(options) if _refuses(getattr(options, each.name))), "options"),
            f"cannot be sent to a worker process: {error}",
            remedy="let it hold nothing that cannot be pickled, or pass workers=0",
        ) from error


def _refuses(value: Any) -> bool:
    try:
        cloudpickle.dumps(value)
    except Exception:
        return True
    return False


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
