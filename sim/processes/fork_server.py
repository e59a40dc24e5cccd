"""Server process that forks children for its caller: modules are imported once, and a child starts in milliseconds.

A new Python process spends half a second of processor time on its imports. The server has done them when a child is
asked for. A fork of the server is safe, unlike one of the caller: it is a fresh Python, without the caller's
``__main__``, and with one thread.

Children inherit from the caller, at each fork, the environment (another one starts another server), the import path,
working folder, cores, resource limits, and the standard output and error; and the umask and priority that it had when
the server started. The kernel ends them when the server ends, and the server when the caller ends. For the kernel, the
parent is the thread that started the server; that is :data:`BACKGROUND`, which lives as long as the caller.

The forkserver of :mod:`multiprocessing` does not suffice: its children import the caller's ``__main__``, which needs a
main guard and takes as long again as the fork; they have the environment and the standard streams of the first start;
and it is shared with the caller's own use, preloaded modules included.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import json
import os
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import NamedTuple

from batchpid.arrays.array_types import Document
from batchpid.io.files import standard_streams_occupied

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")
ONE_THREAD |= {"NPROC": "1", "JAX_CPU_ENABLE_ASYNC_DISPATCH": "0", "JAX_PLATFORMS": "cpu"}
"""Environment of a process whose BLAS uses one thread, and whose JAX computes on the CPU, on the caller's thread."""
_PR_SET_PDEATHSIG = 1  # of prctl(2): the signal that a process gets when its parent ends, even when it is stopped
_SOCKET = 3  # descriptor of the server's socket
_ANSWER = struct.Struct("<ii")  # process id of the child, or 0 and an error number
_MAX_MESSAGE, _MAX_DESCRIPTORS = 1 << 18, 16
_LIMITS = [getattr(resource, name) for name in dir(resource) if name.startswith("RLIMIT_")]
_PROGRAM = f"""
import ctypes, json, os, sys
ctypes.CDLL(None).prctl({_PR_SET_PDEATHSIG}, {signal.SIGKILL:d})
os.getppid() == int(sys.argv[2]) or os._exit(1)
os.closerange({_SOCKET + 1}, os.sysconf("SC_OPEN_MAX"))
sys.path[:] = json.loads(sys.argv[1])
from {__name__} import serve
serve()
"""


class Child:
    """Child process of the server, as its caller sees it."""

    def __init__(self, pid: int, status: Connection) -> None:
        self.pid = pid
        self.returncode: int | None = None
        """Exit status, negative for a signal; None: :meth:`poll` and :meth:`wait` have not seen the end."""
        self._status, self._lock = status, threading.Lock()

    def poll(self) -> int | None:
        """Return the exit status, or None while the process runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the process and return the exit status. Several threads may wait.

        Raises
        ------
        subprocess.TimeoutExpired
            It has not ended after ``timeout`` seconds.
        """
        if self.returncode is None and not self._status.poll(timeout):  # readable when it has ended, and from then on
            assert timeout is not None
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        with self._lock:
            if self.returncode is None:
                try:
                    self.returncode = int(self._status.recv_bytes())
                except EOFError:  # the server has ended, and the kernel ended the child
                    self.returncode = -signal.SIGKILL
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, if it runs."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End the process at once."""
        self.send_signal(signal.SIGKILL)


class _Server(NamedTuple):
    """Server of one caller."""

    pid: int
    caller: int
    environment: dict[str, str]
    socket: socket.socket


_server: _Server | None = None
_left: list[int] = []  # process ids of earlier servers, until their ends are collected


def fork(
    main: str, descriptors: Sequence[int], *, imports: Sequence[str] = (), environment: dict[str, str] | None = None
) -> Child:
    """Start a process that calls a function with file descriptors. To be called in :data:`BACKGROUND`.

    Parameters
    ----------
    main
        The function, as ``module:name``. The process ends when it returns.
    descriptors
        Open files of the caller. The function gets the numbers that they have in the child.
    imports
        Modules that the server imports before it forks; one that cannot be imported is left to the child.
    environment
        Additional environment variables of the child. They are set after the imports.

    Raises
    ------
    OSError
        No process can be started.
    """
    streams = [number for number in (1, 2) if _is_open(number)]
    with standard_streams_occupied():
        here = os.open(".", os.O_PATH | os.O_CLOEXEC)
        reader, writer = Pipe(duplex=False)
    try:
        message = {
            "main": main,
            "imports": [*imports],
            "environment": environment or {},
            "path": _import_path(),
            "cores": sorted(os.sched_getaffinity(os.getpid())),  # of the main thread
            "limits": [resource.getrlimit(limit) for limit in _LIMITS],
            "streams": streams,
        }
        answer = _ask(json.dumps(message).encode(), [writer.fileno(), here, *streams, *descriptors])
    finally:
        writer.close()
        os.close(here)
    pid, error = _ANSWER.unpack(answer)
    if error:
        raise OSError(error, os.strerror(error))
    return Child(pid, reader)


def server_pid() -> int | None:
    """Return the process id of the caller's server, None if it has none."""
    return None if _server is None or _server.caller != os.getpid() else _server.pid


def _ask(message: bytes, descriptors: Sequence[int]) -> bytes:
    """Send a message to the server, or to a new one if none runs; return its answer."""
    global _server
    environment = os.environ | ONE_THREAD
    environment.pop("PYTEST_CURRENT_TEST", None)  # other in each test of a caller, and of no use to a child
    for _ in range(2):
        if _server is None or _server.caller != os.getpid() or _server.environment != environment:
            _leave()
            _server = _start(environment)
        with contextlib.suppress(ConnectionError):
            socket.send_fds(_server.socket, [message], descriptors)
            if answer := _server.socket.recv(_ANSWER.size):
                return answer
        _leave()
    raise OSError("the process that starts them ended at its own start")


def _leave() -> None:
    """Close the connection to the server, which ends after its children."""
    global _server
    if _server is not None:
        _server.socket.close()
        _left.append(_server.pid)
    _server = None
    for pid in [*_left]:
        with contextlib.suppress(ChildProcessError):  # another process than the one that started it
            if os.waitpid(pid, os.WNOHANG)[0] == 0:
                continue
        _left.remove(pid)


atexit.register(_leave)


def _start(environment: dict[str, str]) -> _Server:
    if not sys.executable:
        raise OSError("sys.executable does not say which Python to run")
    with standard_streams_occupied():
        ours, theirs = socket.socketpair(type=socket.SOCK_SEQPACKET)
    quiet = [(os.POSIX_SPAWN_OPEN, each, os.devnull, os.O_RDWR, 0) for each in (0, 1, *(() if _is_open(2) else (2,)))]
    with theirs:
        pid = os.posix_spawn(
            sys.executable,
            # -P: without it the working folder comes first, and a json.py in it would run.
            [sys.executable, "-P", "-c", _PROGRAM, json.dumps(_import_path()), str(os.getpid())],
            environment,
            file_actions=[(os.POSIX_SPAWN_DUP2, theirs.fileno(), _SOCKET), *quiet],
        )
    return _Server(pid, os.getpid(), environment, ours)


def _is_open(descriptor: int) -> bool:
    """Return whether this process has a file open under the number ``descriptor``."""
    with contextlib.suppress(OSError):
        os.fstat(descriptor)
        return True
    return False


def _import_path() -> list[str]:
    paths = [os.fspath(path) for path in sys.path if isinstance(path, str | os.PathLike)]
    return [*paths, str(Path(__file__).parents[3])]  # where "" led to, before the caller changed the folder


def serve(idle_seconds: float = 20.0) -> None:
    """Fork children for the caller until it closes the socket, or has had none for ``idle_seconds``."""
    caller = socket.socket(fileno=_SOCKET)
    wake, waker = socket.socketpair()
    for end in (wake, waker):
        end.setblocking(False)
    signal.set_wakeup_fd(waker.fileno())
    signal.signal(signal.SIGCHLD, lambda *_: None)  # handled below: it wakes the poll
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])  # blocked where the caller's main thread blocks it
    poller = select.poll()
    poller.register(wake, select.POLLIN)
    poller.register(caller, select.POLLIN)
    children: dict[int, Connection] = {}
    is_open = True
    while is_open or children:
        ready = [number for number, _ in poller.poll(None if children else 1000 * idle_seconds)]
        if wake.fileno() in ready:
            wake.recv(4096)
            _report_ends(children)
        if caller.fileno() in ready:
            is_open = _serve_one(caller, children)
            if not is_open:
                poller.unregister(caller)
        if not ready and not children:
            break
    os._exit(0)


def _serve_one(caller: socket.socket, children: dict[int, Connection]) -> bool:
    """Fork for one message; return False if the caller has closed the socket."""
    message, descriptors, *_ = socket.recv_fds(caller, _MAX_MESSAGE, _MAX_DESCRIPTORS)
    if not message:
        return False
    request = json.loads(message)
    for module in request["imports"]:
        with contextlib.suppress(Exception):
            importlib.import_module(module)
    gc.collect()
    gc.freeze()  # the collector of a child touches no page that it shares
    server = os.getpid()
    os.sched_setaffinity(0, request["cores"])  # before the fork: the caller may give the child other cores at once
    try:
        pid = os.fork()
    except OSError as error:
        answer = _ANSWER.pack(0, error.errno or 0)
    else:
        if pid == 0:
            _run_child(server, request, descriptors)
        answer = _ANSWER.pack(pid, 0)
        children[pid] = Connection(os.dup(descriptors[0]), readable=False)
    for descriptor in descriptors:
        os.close(descriptor)
    with contextlib.suppress(OSError):  # the caller has ended
        caller.send(answer)
    return True


def _run_child(server: int, request: Document, descriptors: list[int]) -> None:
    """Take over the caller's settings, call the function, and end."""
    status = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != server:
            return
        _, folder, *rest = descriptors
        streams = request["streams"]
        for stream in streams:
            os.dup2(rest.pop(0), stream)
        if 2 not in streams:
            os.dup2(0, 2)
        os.fchdir(folder)
        for name in map(int, os.listdir("/proc/self/fd")):
            if name > 2 and name not in rest:
                with contextlib.suppress(OSError):  # the listing itself
                    os.close(name)
        for limit, value in zip(_LIMITS, request["limits"], strict=True):
            if resource.getrlimit(limit) != tuple(value):
                resource.setrlimit(limit, value)
        os.environ.update(request["environment"])
        sys.path[:] = request["path"]
        module, _, name = request["main"].partition(":")
        getattr(importlib.import_module(module), name)(*rest)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _report_ends(children: dict[int, Connection]) -> None:
    """Collect the children that have ended, and pass their exit status on."""
    for pid in [*children]:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            with children.pop(pid) as connection, contextlib.suppress(OSError):
                connection.send_bytes(str(os.waitstatus_to_exitcode(status)).encode())
