"""Trials: calls into SAPIEN that might end the process, made in a child process first.

A server process imports SAPIEN once and forks for each trial, in milliseconds instead of 0.3 s. It has one thread, so
that a fork is safe, unlike in the caller's process. It ends after some idle seconds, and with the caller.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from batchpid.errors import RobotError
from batchpid.sim.engine.sapien.user_content import HeadlessScene

TIME_LIMIT = 120
"""Seconds that a trial may take."""
_IDLE_SECONDS = 20.0
_PROGRAM = """
import json, os, sys
if os.fork():
    os._exit(0)  # the server is not a child of the caller
sys.path[:] = json.loads(sys.argv[1])
from batchpid.sim.engine.sapien.trial import serve
serve(int(sys.argv[2]))
"""

P = ParamSpec("P")
R = TypeVar("R")
_lock = threading.Lock()
_servers: dict[int, Connection] = {}  # by the process id of the caller, which may fork


def in_child(function: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> R:
    """Call a function of a module in a child process; its result is returned, or its exception raised, here.

    Raises RobotError if the child process crashed, or took longer than TIME_LIMIT.
    """
    request = pickle.dumps((function, arguments, options))
    with _lock:
        try:
            answer = _ask(request)
        except (OSError, EOFError):  # the server has ended
            answer = _ask(request)
    result, error = pickle.loads(answer)
    if error is not None:
        raise error
    return result


def _ask(request: bytes) -> bytes:
    server = _servers.pop(os.getpid(), None) or _start()
    _servers.clear()
    server.send_bytes(request)
    answer = server.recv_bytes()
    _servers[os.getpid()] = server  # not after an interrupt: the answer to this request would be that to the next
    return answer


def _start() -> Connection:
    """Start a server, and return the connection to it."""
    paths = [os.fspath(path) for path in sys.path if isinstance(path, str | os.PathLike)]
    paths.append(str(Path(__file__).parents[4]))
    ours, theirs = socket.socketpair()
    with theirs:
        # -P: without it a json.py in the working folder would run.
        command = [sys.executable, "-P", "-c", _PROGRAM, json.dumps(paths), str(theirs.fileno())]
        quiet: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        subprocess.run(command, pass_fds=[theirs.fileno()], check=True, **quiet)
    return Connection(ours.detach())


def serve(descriptor: int) -> None:
    """Serve trials over a socket until it is closed, or idle for long."""
    caller = Connection(descriptor)
    HeadlessScene().create_urdf_loader()  # SAPIEN's modules and engine, once for all trials
    while caller.poll(_IDLE_SECONDS):
        try:
            caller.send_bytes(_try(caller.recv_bytes()))
        except (OSError, EOFError):
            break
    os._exit(0)


def _try(request: bytes) -> bytes:
    """Return the pickled result and error of a request, from a forked child."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(TIME_LIMIT)
        with open(writer, "wb") as file:
            file.write(_answer(request))
            file.flush()
            os._exit(0)
    os.close(writer)
    with open(reader, "rb") as file:
        answer = file.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status == 0:
        return answer
    how = f"takes longer than {TIME_LIMIT} s" if status == -signal.SIGALRM else f"crashes (exit status {status})"
    remedy = "repair or remove collision shapes, or load it with self_collision='none', which makes no trial"
    return pickle.dumps((None, RobotError(f"SAPIEN {how} in a trial of the robot; {remedy}")))


def _answer(request: bytes) -> bytes:
    try:
        function, arguments, options = pickle.loads(request)
        return pickle.dumps((function(*arguments, **options), None))
    except Exception as error:
        return pickle.dumps((None, error))
