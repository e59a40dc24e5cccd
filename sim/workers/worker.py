"""A worker process: it builds its loop, then serves the parent's requests until told to stop.

The process is started afresh (no fork, no re-import of the caller's ``__main__``), so it works from notebooks and from
scripts without a main guard. It shares with its parent one socket and one block of memory, both by file
descriptor. When the worker dies, its parent sees the socket close; when the parent dies, the worker, which waits
for that in a thread, ends at once. Requests on the hot path are one struct; all others are pickled.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import json
import os
import pickle
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cloudpickle

from batchpid.errors import BatchPIDError, InvalidArgumentError, WorkerError
from sim.loop.arrays import Arrays, Layout
from sim.loop.loop import Loop, LoopSpec
from sim.workers.channel import Channel
from sim.workers.liveness import Pulse
from sim.workers.shared_memory import SharedArrays

TICK = struct.Struct("<cII??")  # b"T", ticks, substeps, use_rate, use_feedforward
DONE = struct.Struct("<cd")  # b"D", seconds of work

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_TAKE_LIMITS = (10.0, 60.0)
"""Seconds amid a message, asleep or at work: a new process imports a lot before it reads."""
_SPIN = 2e-4
"""Seconds for which a worker looks out for the next request before it sleeps: waking up takes 30 us."""
_STOP_LIMIT = 0.7  # seconds: whoever goes on after Ctrl-Z continues all processes at once


class WorkerLost(WorkerError):
    """A worker died, or is stuck; the message names it, its envs and the cause."""


class LocalWorker:
    """The loop in this process, behind the same calls as a worker process."""

    def __init__(self, spec: LoopSpec, index: int, shared: SharedArrays) -> None:
        self.index, self.envs = index, range(spec.first_env, spec.first_env + spec.num_envs)
        self.ticks = Arrays.of_ticks(shared.arrays, slice(self.envs.start, self.envs.stop))
        self._loop = Loop(spec, self.ticks)
        self._result: Any = None

    def send(self, method: str, *args: Any) -> None:
        """Call ``method`` of the loop; :meth:`receive` gives its result."""
        self._result = getattr(self._loop, method)(*args)

    def send_run(self, ticks: int, substeps: int, use_rate: bool, use_feedforward: bool) -> None:
        """Run so many ticks; :meth:`receive` gives the seconds they took."""
        self._result = self._loop.run(ticks, substeps, use_rate, use_feedforward)

    def receive(self) -> Any:
        """Result of the last request."""
        return self._result

    def close(self, patience: float = 0.0) -> None:
        """Free the scenes."""
        self._loop.close()


class ProcessWorker:
    """The parent's end of a worker process: ``send`` a request, then ``receive`` its result.

    The first result, None, comes unasked, when the loop is built.
    """

    def __init__(self, spec: LoopSpec, index: int, shared: SharedArrays) -> None:
        self.index, self.envs = index, range(spec.first_env, spec.first_env + spec.num_envs)
        message = _pickle((spec, shared.layout))
        self._owner = os.getpid()
        self.ticks = Arrays.of_ticks(shared.arrays, slice(self.envs.start, self.envs.stop))
        self._trace = os.memfd_create("batchpid-trace", os.MFD_CLOEXEC)
        try:
            with contextlib.ExitStack() as undo:
                undo.callback(os.close, self._trace)
                ours, theirs = socket.socketpair()
                undo.enter_context(ours)
                with theirs:
                    self._process = _spawn(theirs.fileno(), shared.fd, self._trace)
                undo.pop_all()
        except OSError as error:
            raise WorkerError(
                f"worker {index} (envs {self.envs.start} to {self.envs.stop - 1}) cannot be started: {error}; "
                "pass a smaller workers=, 0 for none"
            ) from error
        self._pulse = Pulse(self.pid)
        self._channel = Channel(ours, lambda: self.check_alive(*_TAKE_LIMITS))
        try:
            with contextlib.suppress(OSError):  # it died: the first receive says so
                self._channel.send(message)
        except BaseException:
            self.close(0.0)
            raise

    @property
    def pid(self) -> int:
        """Process id of the worker."""
        return self._process.pid

    def fileno(self) -> int:
        """File descriptor that becomes readable when there is a result, or the worker is dead."""
        return self._channel.fileno()

    def send(self, method: str, *args: Any) -> None:
        """Ask for ``loop.method(*args)``."""
        self._send(pickle.dumps((method, args)))

    def send_run(self, ticks: int, substeps: int, use_rate: bool, use_feedforward: bool) -> None:
        """Ask for so many ticks; the result is the seconds they took."""
        self._send(TICK.pack(b"T", ticks, substeps, use_rate, use_feedforward))

    def receive(self) -> Any:
        """Wait for the result of the last request.

        Raises
        ------
        WorkerLost
            The worker died.
        WorkerError
            The loop raised; the message holds the worker's traceback. What it raised on purpose comes as it is.
        """
        try:
            message = self._channel.receive()
        except (EOFError, OSError) as error:
            raise self._death() from error
        if message[:1] == b"D":
            return DONE.unpack(message)[1]
        result, failure = pickle.loads(message)
        if isinstance(failure, BatchPIDError):
            raise failure
        if failure is not None:
            raise WorkerError(f"{self._name()} raised:\n{failure}")
        return result

    def check_alive(self, idle_limit: float, limit: float) -> None:
        """Look at a worker that has not answered yet.

        Raises
        ------
        WorkerLost
            It has been stopped, or asleep for ``idle_limit`` seconds, or at work on one request for ``limit``,
            not counting the time for which it waited for a processor.
        """
        pulse = self._pulse
        pulse.look(time.monotonic())
        if pulse.idle > (_STOP_LIMIT if pulse.stopped else idle_limit):
            state = "stopped" if pulse.stopped else "asleep"
            raise self._lost(f"is stuck: {state} for {pulse.idle:.1f} s amid a request")
        if pulse.spent > limit:
            raise self._lost(f"is stuck: no answer within {limit:.0f} s; raise timeout= if that was too short")

    def close(self, patience: float = 5.0) -> None:
        """End the process: ask, and kill it after ``patience`` seconds."""
        self._channel.close()
        if os.getpid() == self._owner:  # else we are a fork of the parent, and the process is not ours to end
            try:
                self._process.wait(patience) if patience else self._process.kill()
            except subprocess.TimeoutExpired:
                self._process.kill()
            self._process.wait()
        if self._trace >= 0:
            os.close(self._trace)
            self._trace = -1

    def keep_to(self, core: int) -> None:
        """Run on that core only."""
        with contextlib.suppress(OSError):  # it died, or the core was taken from us
            os.sched_setaffinity(self.pid, {core})

    def _send(self, message: bytes) -> None:
        self._pulse.begin()
        try:
            self._channel.send(message)
        except OSError as error:
            raise self._death() from error

    def _name(self) -> str:
        return f"worker {self.index} (pid {self.pid}, envs {self.envs.start} to {self.envs.stop - 1})"

    def _death(self) -> WorkerLost:
        try:
            code = self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            return self._lost("closed its connection")
        return self._lost(f"died ({_signal_name(-code)})" if code < 0 else f"died (exit code {code})")

    def _lost(self, cause: str) -> WorkerLost:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGUSR1)  # it writes its stack, unless it is stopped
            time.sleep(0.05)
        trace = os.pread(self._trace, 4000, 0).decode(errors="replace").strip()
        return WorkerLost(f"{self._name()} {cause}" + (f"; its last stack:\n{trace}\n" if trace else ""))


def _spawn(*descriptors: int) -> subprocess.Popen[bytes]:
    """Start a process that serves, as :func:`main`, by these file descriptors: a socket, memory, and its last stack."""
    if not sys.executable:
        raise OSError("sys.executable does not say which Python to run")
    paths = [os.fspath(path) for path in sys.path if isinstance(path, str | os.PathLike)]
    paths.append(str(Path(__file__).parents[2]))  # where "" led to, before the caller went to another folder
    with _without_interrupts():
        return subprocess.Popen(
            [sys.executable, "-c", _BOOT, json.dumps(paths), str(os.getpid()), *map(str, descriptors)],
            pass_fds=descriptors,
            stdin=subprocess.DEVNULL,
            env=os.environ | dict.fromkeys(ONE_THREAD, "1"),
        )


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Let processes that start now never hear of Ctrl-C: the parent does, and must not find them half-way.

    A blocked signal stays blocked in the child, from its first instruction on.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


_BOOT = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from sim.workers.worker import main; main()"


def main() -> None:
    """Entry point of the child: ``argv`` holds the import path, the parent's pid and three file descriptors."""
    parent, channel, memory, trace = map(int, sys.argv[2:])
    faulthandler.enable(trace, all_threads=False)
    faulthandler.register(signal.SIGUSR1, trace, all_threads=False)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    connection = Channel(socket.socket(fileno=channel))
    try:
        spec, layout = pickle.loads(connection.receive())
        envs = slice(spec.first_env, spec.first_env + spec.num_envs)
        _serve(connection, spec, Arrays.of_ticks(SharedArrays(layout, memory).arrays, envs))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the parent closed, or died
    os._exit(0)  # nothing is left to save, and the engine's own end can take long


def _end_with(parent: int) -> None:
    """End this process when ``parent`` is gone, even in the midst of a long tick."""
    try:
        watched = os.pidfd_open(parent)
    except OSError:  # gone already, or a kernel before 5.3
        while os.getppid() == parent:
            time.sleep(0.2)
    else:
        if os.getppid() == parent:
            select.select([watched], [], [])
    os._exit(1)


def _serve(connection: Channel, spec: LoopSpec, ticks: list[Arrays]) -> None:
    try:
        loop = Loop(spec, ticks)
    except Exception as error:
        connection.send(pickle.dumps((None, _portable(error))))
        return
    connection.send(pickle.dumps((None, None)))
    # Nothing here makes cycles; a collection in the hot loop would only cost time.
    gc.collect()
    gc.freeze()
    gc.disable()
    poller = select.poll()
    poller.register(connection.fileno(), select.POLLIN)
    while True:
        asleep = time.perf_counter() + _SPIN
        while not poller.poll(0) and time.perf_counter() < asleep:
            os.sched_yield()
        message = connection.receive()
        try:
            if message[:1] == b"T":
                connection.send(DONE.pack(b"D", loop.run(*TICK.unpack(message)[1:])))
            else:
                method, args = pickle.loads(message)
                connection.send(pickle.dumps((getattr(loop, method)(*args), None)))
        except (BrokenPipeError, ConnectionResetError):
            raise
        except Exception as error:
            connection.send(pickle.dumps((None, _portable(error))))


def _pickle(spec: tuple[LoopSpec, Layout]) -> bytes:
    """Spec and layout of the shared arrays; cloudpickle takes along a function that the worker cannot import."""
    try:
        return cloudpickle.dumps(spec)
    except Exception as error:
        raise InvalidArgumentError(
            "build",
            f"cannot be sent to a worker process: {error}",
            remedy="let the function use nothing that cannot be pickled, or pass workers=0",
        ) from error


def _portable(error: Exception) -> BatchPIDError | str:
    """The error itself where the parent can raise it as it is, else its traceback."""
    return error if isinstance(error, BatchPIDError) else traceback.format_exc()
