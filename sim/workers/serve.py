"""Main program of a worker process: build the loop, then serve the parent's requests until it closes the socket."""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import os
import pickle
import select
import signal
import socket
import struct
import time
from typing import Any

from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.failure import failure_of
from batchpid.sim.workers.exchange import Channel, SharedArrays
from batchpid.sim.workers.requests import decode

_DONE = struct.Struct("<cd")  # b"D", seconds of work: the answer on the hot path, all others are pickled
ANSWER, ANSWER_TAG = struct.Struct("<Qcd"), slice(8, 9)
"""That answer as it comes from the socket, after its length, and the place of the letter."""
_SPIN_SECONDS = 2e-4
"""Seconds of spinning for the next request before blocking: waking up takes 30 us."""


def main(channel: int, memory: int, trace: int) -> None:
    """Serve, given the descriptors of the socket, the shared memory, and the file for the last stack."""
    faulthandler.enable(trace, all_threads=False)
    faulthandler.register(signal.SIGUSR1, trace, all_threads=False)
    connection = Channel(socket.socket(fileno=channel))
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the parent closed the socket, or died
        _serve(connection, memory)
    os._exit(0)  # nothing to save, and the engine's own cleanup can take long


def _serve(connection: Channel, memory: int) -> None:
    start, layout = pickle.loads(connection.receive())
    try:
        loop = start.build(Arrays.from_fields(SharedArrays(layout, memory).arrays))
    except Exception as error:
        connection.send(pickle.dumps(failure_of(error).portable()))
        return
    connection.send(_success(None))
    # The hot loop makes no reference cycles, so that collections would only cost time.
    gc.collect()
    gc.freeze()
    gc.disable()
    poller = select.poll()
    poller.register(connection.fileno(), select.POLLIN)
    while True:
        spin_end = time.perf_counter() + _SPIN_SECONDS
        while not poller.poll(0) and time.perf_counter() < spin_end:
            os.sched_yield()
        message = connection.receive()
        try:
            answer = _success(decode(message).apply(loop))
        except Exception as error:
            answer = pickle.dumps(failure_of(error).portable())
        connection.send(answer)


def _success(result: Any) -> bytes:
    return _DONE.pack(b"D", result) if isinstance(result, float) else pickle.dumps(result)
