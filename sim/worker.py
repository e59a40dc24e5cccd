"""A worker process: it builds its loop, then serves the parent's requests until told to stop.

The process is started afresh (no fork, no re-import of the caller's ``__main__``), so it works from notebooks and from
scripts without a main guard. It shares with its parent one socket and one block of memory, both by file
descriptor; when either process dies the other sees the socket close. Requests on the hot path are one struct;
all others are pickled.
"""

from __future__ import annotations

import gc
import json
import os
import pickle
import signal
import socket
import struct
import subprocess
import sys
import traceback
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle

from batchpid.errors import BatchPIDError, InvalidArgumentError, WorkerError

from .loop import Arrays, Loop, LoopSpec
from .shared import SharedArrays

TICK = struct.Struct("<cI??")  # b"T", substeps, use_rate, use_feedforward
DONE = struct.Struct("<cd")  # b"D", seconds of work

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class LocalWorker:
    """The loop in this process, behind the same calls as a worker process."""

    def __init__(self, spec: LoopSpec, index: int, first_env: int) -> None:
        layout = Arrays.layout(spec.num_envs, len(spec.scene.joints))
        self._shared = SharedArrays(layout)
        self.arrays = Arrays(**self._shared.arrays)
        self._loop = Loop(spec, self.arrays)
        self._result: Any = None

    def send(self, method: str, *args: Any) -> None:
        """Call ``method`` of the loop; :meth:`receive` gives its result."""
        self._result = getattr(self._loop, method)(*args)

    def send_tick(self, substeps: int, use_rate: bool, use_feedforward: bool) -> None:
        """Run one tick; :meth:`receive` gives the seconds it took."""
        self._result = self._loop.tick(substeps, use_rate, use_feedforward)

    def receive(self, timeout: float) -> Any:
        """Result of the last request."""
        return self._result

    def close(self) -> None:
        """Free the scenes."""
        self._loop.close()
        self._shared.close()


class ProcessWorker:
    """The parent's end of a worker process: ``send`` a request, then ``receive`` its result."""

    def __init__(self, spec: LoopSpec, index: int, first_env: int) -> None:
        self.index, self.envs = index, range(first_env, first_env + spec.num_envs)
        message = _pickle(spec)
        self._shared = SharedArrays(Arrays.layout(spec.num_envs, len(spec.scene.joints)))
        self.arrays = Arrays(**self._shared.arrays)
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-c",
                    _BOOT,
                    json.dumps(sys.path),
                    str(theirs.fileno()),
                    str(self._shared.fd),
                ],
                pass_fds=(theirs.fileno(), self._shared.fd),
                stdin=subprocess.DEVNULL,
                env=os.environ | dict.fromkeys(ONE_THREAD, "1"),
            )
        self._connection = Connection(ours.detach())
        self._connection.send_bytes(message)

    @property
    def pid(self) -> int:
        """Process id of the worker."""
        return self._process.pid

    def send(self, method: str, *args: Any) -> None:
        """Ask for ``loop.method(*args)``."""
        try:
            self._connection.send((method, args))
        except OSError as error:
            raise self._death() from error

    def send_tick(self, substeps: int, use_rate: bool, use_feedforward: bool) -> None:
        """Ask for one tick; its result is the seconds it took."""
        try:
            self._connection.send_bytes(TICK.pack(b"T", substeps, use_rate, use_feedforward))
        except OSError as error:
            raise self._death() from error

    def receive(self, timeout: float) -> Any:
        """Wait for the result of the last request.

        Raises
        ------
        WorkerError
            The worker died, raised, or gave no answer within ``timeout`` seconds.
        """
        try:
            if not self._connection.poll(timeout):
                raise WorkerError(
                    f"{self._name()}: no answer within {timeout:g} s; it may be stuck, or the machine overloaded: "
                    "raise timeout=, or close the runner and start again"
                )
            message = self._connection.recv_bytes()
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

    def close(self, patience: float = 5.0) -> None:
        """End the process: ask, and after ``patience`` seconds kill."""
        self._connection.close()
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._shared.close()

    def _name(self) -> str:
        return f"worker {self.index} (pid {self.pid}, envs {self.envs.start} to {self.envs.stop - 1})"

    def _death(self) -> WorkerError:
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            return WorkerError(f"{self._name()} closed its connection; close the runner and start again")
        cause = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return WorkerError(
            f"{self._name()} died ({cause}); its envs are lost: close the runner and start again"
        )


_BOOT = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from sim.worker import main; main()"


def main() -> None:
    """Entry point of the child: ``argv`` holds the import path and the two file descriptors."""
    # The parent handles Ctrl-C and closes the socket; the worker must not die half-way through a tick.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection, fd = Connection(int(sys.argv[2])), int(sys.argv[3])
    try:
        spec: LoopSpec = connection.recv()
        _serve(connection, spec, fd)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the parent closed, or died


def _serve(connection: Connection, spec: LoopSpec, fd: int) -> None:
    shared = SharedArrays(Arrays.layout(spec.num_envs, len(spec.scene.joints)), fd)
    loop: Loop | None = None
    try:
        loop = Loop(spec, Arrays(**shared.arrays))
    except Exception as error:
        connection.send((None, _portable(error)))
        return
    connection.send((None, None))
    # Nothing here makes cycles; a collection in the hot loop would only cost time.
    gc.collect()
    gc.freeze()
    gc.disable()
    while True:
        message = connection.recv_bytes()
        try:
            if message[:1] == b"T":
                _, substeps, use_rate, use_feedforward = TICK.unpack(message)
                connection.send_bytes(DONE.pack(b"D", loop.tick(substeps, use_rate, use_feedforward)))
            else:
                method, args = pickle.loads(message)
                connection.send((getattr(loop, method)(*args), None))
        except (BrokenPipeError, ConnectionResetError):
            raise
        except Exception as error:
            connection.send((None, _portable(error)))


def _pickle(spec: LoopSpec) -> bytes:
    """The spec as bytes; cloudpickle takes along the user's function where the worker cannot import it by name."""
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
