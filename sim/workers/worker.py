"""Workers: a loop in this process, and both ends of a worker process.

A worker process is a fresh Python, which does not import the caller's ``__main__``: it works from
notebooks and from scripts without a main guard. It shares with the caller a socket and a block of
memory, both by file descriptor, and a pipe. When the worker dies, the caller sees the socket close;
when the caller dies, the pipe closes, and the kernel kills the worker. Ctrl-C reaches the caller
alone, since a worker is in another session.
"""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import gc
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any
from weakref import WeakSet

import cloudpickle

from batchpid.errors import InvalidArgumentError, SingleOwner, WorkerError
from batchpid.io.files import standard_streams_occupied
from batchpid.sim.engine import native
from batchpid.sim.loop.loop import Failure, Loop, failed, part_of
from batchpid.sim.workers.requests import Request, SharedArrays, Start

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
ONE_THREAD |= {"NPROC": "1", "JAX_CPU_ENABLE_ASYNC_DISPATCH": "0", "JAX_PLATFORMS": "cpu"}
"""Environment of a process whose BLAS uses one thread, and whose JAX computes on the CPU, on the
caller's thread.
"""
_PROGRAM = "from batchpid.sim.workers.worker import serve; serve()"


class WorkerLost(WorkerError):
    """A worker died or is stuck; the message names it, its envs and the cause."""


STEP_LIMIT = 1e-3
"""Upper bound of the time of a sim step of an env [s], which takes about 20 us."""


class Worker(SingleOwner, ABC):
    """Loop of some envs: :meth:`send` a request, then :meth:`receive` its result. The first request
    is BUILD.
    """

    pid: int | None = None
    """Process id; None: this process."""

    def __init__(self, start: Start, shared: SharedArrays) -> None:
        self.envs = start.envs
        """Rows in the arrays."""
        self._start, self._shared = start, shared
        self._timeout = start.options.timeout
        self._step_limit = STEP_LIMIT * (self.envs.stop - self.envs.start)

    def open(self) -> None:
        """Start the process; again after :meth:`close`, for a replacement of a lost one."""

    @abstractmethod
    def send(self, request: Request) -> None:
        """Start the part of a request for the envs of this worker, whose rows are in the arrays."""

    @abstractmethod
    def receive(self) -> object:
        """Wait for the result of the last request and return it; a Failure if the loop raised.

        Raises
        ------
        WorkerLost
            The worker died, or its time is up.
        """

    @abstractmethod
    def close(self) -> None:
        """Free the scenes, or end the process at once. May be called again, after an interrupt
        too.
        """

    def _limit(self, request: Request) -> float:
        """Return the time after which a worker counts as stuck in a request [s]."""
        # Mostly for imports, from a disk that may be slow.
        patience = 60.0 if request.method == "build" else 0.0
        steps = (request.ticks or 1) * request.substeps
        limit: float = self._step_limit * steps + self._timeout + patience
        return limit


class LocalWorker(Worker):
    """Loop in this process."""

    _loop: Loop | None = None
    _result: Any = None

    def send(self, request: Request) -> None:
        try:
            if self._loop is None:
                self._loop = self._start.build(self._shared.arrays)
            else:
                self._result = self._loop.execute(request.method, request.arguments)
        except Exception as error:
            self._result = failed(error)

    def receive(self) -> object:
        return self._result

    def close(self) -> None:
        if self._loop is not None:
            self._loop.close()


class ProcessWorker(Worker):
    """Caller's end of a worker process, which runs on the core ``core`` alone if there is one."""

    def __init__(self, start: Start, shared: SharedArrays, core: int | None) -> None:
        super().__init__(start, shared)
        self._core = core
        # Once: a controller may change in the caller, and a replacement begins as the first worker
        # did.
        self._message = pickled((start, shared.layout))
        self._end = contextlib.ExitStack()
        """Ends the process and closes its files."""
        _workers.add(self)

    def open(self) -> None:
        paths = [path for path in sys.path if isinstance(path, str)]
        # Where "" led to, before the caller changed the folder.
        paths.append(str(Path(__file__).parents[3]))
        environment = os.environ | ONE_THREAD | {"PYTHONPATH": os.pathsep.join(paths)}
        if native.obstacle():
            environment[native.SWITCH] = "0"  # one warning for all
        with standard_streams_occupied():
            self._socket, theirs = socket.socketpair()
            self._end.callback(self._socket.close)
            with theirs:
                descriptors = theirs.fileno(), self._shared.fd
                self._process = process = subprocess.Popen(
                    # -P: without it the working folder comes first, and a json.py in it would run.
                    [sys.executable, "-P", "-c", _PROGRAM, *map(str, descriptors)],
                    stdin=subprocess.PIPE,
                    pass_fds=descriptors,
                    env=environment,
                    start_new_session=True,
                )
        assert process.stdin is not None
        self._pipe = process.stdin
        self._end.callback(self._pipe.close)
        self._end.callback(process.wait)
        # In a forked child of the caller, whose child this is not, it has no effect.
        self._end.callback(process.kill)
        self._answers = self._socket.makefile("rb")
        self.pid = process.pid
        if self._core is not None:
            with contextlib.suppress(OSError):  # the core was taken away
                os.sched_setaffinity(self.pid, {self._core})

    def send(self, request: Request) -> None:
        limit = self._limit(request)
        self._deadline = time.monotonic() + limit
        self._socket.settimeout(limit)
        try:
            message = self._message
            if request.method != "build":
                message = pickle.dumps((request.method, part_of(request.arguments, self.envs)))
            # A worker that has died is an error here, where SIGPIPE would end the process.
            self._socket.sendall(message, socket.MSG_NOSIGNAL)
        except OSError as error:
            self._raise_early(error)
            self._process.kill()  # receive() reports it

    def receive(self) -> object:
        try:
            return pickle.load(self._answers)
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            self._raise_early(error)
            raise self._lost(error) from error

    def let_go(self) -> None:
        """Close the pipe in a forked child of the caller, which may live longer than the caller:
        the pipe is to close when the caller ends.
        """
        if hasattr(self, "_pipe"):
            self._pipe.close()

    def close(self) -> None:
        self._end.close()
        # It is closed later where this is a signal handler in receive().
        vars(self).pop("_answers", None)

    def _raise_early(self, error: Exception) -> None:
        """Raise the error if it is a TimeoutError of a signal handler."""
        if isinstance(error, TimeoutError) and time.monotonic() < self._deadline:
            raise error

    def _lost(self, error: Exception) -> WorkerLost:
        cause = "is stuck: no answer in time; raise timeout= if that was too short"
        if isinstance(error, TimeoutError):
            self._process.send_signal(signal.SIGABRT)  # it prints its stack, unless it is stopped
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            code = 0
        if not isinstance(error, TimeoutError):
            if code < 0:
                cause = f"died ({signal.strsignal(-code)})"
            else:
                cause = f"died (exit code {code})"
        return WorkerLost(f"worker {self._start.label} {cause}")


_workers = WeakSet[ProcessWorker]()


def _let_go() -> None:
    for worker in _workers:
        worker.let_go()


os.register_at_fork(after_in_child=_let_go)


def pickled(message: object) -> bytes:
    """Return the start message of a worker as bytes, with functions and classes that the worker
    cannot import.

    Raises
    ------
    InvalidArgumentError
        An option cannot be pickled.
    """
    try:
        reply: bytes = cloudpickle.dumps(message)
        return reply
    except Exception as error:
        problem = f"cannot be sent to a worker: {error}"
        remedy = "keep objects that cannot be pickled out of control and build"
        raise InvalidArgumentError("options", problem, remedy=remedy) from error


def pinned_cores(workers: int) -> list[int]:
    """Return one core for each worker if there are as many workers as cores; else none.

    The kernel may wake two workers on the core of the parent and leave another core idle for
    milliseconds. Fewer workers than cores are not pinned: several programs could pin their workers
    to the same cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    if workers == len(cores):
        return cores
    return []


# -- in the worker process
# ------------------------------------------------------------------------------------------------

_SPIN_SECONDS = 2e-4
"""Seconds of spinning for the next request before blocking: waking up takes 30 us."""


def serve() -> None:
    """Run the main program of a worker process: build the loop, then serve the caller's requests
    until it closes the socket.

    The descriptors of the socket and of the shared memory are the last arguments of the program.
    """
    if sys.stderr is not None:
        faulthandler.enable()
    # The caller holds the other end of the pipe at standard input. When it ends, the kernel kills
    # this process, even in a call that no Python code interrupts.
    fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(0, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(0, fcntl.F_SETFL, os.O_ASYNC)
    channel, memory = map(int, sys.argv[-2:])
    # These errors say that the caller has ended.
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        _serve(socket.socket(fileno=channel), memory)
    os._exit(0)  # nothing to save, and the engine's own cleanup can take long


def _serve(connection: socket.socket, memory: int) -> None:
    requests = connection.makefile("rb")
    start, layout = pickle.load(requests)
    worker = f"worker {start.label}"
    try:
        loop: Loop = start.build(SharedArrays(layout, memory).arrays)
    except Exception as error:
        connection.sendall(pickle.dumps(failed(error).portable(worker)))
        return
    connection.sendall(pickle.dumps(None))
    # The hot loop makes no reference cycles, so that collections would only cost time.
    gc.collect()
    gc.freeze()
    gc.disable()
    poller = select.poll()
    poller.register(connection, select.POLLIN)
    while True:
        spin_end = time.perf_counter() + _SPIN_SECONDS
        while not poller.poll(0) and time.perf_counter() < spin_end:
            os.sched_yield()
        result = loop.execute(*pickle.load(requests))
        if isinstance(result, Failure):
            result = result.portable(worker)
        connection.sendall(pickle.dumps(result))
