"""Trials: calls into SAPIEN that might end the process, made in a child process first."""

from __future__ import annotations

import os
import pickle
import signal
import socket
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, ParamSpec, TypeVar

from batchpid.errors import RobotError
from batchpid.sim.processes.background import BACKGROUND
from batchpid.sim.processes.descriptors import standard_streams_occupied
from batchpid.sim.processes.fork_server import Child, fork

TIME_LIMIT = 120
"""Seconds that a trial may take."""

P = ParamSpec("P")
R = TypeVar("R")


def in_child(function: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> R:
    """Call a function of a module in a child process; its result is returned, or its exception raised, here.

    Raises
    ------
    RobotError
        The child process crashed, or took longer than TIME_LIMIT.
    """
    request = pickle.dumps((function, arguments, options))
    with standard_streams_occupied():
        ours, theirs = map(socket.socket.detach, socket.socketpair())
    with Connection(ours) as connection:
        child = BACKGROUND.call(lambda: _start(theirs))
        try:
            connection.send_bytes(request)
            result, error = pickle.loads(connection.recv_bytes())
        except (OSError, EOFError):
            status = child.wait()
            how = (
                f"takes longer than {TIME_LIMIT} s" if status == -signal.SIGALRM else f"crashes (exit status {status})"
            )
            raise RobotError(
                f"SAPIEN {how} in a trial of the robot; repair or remove collision shapes, or load it with "
                "self_collision='none', which makes no trial"
            ) from None
        finally:
            child.kill()
    if error is not None:
        raise error
    return result


def _start(descriptor: int) -> Child:
    try:
        return fork(f"{__name__}:answer", [descriptor], imports=[__name__, "batchpid.sim.engine.sapien.self_contact"])
    finally:
        os.close(descriptor)


def answer(descriptor: int) -> None:
    """Call the function that comes through a socket, and send its result or its exception."""
    signal.alarm(TIME_LIMIT)
    with Connection(descriptor) as connection:
        connection.send_bytes(_outcome(connection.recv_bytes()))


def _outcome(request: bytes) -> bytes:
    result: tuple[Any, Exception | None]
    try:
        function, arguments, options = pickle.loads(request)
        result = function(*arguments, **options), None
        return pickle.dumps(result)
    except Exception as error:
        return pickle.dumps((None, error))
