"""Main program of a worker process: build the loop, then serve the caller's requests until it
closes the socket.
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
import sys
import time
from typing import Any

from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.loop import Failure, Loop
from batchpid.sim.workers.exchange import SharedArrays

_SPIN_SECONDS = 2e-4
"""Seconds of spinning for the next request before blocking: waking up takes 30 us."""


def main() -> None:
    """Serve, given the descriptors of the socket and of the shared memory as the last arguments of
    the program.
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
    try:
        loop = start.build(Arrays.from_fields(SharedArrays(layout, memory).arrays))
    except Exception as error:
        connection.sendall(pickle.dumps(Failure.of(error).portable()))
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
        connection.sendall(pickle.dumps(_result(pickle.load(requests), loop)))


def _result(request: Any, loop: Loop) -> Any:
    try:
        if isinstance(request, tuple):  # ticks, on the hot path
            return loop.run(*request)
        return request.apply(loop)
    except Exception as error:
        return Failure.of(error).portable()
