"""Processes of tests: children, and waiting for an end."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable

import psutil

from batchpid.sim.processes.fork_server import server_pid

PATIENCE = 200.0
"""Timeout [s] of events that should happen soon; long enough for a busy machine."""


def children() -> set[psutil.Process]:
    """Return the children of this process and of its fork server; libraries of other tests may have some that stay."""
    server = server_pid()
    direct = {child for child in psutil.Process().children() if child.pid != server}
    return direct if server is None else direct | set(psutil.Process(server).children())


def send(pid: int, number: int) -> None:
    """Send a signal to a process, if it still runs."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def have_ended(pids: Iterable[int], seconds: float = PATIENCE) -> bool:
    """Wait for processes to end, so long at most; return whether they have."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if not any(map(_runs, pids)):
            return True
        time.sleep(0.02)
    return False


def shared_memory() -> set[str]:
    """Return the names of the files in shared memory; semaphores are of libraries in other tests."""
    return {name for name in os.listdir("/dev/shm") if not name.startswith("sem.")}


def _runs(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != "zombie"
    except psutil.NoSuchProcess:
        return False
